"""The task ``deconvolve``: deconvolves an uploaded image with a PSF; the result is a product."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from astropy.io.fits import Header

from psfcore.deconvolve import run
from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.run import Identities, Product, UsedPsf
from psfcore.drawing.thumbnail import write_thumbnail
from psfcore.fits.cards import optional_text
from psfcore.fits.observation import read_observation
from psfcore.image import Image
from psfcore.psf import Psf
from workers.contract.identities import product_identity
from workers.contract.kinds import ResultType
from workers.contract.requests import ResolvedDeconvolve, options_of
from workers.files.archive import safe_name
from workers.machine import free_bytes
from workers.settings import library_versions, software_version
from workers.tasks.workspace import Result, Workspace, task_of
from workers.versions import PsfStatus


@task_of("deconvolve")
def deconvolve(workspace: Workspace, request: ResolvedDeconvolve, _identity: str) -> None:
    """Deconvolve an image, and add the product.

    Raises DataError "no-such-image", "no-such-psf", "instrument-changed", "channel-mismatch", "no-noise-figures",
    "already-deconvolved", "psf-as-image", and the errors of reading the image and of the method.
    """
    # The path is taken only when the image is read: a local copy of the store may be removed while a PSF is built.
    workspace.add(
        make(workspace, request, lambda: load(workspace, request, workspace.image_file(request.image_id)))
    )


def load(workspace: Workspace, request: ResolvedDeconvolve, path: Path) -> Image:
    """Read an image file and mask its saturated pixels."""
    workspace.report("reading", 0, request.method.steps)
    return read_observation(path, workspace.limits, saturation_dn=request.saturation_dn, hdu=request.hdu)


def make(
    workspace: Workspace,
    request: ResolvedDeconvolve,
    read: Callable[[], Image],
    *,
    preview: bool = True,
) -> Result:
    """Deconvolve an image and measure the changes; the result is a product whose files are not yet written.

    Parameters
    ----------
    read
        Function that reads the image.
    preview
        Whether the result has a picture of the image before and after.
    """

    def begin(stage: str, steps: int) -> Callable[[int, int], None]:
        if stage == run.DECONVOLVING:
            workspace.times.begin(stage)
        elif stage != run.BUILDING:
            workspace.report(stage, 0, steps)
        return lambda step, steps: workspace.report(stage, step, steps)

    source = workspace.psf_source(request)
    product, psf = run.read_and_deconvolve(
        read,
        source,
        options_of(request, workspace.threads),
        shape=workspace.shape_to_check(request),
        free_bytes=free_bytes(),
        # A rerun repeats an earlier deconvolution, even if it was made by a version that did not check this.
        again=request.again or workspace.anew,
        begin=begin,
    )
    workspace.report("saving", 0, 1)
    used = source.used or UsedPsf(request.psf_id, psf.name, psf.version, PsfStatus.DRAFT)
    details = product.details(used, source.provenance)
    return product_result(request, product, used, details, job_id=workspace.job_id, preview=preview)


def product_result(
    request: ResolvedDeconvolve,
    product: Product,
    psf: UsedPsf,
    details: Mapping[str, object],
    *,
    job_id: str,
    preview: bool = True,
) -> Result:
    """The product of a request, whose files are not yet written.

    Parameters
    ----------
    psf
        The PSF as the cards of the product name it.
    details
        The details of the product.
    preview
        Whether the result has a picture of the image before and after.
    """
    identity = product_identity(request)
    # The name depends only on the content of the input and on the request.
    filename = safe_name(optional_text(product.image.header, "FILENAME") or "heliopsf", identity)
    ids = Identities(identity, request.image_id, request.method.algorithm_version, filename)
    files: dict[str, Callable[[Path], object]] = {"file": lambda path: run.write(product, path, psf, ids)}
    if preview:
        files["preview"] = lambda path: run.draw_preview(product, psf, path)
    if request.changes_picture:
        files["changes"] = lambda path: run.draw_changes(product, psf, path)
    return Result(
        ResultType.PRODUCT,
        identity,
        {
            "filename": filename,
            "method": request.method.model_dump(mode="json"),
            "algorithm_version": request.method.algorithm_version,
            "software_version": software_version(),
            "libraries": library_versions(),
            "parameters": request.model_dump(mode="json", exclude_none=True),
            "job_id": job_id,
            **details,
        },
        files | {"thumbnail": lambda path: write_thumbnail(product.pixels, path)},
        {
            "kind": "deconvolved-image",
            "image_id": request.image_id,
            "psf_id": psf.id,
            "psf_version": psf.version,
        },
    )


@lru_cache(maxsize=1)
def prepared_psfs(max_bytes: int) -> PreparedPsfs:
    """The prepared PSFs of this process. The jobs of a process run one after the other and often use the same PSF."""
    return PreparedPsfs(max_bytes)


def possible_psfs(psf: Psf, header: Header, *, threads: int) -> Sequence[Psf]:
    """The variants of a PSF within its errors, on the pixels of an image."""
    # Most deconvolutions compute no errors, and do not load what follows.
    from psfcore.scatter.total_psf import possible_on_pixels

    return possible_on_pixels(psf, header, threads=threads)
