"""What the commands share: options, limits and settings, one-line errors, results written, progress on a terminal.

Nothing numerical is imported here, so that the commands start fast.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import click
from pydantic import ValidationError

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from service.client.http import ServiceError
from workers.contract.methods import Method
from workers.settings import Settings

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
OUTPUT = click.Path(dir_okay=False, path_type=Path)
OUTPUT_FOLDER = click.Path(file_okay=False, path_type=Path)
METHODS = [get_args(kind.model_fields["name"].annotation)[0] for kind in get_args(get_args(Method)[0])]

NOISE = click.option(
    "--noise", nargs=2, type=float, metavar="GAIN READ", help="DN a photon, DN rms of the readout"
)
SATURATION = click.option(
    "--saturation", "saturation_dn", type=float, help="DN from which a pixel is not trusted"
)
PLOT = click.option("--plot", type=OUTPUT, help="Write a picture (PNG)")

Report = Callable[[str, int, int], None]


@contextmanager
def user_errors() -> Iterator[None]:
    """What is wrong with the user's data, files or service as one line and an exit status, without a traceback."""
    try:
        yield
    except DataError as error:
        raise click.ClickException(error.message) from error
    except (ServiceError, OSError) as error:
        raise click.ClickException(str(error)) from error


def check_writable(*paths: Path | None) -> None:
    """Say so before the work, not after it, where a result could not be written: ``ClickException``."""
    for path in paths:
        if path is not None and not path.resolve().parent.is_dir():
            raise click.ClickException(f"cannot write {path}: there is no folder {path.resolve().parent}")


def check_fresh_folder(folder: Path, *, force: bool = False) -> None:
    """Raise ``ClickException`` where a folder to fill cannot be made, or holds something and ``force`` is not said."""
    if not force and folder.is_dir() and any(folder.iterdir()):
        raise click.ClickException(f"{folder} is not empty: name another folder, or say --force")
    check_writable(folder)


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Write ``content`` where a path is given; ``ClickException`` where that cannot be done."""
    if path is None:
        return
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise click.ClickException(f"cannot write {path}: {error.strerror or error}") from error


def read_settings(data: Path | None = None) -> Settings:
    """The operator's settings, on a data folder where one is named; ``ClickException`` says which are wrong."""
    try:
        return Settings() if data is None else Settings(data_dir=data)
    except ValidationError as error:
        faults = (
            f"HELIOPSF_{str(e['loc'][0]).upper()}: {e['msg']}; got {e['input']!r}" for e in error.errors()
        )
        raise click.ClickException("; ".join(faults)) from error


def limits() -> FitsLimits:
    """What is read of FITS files: as much as the settings let a service take."""
    return FitsLimits(max_pixels=read_settings().max_pixels)


@contextmanager
def progress_bar() -> Iterator[Report]:
    """A bar on a terminal, with the time it will take; nothing where the output is no terminal."""
    if not sys.stderr.isatty():
        yield lambda stage, step, steps: None
        return
    lock = threading.Lock()
    started = time.monotonic()

    def report(stage: str, step: int, steps: int) -> None:
        filled = round(20 * step / max(steps, 1))
        bar = "#" * filled + "-" * (20 - filled)
        elapsed = time.monotonic() - started
        left = f", {elapsed * (steps - step) / step:.0f} s left" if step else ""
        with lock:
            sys.stderr.write(f"\r{stage:<32.32} [{bar}] {step}/{steps}  {elapsed:5.1f} s{left:<14}")
            sys.stderr.flush()

    try:
        yield report
    finally:
        sys.stderr.write("\n")
