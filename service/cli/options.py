"""Code that commands share: options, settings, errors in one line, checks of output files, and a progress bar.

This file imports no numerical libraries, so that commands start fast.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click
from pydantic import ValidationError

from psfcore.errors import DataError
from service.cli.progress import progress_bar as progress_bar
from service.client.errors import ServiceError
from workers.contract.methods import Method

if TYPE_CHECKING:
    from psfcore.fits.header import FitsLimits
    from workers.settings import Settings

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
OUTPUT = click.Path(dir_okay=False, path_type=Path)
OUTPUT_FOLDER = click.Path(file_okay=False, path_type=Path)
METHODS = [get_args(kind.model_fields["name"].annotation)[0] for kind in get_args(get_args(Method)[0])]

METHOD = click.option(
    "--method", type=click.Choice(METHODS), default=METHODS[0], show_default=True, help="Deconvolution method"
)
STEPS = click.option(
    "--steps",
    type=click.IntRange(1, 200),
    help="Number of iterations [default: depends on the method; Richardson-Lucy: 20]",
)
NOISE = click.option(
    "--noise",
    nargs=2,
    type=float,
    metavar="GAIN READ",
    help="Photon gain (DN per photon) and read noise (DN rms) of the camera",
)
SATURATION = click.option(
    "--saturation",
    "saturation_dn",
    type=float,
    metavar="DN",
    help="Pixels at or above this level are saturated and are ignored",
)
CENTRE = click.option(
    "--centre", nargs=2, type=float, metavar="X Y", help="Position of the flare, px [default: found]"
)
BACKGROUND = "Image of the same frame before the flare (FITS)"
SEED = click.option(
    "--seed", type=click.IntRange(0, 2**31 - 1), default=1, show_default=True, help="Seed of random numbers"
)
JSON = click.option("--json", "json_file", type=OUTPUT, help="Write all numbers to this file (JSON)")
PLOT = click.option("--plot", type=OUTPUT, help="Write a plot to this file (PNG)")
DATA = click.option(
    "--data",
    type=OUTPUT_FOLDER,
    help="Data folder [default: HELIOPSF_DATA_DIR, else the data folder of the user]",
)


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn an error of the user's data, files or service into one line and an exit status, without a traceback."""
    try:
        yield
    except DataError as error:
        raise click.ClickException(error.message) from error
    except (ServiceError, OSError) as error:
        raise click.ClickException(str(error)) from error


def check_writable(*paths: Path | None) -> None:
    """Raise ``ClickException`` before the work starts if the folder of an output file does not exist."""
    for path in paths:
        if path is not None and not path.resolve().parent.is_dir():
            raise click.ClickException(f"cannot write {path}: there is no folder {path.resolve().parent}")


def check_fresh_folder(folder: Path, *, force: bool = False) -> None:
    """Raise ``ClickException`` if an output folder cannot be made, or holds files and ``force`` is false."""
    if not force and folder.is_dir() and any(folder.iterdir()):
        raise click.ClickException(f"{folder} is not empty; name another folder, or use --force")
    check_writable(folder)


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path``, if a path is given. Raises ``ClickException`` if the file cannot be written."""
    if path is None:
        return
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise click.ClickException(f"cannot write {path}: {error.strerror or error}") from error


def fits_files(paths: Sequence[Path]) -> list[Path]:
    """The named files, each once. A folder is replaced by the FITS files in it, sorted by name."""
    found: list[Path] = []
    for path in paths:
        found += sorted(one for one in path.iterdir() if _is_fits(one)) if path.is_dir() else [path]
    return list(dict.fromkeys(found))


def _is_fits(path: Path) -> bool:
    return path.name.lower().endswith((".fits", ".fits.gz", ".fts", ".fit"))


def percent(value: float | None, digits: int = 1) -> str:
    """A relative change as text; None: the reference has no light."""
    return "n/a (no light)" if value is None else f"{value:+.{digits}f} %"


def read_settings(data: Path | None = None) -> Settings:
    """The operator's settings; ``data`` replaces the data folder. Raises ``ClickException`` for wrong values."""
    from workers.settings import Settings

    try:
        return Settings() if data is None else Settings(data_dir=data)
    except ValidationError as error:
        faults = (
            f"HELIOPSF_{str(e['loc'][0]).upper()}: {e['msg']}; got {e['input']!r}" for e in error.errors()
        )
        raise click.ClickException("; ".join(faults)) from error


def data_settings(data: Path | None) -> Settings:
    """The settings of a command that opens the data folder. It tells the user if this is the folder of an earlier version."""
    from workers.data_folder import told

    settings = read_settings(data)
    note = None if "data_dir" in settings.model_fields_set else told()
    if note is not None:
        click.echo(note, err=True)
    return settings


def limits() -> FitsLimits:
    """The limits on FITS files that a command reads, from HELIOPSF_MAX_PIXELS."""
    from psfcore.fits.header import FitsLimits

    return FitsLimits(max_pixels=read_settings().max_pixels)
