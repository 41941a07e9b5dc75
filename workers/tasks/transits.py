"""The transit of a request: unpacked, read and prepared."""

from __future__ import annotations

from functools import partial

from psfcore.errors import DataError
from psfcore.transit.folder import read_prepared
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Kernel, Transit
from workers.contract.requests import ResolvedOnTransit
from workers.tasks.workspace import Workspace


def load_transit(
    workspace: Workspace, request: ResolvedOnTransit, *, diffraction: Kernel | None = None
) -> tuple[Transit, Prepared]:
    """Unpack, read and prepare the transit that a request names.

    Parameters
    ----------
    diffraction
        The diffraction PSF to use if the transit contains none; None: build it from the request's recipe. The PSF is
        not cropped to the field of view: its kernel of 2048 × 2048 px sums to 1.

    Raises
    ------
    DataError
        "no-such-transit", "no-known-psf", and the errors of unpacking and preparing.
    """

    def known(_instrument: str | None, _shape: tuple[int, int]) -> Kernel:
        if diffraction is not None:
            return diffraction
        if request.diffraction_recipe is None:
            raise DataError(
                "no-known-psf",
                "expected known_psf in transit.json, or an instrument whose diffraction PSF can be built; got "
                "neither: add the file of the known PSF to the transit",
            )
        return workspace.built_psf(request.diffraction_recipe).kernel

    with workspace.unpacked(request.transit_id) as folder:
        return read_prepared(
            folder,
            workspace.limits,
            progress=partial(workspace.report, "reading"),
            diffraction=known,
            noise=None if request.noise is None else request.noise.noise(),
            saturation_dn=request.saturation_dn,
        )
