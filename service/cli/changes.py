"""The command ``effects``: many images deconvolved in one run, their changes in a table, the doubtful ones first.

Everything numerical is imported when it is called, so that other commands start fast.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psfcore.fits.header import read_summary
from service.cli.options import (
    METHODS,
    NOISE,
    OUTPUT_FOLDER,
    SATURATION,
    limits,
    progress_bar,
    read_settings,
    user_errors,
    write_json,
)
from workers.settings import software_version

if TYPE_CHECKING:
    from collections.abc import Callable

    from psfcore.deconvolve.assess.contact_sheet import Treated
    from psfcore.noise import Noise
    from psfcore.psf import Psf

TABLE, SHEET = "effects.json", "contact-sheet.png"


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--psf", "psf_name", default="auto", show_default=True, metavar="FILE|auto", help="auto: the instrument's"
)
@click.option("-o", "--output", required=True, type=OUTPUT_FOLDER, help="Folder")
@click.option("--method", type=click.Choice(METHODS), default=METHODS[0], show_default=True)
@click.option(
    "--steps", type=click.IntRange(1, 200), help="Steps [default: the method's; Richardson-Lucy 20]"
)
@NOISE
@SATURATION
@click.option(
    "--most", default=60, show_default=True, type=click.IntRange(1, 200), help="Images on the contact sheet"
)
@click.option("--threads", type=click.IntRange(1), help="[default: the settings']")
def effects(
    images: tuple[Path, ...],
    psf_name: str,
    output: Path,
    method: str,
    steps: int | None,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    most: int,
    threads: int | None,
) -> None:
    """Deconvolve IMAGES (files, or folders of FITS files), tabulate what changed, and draw a contact sheet.

    Writes effects.json and contact-sheet.png to the output folder. The images that the artefact check finds most
    doubtful come first; those that cannot be deconvolved are listed with the reason, and stop nothing.
    """
    from psfcore.deconvolve.assess.contact_sheet import contact_sheet_png, table, treat_many

    files = _files(images)
    threads = threads or read_settings().threads
    with user_errors():
        psf_for = _psf_chooser(psf_name, threads)
        output.mkdir(parents=True, exist_ok=True)
    with progress_bar() as report:
        treated, failures = treat_many(
            files,
            lambda name: _treat(Path(name), psf_for, method, steps, noise, saturation_dn, threads),
            progress=lambda done, of: report("images", done, of),
        )
    content = table(treated, failures) | {
        "method": {"name": method, "steps": steps},
        "software_version": software_version(),
        "inputs_sha256": {row.name: _sha256(Path(row.name)) for row in treated},
    }
    write_json(output / TABLE, content)
    contact_sheet_png(treated, failures, output / SHEET, most=most)
    click.echo("\n".join(_lines(content)))
    click.echo(f"{output / TABLE}, {output / SHEET}")
    if not treated:
        raise click.ClickException("none of the images could be deconvolved")


COMMANDS = (effects,)


def _treat(
    path: Path,
    psf_for: Callable[[Path], Psf],
    method: str,
    steps: int | None,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    threads: int,
) -> Treated:
    from psfcore.deconvolve.assess.contact_sheet import treat
    from psfcore.deconvolve.conditions import Conditions
    from psfcore.fits.images import read_image
    from psfcore.noise import Noise

    psf = psf_for(path)
    known_noise, known_saturation = _known_figures(path)
    image = read_image(path, limits(), saturation_dn=saturation_dn or known_saturation)
    conditions = Conditions(
        noise=Noise(*noise) if noise else known_noise, threads=threads, engine_for=_engines()
    )
    given = {} if steps is None else {"steps": steps}
    return treat(str(path), image, psf, method=method, conditions=conditions, **given)


def _psf_chooser(psf_name: str, threads: int) -> Callable[[Path], Psf]:
    """The PSF of an image: the file that was named, read once, or that of its instrument, built once."""
    from psfcore.build import build_psf
    from psfcore.errors import DataError
    from psfcore.fits.psfs import read_psf
    from psfcore.instruments.model import load_instrument

    @cache
    def built(instrument: str) -> Psf:
        return build_psf(load_instrument(instrument), threads=threads)

    def of_instrument(path: Path) -> Psf:
        instrument = read_summary(path, limits()).instrument
        if instrument is None:
            raise DataError(
                "no-psf-for-instrument",
                "expected an image of an instrument known here; name a PSF with --psf",
            )
        return built(instrument)

    if psf_name == "auto":
        return of_instrument
    if not Path(psf_name).is_file():
        raise click.BadParameter(f"expected a file, or auto; got {psf_name!r}", param_hint="--psf")
    psf = read_psf(psf_name, limits(), parts=False)
    return lambda _path: psf


def _known_figures(path: Path) -> tuple[Noise | None, float | None]:
    """Noise and saturation of the image's gain mode, where the instrument's are known."""
    from astropy.io.fits import Header

    from psfcore.fits.gain import noise_for, saturation_for
    from psfcore.instruments.model import load_instrument

    summary = read_summary(path, limits())
    if summary.instrument is None or summary.gain_mode is None:
        return None, None
    instrument, mode = load_instrument(summary.instrument), Header({"GAINCOMB": summary.gain_mode})
    return noise_for(instrument, mode), saturation_for(instrument, mode)


@cache
def _engines() -> Any:
    from psfcore.deconvolve.conditions import EngineCache

    return EngineCache()


def _files(images: tuple[Path, ...]) -> list[str]:
    """Files as they were named, each once; of a folder the FITS files in it."""
    found: list[str] = []
    for path in images:
        inside = sorted(p for p in path.iterdir() if _is_fits(p)) if path.is_dir() else [path]
        found += [str(p) for p in inside]
    if not found:
        raise click.UsageError("expected FITS files; the folders named hold none")
    return list(dict.fromkeys(found))


def _is_fits(path: Path) -> bool:
    return path.name.lower().endswith((".fits", ".fits.gz", ".fts", ".fit"))


def _lines(content: dict[str, Any]) -> list[str]:
    lines = []
    for row in content["images"][:20]:
        changes = "  ".join(
            f"{kind} {row[kind]['sum_pct']:+6.1f} % (to {row[kind]['up_to_pct']:+.0f})"
            for kind in ("bright", "dark")
            if row[kind] is not None
        )
        lines.append(f"{row['score']:8.2f}  {changes}  {row['file']}")
    if len(content["images"]) > 20:
        lines.append(f"... and {len(content['images']) - 20} with lower scores")
    lines += [f"not deconvolved: {failure['name']}: {failure['reason']}" for failure in content["failures"]]
    summary = content["summary"]
    lines.append(
        f"{summary['images']} images, {summary['to_look_at']} to look at, {summary['failures']} not deconvolved"
    )
    return lines


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
