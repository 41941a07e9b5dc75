"""The task ``psf-build``: builds a PSF version from an instrument file."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.images import read_plane
from psfcore.instruments.model import Instrument, parse_instrument
from workers.contract.identities import recipe_of
from workers.contract.requests import PsfBuild
from workers.settings import library_versions
from workers.tasks.results import psf_result
from workers.tasks.workspace import Workspace, task_of
from workers.versions import TOTAL

BUILDING = "building the PSF"


@task_of("psf-build")
def psf_build(workspace: Workspace, build: PsfBuild, identity: str) -> None:
    """Build a PSF from an instrument file."""
    recipe = recipe_of(build)
    instrument = parse_instrument(recipe.text, recipe.name or "instrument_file")
    psf, write = workspace.build(
        recipe, _mount_image(workspace, build, instrument), partial(workspace.report, BUILDING)
    )
    details = {"job_id": workspace.job_id, "libraries": library_versions()}
    workspace.add(
        psf_result(
            psf,
            identity,
            origin="built",
            kind=build.component or TOTAL,
            write=write,
            details=details,
            threads=workspace.threads,
        )
    )


def _mount_image(workspace: Workspace, build: PsfBuild, instrument: Instrument) -> NDArray[np.float64] | None:
    """The pixels of the uploaded mask image that the instrument's mount names; None if the mount names none.

    Raises DataError "mask-not-named", "mask-missing".
    """
    named = None if instrument.mount is None else instrument.mount.mask_image
    if named is None and build.mask_id is None:
        return None
    if named is None:
        raise DataError(
            "mask-not-named",
            "mask_id: expected an instrument file that sets mount.mask_image; this file does not: leave mask_id out",
        )
    if build.mask_id is None:
        raise DataError(
            "mask-missing",
            f"mask_id: expected the id of the mask image {named.file}, which mount.mask_image names; got none: "
            "upload the file and give its id",
        )
    return read_plane(workspace.image_file(build.mask_id), workspace.limits)
