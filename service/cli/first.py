"""What ``heliopsf`` prints without arguments: up to three commands that fit the files of the folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from shlex import quote

from psfcore.files import FITS_ENDING, fits_in
from service.cli.progress import printable

MOST_ENTRIES, MOST_FOLDERS = 1000, 100  # that are looked at
MOST_COMMANDS = 3
HEADER_BYTES = 28_800  # ten blocks of a FITS file, 360 cards
# Cards of files that are not images of a telescope: products of heliopsf, and PSFs.
NO_IMAGE_CARDS = (b"PSFID   =", b"PRODID  =", b"PSFSUM  =")

WITHOUT_FILES = [
    ("heliopsf demo", "deconvolves a simulated image"),
    ("heliopsf serve", "starts the page, where you drop images"),
    ("heliopsf deconvolve IMAGE.fits -o OUT.fits --local", "deconvolves your image"),
]


def first_screen(folder: Path) -> str:
    """The text for a folder. Raises OSError if the folder cannot be read."""
    commands = list(islice(_fitting(folder), MOST_COMMANDS))
    intro = "For the files of this folder:" if commands else "This folder has no FITS images. To begin:"
    rows = commands or WITHOUT_FILES
    width = max(len(command) for command, _ in rows)
    lines = [f"  {printable(command):<{width}}  {purpose}" for command, purpose in rows]
    return "\n".join([intro, *lines, "", "All commands: heliopsf -h"])


def _fitting(folder: Path) -> Iterator[tuple[str, str]]:
    """Commands for what lies in the folder, and what they do: for transits, for images, and for folders of images."""
    entries = sorted(islice(folder.iterdir(), MOST_ENTRIES))
    folders = [one for one in entries if one.is_dir() and not one.name.startswith(".") and _readable(one)]
    places = [folder, *folders[:MOST_FOLDERS]]
    transits = [place for place in places if (place / "transit.json").is_file()]
    for place in transits[:1]:
        name = _name(place, folder)
        yield f"heliopsf report {name} -o report.html --local", "fits a PSF to the transit and tests it"
        yield f"heliopsf gap {name} -o gap.html --local", "finds why a fitted PSF and the transit differ"
    for place in places:
        images = [] if place in transits else list(islice(_images(place), 2))
        if len(images) == 1:
            name, output = _name(images[0], folder), quote(f"{_stem(images[0])}-deconvolved.fits")
            yield f"heliopsf deconvolve {name} -o {output} --local", "deconvolves the image"
        elif images:
            yield (
                f"heliopsf deconvolve {_name(place, folder)} -o deconvolved/ --local",
                "deconvolves the images of the folder",
            )


def _images(folder: Path) -> Iterator[Path]:
    """FITS files of a folder that can be images of a telescope, by the endings of their names and by their headers."""
    return (one for one in fits_in(folder) if one.is_file() and _readable(one) and _can_be_image(one))


def _readable(path: Path) -> bool:
    """Whether this user may read a file, or list a folder and open its files."""
    return os.access(path, os.R_OK | (os.X_OK if path.is_dir() else 0))


def _can_be_image(path: Path) -> bool:
    with path.open("rb") as file:
        start = file.read(HEADER_BYTES)
    cards = {start[place : place + 9] for place in range(0, len(start), 80)}
    return cards.isdisjoint(NO_IMAGE_CARDS)


def _name(path: Path, folder: Path) -> str:
    """How a command names a path in the folder."""
    name = str(path.relative_to(folder))
    return quote(f"./{name}" if name.startswith("-") else name)


def _stem(path: Path) -> str:
    return FITS_ENDING.sub("", path.name)
