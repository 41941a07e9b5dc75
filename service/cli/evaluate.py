"""The command ``evaluate``: a PSF on a transit, in this process.

Everything numerical is imported by the command that needs it, so that the others start fast.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psfcore.errors import DataError
from service.cli.options import (
    FOLDER,
    NOISE,
    OUTPUT,
    PLOT,
    Report,
    check_writable,
    limits,
    progress_bar,
    user_errors,
    write_json,
)
from workers.settings import software_version

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from psfcore.evaluation.evaluation import Evaluation
    from psfcore.psf import Psf
    from psfcore.scatter.inversion import Solution
    from psfcore.scatter.validation.fold_fits import FoldKernels
    from psfcore.transit.transit import Transit

THREADS = 2
NO_PSF = "none"


@click.command()
@click.argument("folder", type=FOLDER)
@click.option(
    "--psf",
    "psf_file",
    default=NO_PSF,
    show_default=True,
    metavar="FILE|none",
    help="A PSF (FITS); none: fit the transit, and evaluate each image with a PSF fitted without it",
)
@click.option("--json", "json_file", type=OUTPUT, help="Write all of it, image by image")
@PLOT
@click.option("--dark-offsets", is_flag=True, help="Also fit with -5, -3, +3 and +5 DN added to the images")
@click.option(
    "--shapes",
    is_flag=True,
    help="Also compare shapes of scatter by what each leaves, held out; with --psf none",
)
@NOISE
def evaluate(
    folder: Path,
    psf_file: str,
    json_file: Path | None,
    plot: Path | None,
    dark_offsets: bool,
    shapes: bool,
    noise: tuple[float, float] | None,
) -> None:
    """Compare the light that a PSF puts into the occulter of FOLDER, a transit, with what was observed there."""
    from psfcore.evaluation.plot import evaluation_png
    from psfcore.evaluation.report import lines, report

    check_writable(json_file, plot)
    if shapes and psf_file != NO_PSF:
        raise click.UsageError(f"--shapes fits every shape itself: expected --psf {NO_PSF}; got a PSF file")
    with user_errors(), progress_bar() as say:
        psf = None if psf_file == NO_PSF else _psf(Path(psf_file))
        transit = _transit(folder, noise, fits=psf is None or dark_offsets, progress=say)
        _check_scale(transit, psf)
        fitted, compared = None, None
        if psf is None:
            evaluation, fitted, about = _held_out(transit, say)
        else:
            evaluation, about = _with(transit, psf, Path(psf_file), say)
        study = None
        if dark_offsets:
            from psfcore.scatter.validation.dark_offsets import dark_offset_study

            nominal = None if fitted is None else fitted.inversion
            study = dark_offset_study(transit, nominal=nominal, threads=THREADS, progress=say)
        found = report(evaluation, study)
        if shapes and fitted is not None:
            from psfcore.evaluation.shapes import compare_shapes_by_errors

            compared = compare_shapes_by_errors(fitted, progress=say)
            found["shapes"] = compared.to_json()
    said = f"{about['sentence']}; {len(transit.frames)} images of {folder.resolve().name}"
    with user_errors():
        if plot is not None:
            evaluation_png(evaluation, plot, title=said, study=study)
        write_json(json_file, {"psf": about, "software_version": software_version(), **found})
    click.echo(said)
    click.echo("\n".join(lines(evaluation, study)))
    if compared is not None:
        click.echo("\n".join(compared.lines()))


COMMANDS = (evaluate,)


def _held_out(transit: Transit, say: Report) -> tuple[Evaluation, Solution, dict[str, Any]]:
    """Every image with the PSF of the fold that holds it out; the fit to all images; what was done."""
    from psfcore.evaluation.evaluation import evaluate as evaluated
    from psfcore.scatter.inversion import invert
    from psfcore.scatter.validation.fold_fits import fold_kernels

    solution = invert(transit, threads=THREADS, progress=say)
    whole = solution.inversion
    kernels = fold_kernels(transit, whole.shape, start=whole.coordinates, threads=THREADS, progress=say)
    evaluation = evaluated(transit, kernels, threads=THREADS, progress=say)
    about = {
        "sentence": f"each image with a PSF fitted without it and its neighbours ({len(kernels.fits)} folds)",
        "held_out": True,
        "shape": whole.shape.name,
        "parameters": whole.values,
        "folds": _folds_json(transit, kernels),
    }
    return evaluation, solution, about


def _folds_json(transit: Transit, kernels: FoldKernels) -> list[dict[str, Any]]:
    return [
        {
            "held_out": [transit.frames[n].file for n in fit.fold.held_out],
            "fitted_images": len(fit.inversion.frames),
            "parameters": fit.inversion.values,
            "converged": fit.inversion.converged,
            "radii_px": fit.inversion.radii_px.tolist(),
            "light_beyond_pct": fit.inversion.curve_pct.tolist(),
        }
        for fit in kernels.fits
    ]


def _with(transit: Transit, psf: Psf, file: Path, say: Report) -> tuple[Evaluation, dict[str, Any]]:
    """Every image with one PSF; what was done."""
    from psfcore.evaluation.evaluation import evaluate as evaluated

    evaluation = evaluated(transit, lambda _index: psf.kernel, threads=THREADS, progress=say)
    with file.open("rb") as opened:
        digest = hashlib.file_digest(opened, "sha256").hexdigest()
    about = {
        "sentence": f"PSF {psf.name} {psf.version} (no test of it where it was fitted to these images)",
        "held_out": False,
        "name": psf.name,
        "version": psf.version,
        "sum": psf.total,
        "sha256": digest,
    }
    return evaluation, about


def _psf(file: Path) -> Psf:
    from psfcore.fits.psfs import read_psf

    if not file.is_file():
        raise click.BadParameter(
            f"expected a PSF file, or {NO_PSF}; there is no file {file}", param_hint="--psf"
        )
    return read_psf(file, limits(), parts=False)


def _transit(folder: Path, noise: tuple[float, float] | None, *, fits: bool, progress: Report) -> Transit:
    """The transit, its diffraction built where transit.json names none and a fit needs one."""
    from psfcore.noise import Noise
    from psfcore.transit.folder import read_transit

    return read_transit(
        folder,
        limits(),
        progress=lambda done, of: progress("reading", done, of),
        diffraction=_built_diffraction if fits else _no_diffraction,
        noise=None if noise is None else Noise(*noise),
    )


def _built_diffraction(instrument: str | None, _shape: tuple[int, int]) -> NDArray[np.float64]:
    from psfcore.build import build_psf
    from psfcore.instruments.files import instrument_names
    from psfcore.instruments.model import load_instrument

    if instrument not in instrument_names():
        known = ", ".join(instrument_names())
        raise DataError(
            "no-known-psf",
            f'expected "known_psf" in transit.json, or an instrument that diffraction is known of ({known}); '
            f"got {instrument or 'neither'}",
        )
    return build_psf(load_instrument(instrument), component="DIFFRACTION", threads=THREADS).kernel


def _no_diffraction(_instrument: str | None, _shape: tuple[int, int]) -> NDArray[np.float64]:
    """Nothing asks for the diffraction where no fit is made: the PSF that was named holds it."""
    import numpy as np

    point = np.zeros((17, 17))
    point[8, 8] = 1.0
    return point


def _check_scale(transit: Transit, psf: Psf | None) -> None:
    """Raise DataError "plate-scale-mismatch" where both scales are known and differ by over 1 %."""
    from psfcore.psf import PLATE_SCALE_TOLERANCE

    seen = transit.plate_scale_arcsec
    if psf is None or psf.plate_scale_arcsec is None or seen is None:
        return
    if abs(seen / psf.plate_scale_arcsec - 1) > PLATE_SCALE_TOLERANCE:
        raise DataError(
            "plate-scale-mismatch",
            f"expected images of {psf.plate_scale_arcsec:g} arcsec/px as PSF {psf.name} has it; "
            f"got {seen:g} arcsec/px",
        )
