"""Commands that read PSFs: those that others published (``psf published``, ``psf get``), those in files or on a service
(``psf query``, ``cutout``, ``rebin``), and the built PSFs that are kept (``cache``).

For a file the tables are computed in this process; for an id the service reads its stored tables. Both give the same
answers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psfcore.instruments.published import PUBLISHED
from psfcore.published_psfs import get, published
from psfcore.tables import lookup
from service.cli.connection import ID_OR_FILE, SERVER_FOR_IDS, is_psf_id, psf_file, remote, short, whole_id
from service.cli.options import (
    FOLDER,
    JSON,
    OUTPUT,
    psf_limits,
    write_json,
    writes_files,
)
from service.cli.progress import echo, moment, progress_bar
from service.client.outputs import written
from workers.machine import psf_cache, published_folder

if TYPE_CHECKING:
    from psfcore.psf import Psf
    from service.client.answers import AnnulusAnswer, ComparisonAnswer, CurveAnswer, ProfileAnswer
_MIB = 2**20
PSF = click.argument("psf", type=ID_OR_FILE, metavar="ID|FILE")
SHOWN_RADII_PX = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
NAMES = click.argument("names", metavar="NAME...", nargs=-1, required=True)
SOURCE = click.option(
    "--from",
    "source",
    type=FOLDER,
    help="Folder with the published files, for machines without internet [default: download them]",
)


# --- published PSFs -------------------------------------------------------------------------------------


@click.command("published")
def list_published() -> None:
    """List published PSFs: name, telescope, channel, size, contents, and the publication to cite.

    A * marks those that `heliopsf psf get` brought to this machine.
    """
    for one in PUBLISHED.values():
        there = "*" if (published_folder() / f"{one.name}.fits").is_file() else " "
        size = f"{one.size_px} px" + (f", {one.file_mib} MiB" if one.file_mib else "")
        echo(
            f"{there} {one.name:<16} {one.telescope:<13} {one.channel:<6}  {size:<16}  {one.contains}\n"
            f"    {one.citation}; DOI {one.doi or 'unknown'}"
            + ("" if one.addresses else f"; no public address, get {one.file} from {one.place}")
        )


@click.command("get")
@click.argument("names", metavar="[NAME]...", nargs=-1)
@SOURCE
@click.pass_context
def get_psfs(ctx: click.Context, names: tuple[str, ...], source: Path | None) -> None:
    """Bring published PSFs, whose names then stand for them: `heliopsf deconvolve --psf NAME`. Without a name: list
    them.

    A broken download is tried again; it is kept only if it has the published checksum. HELIOPSF_CACHE_DIR names the
    folder that keeps them; several machines may share it.
    """
    if not names:
        ctx.invoke(list_published)
    for name in names:
        brought(name, source)
        echo(f"next: `heliopsf deconvolve IMAGE --psf {name} --local -o PRODUCT.fits`")


def brought(name: str, source: Path | None) -> Path:
    """The file of a published PSF, which is brought first if it is not there; says where it is and how to cite it."""
    with progress_bar() as report:
        file = get(published_folder(), name, source=source, progress=report)
    one = published(name)
    echo(f"{file}: PSF {one.name}, {one.telescope} {one.channel}")
    if source is not None and one.sha256 is None:
        echo(f"  not compared with a checksum, because none of {one.file} is known here")
    echo(f"  cite {one.citation}" + ("" if one.doi is None else f"; doi:{one.doi}"))
    return file


# --- PSFs in files or on a service -----------------------------------------------------------------------


@click.command("query")
@PSF
@click.option("--radius", "radii", multiple=True, type=float, help="Radius, px; can be repeated")
@click.option(
    "--annulus", nargs=2, type=float, metavar="INNER OUTER", help="Show the light between two radii, px"
)
@click.option("--profile", is_flag=True, help="Also show the mean weight by radius")
@click.option("--compare", type=ID_OR_FILE, metavar="ID|FILE",
              help="Compare with this PSF; shows this PSF minus the first")  # fmt: skip
@JSON
@SERVER_FOR_IDS
@writes_files
def query(
    psf: str,
    radii: tuple[float, ...],
    annulus: tuple[float, float] | None,
    profile: bool,
    compare: str | None,
    json_file: Path | None,
    overwrite: bool,
) -> None:
    """Show the light of a PSF beyond radii or in an annulus, and the difference from another PSF."""
    answers: dict[str, object] = {}
    with _asking(psf, compare) as ask:
        if radii or not (annulus or profile or compare):
            reach_px = ask["encircled"](radius=0.0)["reach_px"]
            shown = list(radii) or [r for r in SHOWN_RADII_PX if r <= reach_px]
            answers["curve"] = ask["curve"](radii=shown)
        if annulus is not None:
            answers["annulus"] = ask["annulus"](inner=annulus[0], outer=annulus[1])
        if profile:
            answers["profile"] = ask["profile"]()
        if compare is not None:
            answers["compare"] = ask["compare"]()
    for name, answer in answers.items():
        echo("\n".join(_LINES[name](answer)))
    write_json(json_file, answers, overwrite=overwrite)


@click.command("cutout")
@PSF
@click.option(
    "--size", required=True, type=click.IntRange(1), help="Width and height of the part to write, px"
)
@click.option("-o", "--output", required=True, type=OUTPUT, help="Write the part (FITS)")
@SERVER_FOR_IDS
@writes_files
def cutout(psf: str, size: int, output: Path, overwrite: bool) -> None:
    """Write the central part of a PSF, not renormalised. If the PSF is a file, the components are written too."""
    from psfcore.psf import central_part

    if is_psf_id(psf):
        with remote() as service:
            service.psf_cutout(psf, size, output, overwrite=overwrite)
    else:
        _write(output, central_part(_read(psf), size), overwrite)
    echo(f"{output}: central {size} x {size} px")


@click.command("rebin")
@PSF
@click.option("--factor", required=True, type=click.IntRange(2), help="Pixels per binned pixel, on each axis")
@click.option("-o", "--output", required=True, type=OUTPUT, help="Write the binned PSF (FITS)")
@SERVER_FOR_IDS
@writes_files
def rebin(psf: str, factor: int, output: Path, overwrite: bool) -> None:
    """Write the PSF for images that are binned by FACTOR x FACTOR pixels."""
    from psfcore.psf_sampling import rebinned

    with psf_file(psf) as file:
        binned = rebinned(_read(str(file)), factor)
        _write(output, binned, overwrite)
    ny, nx = binned.kernel.shape
    echo(f"{output}: {binned.name} {binned.version}, {nx} x {ny} px of {factor} x {factor}")


@click.group(short_help="List and remove built PSFs that are kept.")
def cache() -> None:
    """List and remove the built PSFs that are kept in your cache folder. No service is needed.

    Commands with --local and the Python functions build a PSF once and keep it there. HELIOPSF_CACHE_DIR names another
    folder, HELIOPSF_CACHE_MIB the largest size (default: 2048; 0: keep nothing). A service keeps its PSFs in its own
    data folder.
    """


@cache.command("list", short_help="List the PSFs that are kept.")
def list_cached() -> None:
    """List the PSFs that are kept, the last used first: id, size, last use, instrument."""
    folder = psf_cache()
    psfs = folder.psfs()
    for psf in psfs:
        used = moment(psf.used_at, "%Y-%m-%dT%H:%M:%SZ")
        name = _named(folder.provenance(psf.identity))
        echo(f"{short(psf.identity)}  {psf.bytes / _MIB:8.1f} MiB  {used}  {name}")
    total = sum(psf.bytes for psf in psfs) / _MIB
    echo(f"{len(psfs)} PSFs, {total:.1f} of {folder.max_bytes // _MIB} MiB, in {folder.folder}")


@cache.command("clear", short_help="Remove all PSFs that are kept.")
def clear() -> None:
    """Remove all PSFs that are kept. A PSF is built again when it is needed."""
    folder = psf_cache()
    count, removed = len(folder.psfs()), folder.clear()
    echo(f"removed {count} PSFs, {removed / _MIB:.1f} MiB, from {folder.folder}")


def _named(provenance: Mapping[str, Any]) -> str:
    """The instrument, the size and the component of a PSF, from its provenance."""
    if not provenance:
        return "(incomplete)"
    parameters = provenance["parameters"]
    parts = [parameters.get("instrument", "your instrument file"), f"{parameters['size']} px"]
    return ", ".join([*parts, *filter(None, [parameters.get("component")])])


@contextmanager
def _asking(psf: str, other: str | None) -> Iterator[dict[str, Callable[..., Any]]]:
    """The functions that answer questions about a PSF, and compare it with another one: the service answers for ids;
    for files the tables are computed here.
    """
    psfs = [psf] if other is None else [psf, other]
    if len({is_psf_id(one) for one in psfs}) > 1:
        raise click.UsageError(
            "expected two PSF ids or two files; got an id and a file. Upload the file first: heliopsf psf upload FILE"
        )
    if not is_psf_id(psf):
        from psfcore.tables.make import tables_of

        tables = [tables_of(_read(file)) for file in psfs]
        of_first = {name: partial(question, tables[0]) for name, question in lookup.QUESTIONS.items()}
        yield of_first | {"compare": partial(lookup.compare, *tables)}
        return
    with remote() as service:
        ids = [whole_id(service, "psfs", one) for one in psfs]
        yield {
            "curve": partial(service.psf_curve, ids[0]),
            "profile": partial(service.psf_profile, ids[0]),
            "encircled": partial(service.psf_encircled, ids[0]),
            "annulus": partial(service.psf_annulus, ids[0]),
            "compare": partial(service.compare_psfs, *ids),
        }


def _read(file: str) -> Psf:
    from psfcore.fits.psfs import read_psf

    return read_psf(file, psf_limits())


def _write(output: Path, psf: Psf, overwrite: bool) -> None:
    from psfcore.fits.psfs import write_psf

    text = psf.provenance.get("instrument_toml")
    with written(output, overwrite=overwrite) as partial:
        write_psf(partial, psf, instrument_file=None if text is None else text.encode())


def _curve_lines(answer: CurveAnswer) -> list[str]:
    shape, sigma = answer["shape"], answer["sigma_points"]
    return [
        f"{answer['name']} {answer['version']}, sum {answer['sum_on_array']:.6f} on {shape[1]} x {shape[0]} px, "
        f"central pixel {answer['central_weight']:.4f}",
        "light beyond R, or outside the array, in percent:",
        *_table(
            [f"{radius:g}" for radius in answer["radii_px"]],
            {
                name: [
                    _with_sigma(*pair)
                    for pair in zip(curve, sigma.get(name, [None] * len(curve)), strict=True)
                ]
                for name, curve in answer["light_beyond_pct"].items()
            },
        ),
        f"({answer['resolution']})",
    ]


def _annulus_lines(answer: AnnulusAnswer) -> list[str]:
    lines = [f"light between {answer['inner_px']:g} and {answer['outer_px']:g} px, in percent of all light:"]
    for name, light in answer["light"].items():
        sigma = answer["sigma"].get(name)
        lines.append(f"  {name:<14} {_with_sigma(100 * light, None if sigma is None else 100 * sigma)}")
    return [*lines, f"({answer['resolution']})"]


def _profile_lines(answer: ProfileAnswer) -> list[str]:
    radii = answer["radius_px"]
    shown = [n for n, radius in enumerate(radii) if radius <= 20 or radius % 10 == 0]
    columns = {name: [f"{row[n]:.4e}" for n in shown] for name, row in answer["mean_weight"].items()}
    return ["mean weight of a pixel:", *_table([f"{radii[n]:g}" for n in shown], columns)]


def _compare_lines(answer: ComparisonAnswer) -> list[str]:
    one, other, radii = answer["one"], answer["other"], answer["radii_px"]
    shown = [n for n, radius in enumerate(radii) if radius in (0.0, *SHOWN_RADII_PX)]
    columns = {
        name: [f"{points:+.3f}" for points in (*(row[n] for n in shown), answer["largest_points"][name])]
        for name, row in answer["difference_points"].items()
    }
    return [
        f"{other['name']} {other['version']} minus {one['name']} {one['version']}: sum "
        f"{answer['difference_of_sums']:+.6f}, "
        f"central pixel {answer['difference_of_central_weights']:+.5f}; light beyond R in percentage points:",
        *_table([*(f"{radii[n]:g}" for n in shown), "largest"], columns),
    ]


def _table(radii: Sequence[str], columns: dict[str, list[str]]) -> list[str]:
    """Lines with a radius and the texts of all columns; the first line has the names of the columns."""
    widths = [22 if any("±" in text for text in texts) else 15 for texts in columns.values()]
    rows = [("R (px)", *columns), *zip(radii, *columns.values(), strict=True)]
    return [
        f"{radius:>10}" + "".join(f"{text:>{width}}" for text, width in zip(texts, widths, strict=True))
        for radius, *texts in rows
    ]


def _with_sigma(value: float, sigma: float | None) -> str:
    return f"{value:.3f}" if sigma is None else f"{value:.3f} ± {sigma:.3f}"


_LINES: dict[str, Callable[[Any], list[str]]] = {
    "curve": _curve_lines,
    "annulus": _annulus_lines,
    "profile": _profile_lines,
    "compare": _compare_lines,
}
