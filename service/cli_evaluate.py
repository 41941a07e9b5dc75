"""The command ``evaluate``: a PSF on a transit, in this process.

Everything numerical is imported by the command that needs it, so that the others start fast.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psfcore.errors import DataError
from psfcore.header import FitsLimits
from service.cli_diffraction import OUTPUT, user_errors
from workers.settings import Settings, software_version

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from psfcore.psf import Psf
    from psfcore.scatter.fold_fits import FoldKernels
    from psfcore.scatter.inversion import Inversion
    from psfcore.transit.evaluation import Evaluation
    from psfcore.transit.transit import Transit

THREADS = 2
NO_PSF = "none"

Report = Callable[[str, int, int], None]


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--psf",
    "psf_file",
    default=NO_PSF,
    show_default=True,
    metavar="FILE|none",
    help="A PSF (FITS); none: fit the transit, and evaluate each image with a PSF fitted without it",
)
@click.option("--json", "json_file", type=OUTPUT, help="Write all of it, image by image")
@click.option("--plot", type=OUTPUT, help="Write a picture (PNG)")
@click.option("--dark-offsets", is_flag=True, help="Also fit with -5, -3, +3 and +5 DN added to the images")
@click.option("--noise", nargs=2, type=float, metavar="GAIN READ", help="DN a photon, DN rms of the readout")
def evaluate(
    folder: Path,
    psf_file: str,
    json_file: Path | None,
    plot: Path | None,
    dark_offsets: bool,
    noise: tuple[float, float] | None,
) -> None:
    """Compare the light that a PSF puts into the occulter of FOLDER, a transit, with what was observed there."""
    from psfcore.transit.evaluation_plot import evaluation_png
    from psfcore.transit.evaluation_report import lines, report

    _check_writable(json_file, plot)
    with user_errors(), _progress() as say:
        psf = None if psf_file == NO_PSF else _psf(Path(psf_file))
        transit = _transit(folder, noise, fits=psf is None or dark_offsets, progress=say)
        _check_scale(transit, psf)
        nominal = None
        if psf is None:
            evaluation, nominal, about = _held_out(transit, say)
        else:
            evaluation, about = _with(transit, psf, Path(psf_file), say)
        study = None
        if dark_offsets:
            from psfcore.scatter.dark_offsets import dark_offset_study

            study = dark_offset_study(transit, nominal=nominal, threads=THREADS, progress=say)
        found = report(evaluation, study)
    said = f"{about['sentence']}; {len(transit.frames)} images of {folder.resolve().name}"
    try:
        if plot is not None:
            evaluation_png(evaluation, plot, title=said, study=study)
        if json_file is not None:
            whole = {"psf": about, "software_version": software_version(), **found}
            json_file.write_text(json.dumps(whole, indent=1, allow_nan=False) + "\n")
    except OSError as error:
        raise click.ClickException(f"cannot write the result: {error.strerror or error}") from error
    click.echo(said)
    click.echo("\n".join(lines(evaluation, study)))


COMMANDS = (evaluate,)


def _held_out(transit: Transit, say: Report) -> tuple[Evaluation, Inversion, dict[str, Any]]:
    """Every image with the PSF of the fold that holds it out; the fit to all images; what was done."""
    from psfcore.scatter.fold_fits import fold_kernels
    from psfcore.scatter.inversion import invert
    from psfcore.transit.evaluation import evaluate as evaluated

    whole = invert(transit, threads=THREADS, progress=say).inversion
    kernels = fold_kernels(transit, whole.shape, start=whole.coordinates, threads=THREADS, progress=say)
    evaluation = evaluated(transit, kernels, threads=THREADS, progress=say)
    about = {
        "sentence": f"each image with a PSF fitted without it and its neighbours ({len(kernels.fits)} folds)",
        "held_out": True,
        "shape": whole.shape.name,
        "parameters": whole.values,
        "folds": _folds_json(transit, kernels),
    }
    return evaluation, whole, about


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
    from psfcore.transit.evaluation import evaluate as evaluated

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
    from psfcore.fits_io import read_psf

    if not file.is_file():
        raise click.BadParameter(
            f"expected a PSF file, or {NO_PSF}; there is no file {file}", param_hint="--psf"
        )
    return read_psf(file, _limits(), parts=False)


def _transit(folder: Path, noise: tuple[float, float] | None, *, fits: bool, progress: Report) -> Transit:
    """The transit, its diffraction built where transit.json names none and a fit needs one."""
    from psfcore.noise import Noise
    from psfcore.transit.folder import read_transit

    return read_transit(
        folder,
        _limits(),
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


def _limits() -> FitsLimits:
    return FitsLimits(max_pixels=Settings.model_fields["max_pixels"].default)


def _check_writable(*files: Path | None) -> None:
    """Say so before the work, not after it, where a result could not be written."""
    for file in files:
        if file is not None and not file.resolve().parent.is_dir():
            raise click.ClickException(f"cannot write {file}: there is no folder {file.resolve().parent}")


@contextmanager
def _progress() -> Iterator[Report]:
    """What is being done, on a terminal; nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda stage, step, steps: None
        return

    def report(stage: str, step: int, steps: int) -> None:
        sys.stderr.write(f"\r{stage:<40.40} {step}/{steps}    ")
        sys.stderr.flush()

    try:
        yield report
    finally:
        sys.stderr.write("\n")
