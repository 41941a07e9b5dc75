"""The commands ``psf published`` and ``psf get``: PSFs that others published, by name."""

from __future__ import annotations

from pathlib import Path

import click

from psfcore.published_psfs import PUBLISHED, get, published
from service.cli.options import FOLDER, progress_bar, user_errors
from service.cli.progress import echo
from workers.machine import published_folder

NAMES = click.argument("names", metavar="NAME...", nargs=-1, required=True)
SOURCE = click.option(
    "--from",
    "source",
    type=FOLDER,
    help="Folder with the published files, for machines without internet [default: download them]",
)


@click.command("published")
def list_published() -> None:
    """List published PSFs: name, telescope, channel, size, contents, and the publication to cite.

    A * marks those that `heliopsf psf get` brought to this machine.
    """
    for one in PUBLISHED.values():
        there = "*" if (published_folder() / f"{one.name}.fits").is_file() else " "
        size = f"{one.size_px} px" + (f", {one.file_mib} MiB" if one.file_mib else "")
        echo(
            f"{there} {one.name:<16} {one.telescope:<13} {one.channel:<6}  {size:<16} {one.contains}\n"
            f"    {one.citation}; DOI {one.doi or 'unknown'}"
            + ("" if one.addresses else f"; no public address, get {one.file} from {one.place}")
        )


@click.command("get")
@NAMES
@SOURCE
def get_psfs(names: tuple[str, ...], source: Path | None) -> None:
    """Bring published PSFs, whose names then stand for them: `heliopsf deconvolve --psf NAME`.

    A broken download is tried again. The SHA-256 of the file is recorded at the first time and compared afterwards.
    HELIOPSF_CACHE_DIR names the folder that keeps them; several machines may share it.
    """
    for name in names:
        brought(name, source)
        echo(f"next: `heliopsf deconvolve IMAGE --psf {name} --local -o PRODUCT.fits`")


def brought(name: str, source: Path | None) -> Path:
    """The file of a published PSF, which is brought first if it is not there; says where it is and how to cite it."""
    with user_errors(), progress_bar() as report:
        file = get(published_folder(), name, source=source, progress=report)
    one = published(name)
    echo(f"{file}: PSF {one.name}, {one.telescope} {one.channel}")
    echo(f"  cite {one.citation}" + ("" if one.doi is None else f"; doi:{one.doi}"))
    return file
