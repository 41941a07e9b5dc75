"""The commands ``psf query``, ``psf cutout`` and ``psf rebin``, for a PSF in a file or on a service.

For a file the tables are computed in this process; for an id the service reads its stored tables. Both give the same answers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psfcore.tables import lookup
from service.cli.connection import ID_OR_FILE, SERVER_FOR_IDS, is_psf_id, psf_file, remote, whole_id
from service.cli.options import JSON, OUTPUT, limits, user_errors, write_json, writes_files
from service.client.outputs import written

if TYPE_CHECKING:
    from psfcore.psf import Psf

SHOWN_RADII_PX = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


@click.command("query")
@click.argument("psf", type=ID_OR_FILE, metavar="ID|FILE")
@click.option("--radius", "radii", multiple=True, type=float, help="Radius, px; can be repeated")
@click.option(
    "--annulus", nargs=2, type=float, metavar="INNER OUTER", help="Show the light between two radii, px"
)
@click.option("--profile", is_flag=True, help="Also show the mean weight by radius")
@click.option(
    "--compare",
    type=ID_OR_FILE,
    metavar="ID|FILE",
    help="Compare with this PSF; shows this PSF minus the first",
)
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
    server: str | None,
    overwrite: bool,
) -> None:
    """Show the light of a PSF beyond radii or in an annulus, and the difference from another PSF."""
    answers: dict[str, Any] = {}
    with user_errors(), _asking(server, psf, compare) as ask:
        if radii or not (annulus or profile or compare):
            reach = ask(psf, "encircled", radius=0.0)["reach_px"]
            wanted = list(radii) or [r for r in SHOWN_RADII_PX if r <= reach]
            answers["curve"] = ask(psf, "curve", radii=wanted)
        if annulus is not None:
            answers["annulus"] = ask(psf, "annulus", inner=annulus[0], outer=annulus[1])
        if profile:
            answers["profile"] = ask(psf, "profile")
        if compare is not None:
            answers["compare"] = ask(psf, f"compare/{compare}")
    for name, lines in _LINES.items():
        if name in answers:
            click.echo("\n".join(lines(answers[name])))
    write_json(json_file, answers, overwrite=overwrite)


@click.command("cutout")
@click.argument("psf", type=ID_OR_FILE, metavar="ID|FILE")
@click.option(
    "--size", required=True, type=click.IntRange(1), help="Width and height of the part to write, px"
)
@click.option("-o", "--output", required=True, type=OUTPUT, help="Write the part (FITS)")
@SERVER_FOR_IDS
@writes_files
def cutout(psf: str, size: int, output: Path, server: str | None, overwrite: bool) -> None:
    """Write the central part of a PSF, not renormalised. If the PSF is a file, the components are written too."""
    from psfcore.psf import central_part

    with user_errors():
        if is_psf_id(psf):
            with remote(server) as service:
                service.psf_cutout(psf, size, output, overwrite=overwrite)
        else:
            _write(output, central_part(_read(psf), size), overwrite)
    click.echo(f"{output}: central {size} x {size} px")


@click.command("rebin")
@click.argument("psf", type=ID_OR_FILE, metavar="ID|FILE")
@click.option("--factor", required=True, type=click.IntRange(2), help="Pixels per binned pixel, on each axis")
@click.option("-o", "--output", required=True, type=OUTPUT, help="Write the binned PSF (FITS)")
@SERVER_FOR_IDS
@writes_files
def rebin(psf: str, factor: int, output: Path, server: str | None, overwrite: bool) -> None:
    """Write the PSF for images that are binned by FACTOR x FACTOR pixels."""
    from psfcore.psf_sampling import rebinned

    with user_errors(), psf_file(server, psf) as file:
        binned = rebinned(_read(str(file)), factor)
        _write(output, binned, overwrite)
    ny, nx = binned.kernel.shape
    click.echo(f"{output}: {binned.name} {binned.version}, {nx} x {ny} px of {factor} x {factor}")


COMMANDS = (query, cutout, rebin)


@contextmanager
def _asking(server: str | None, *psfs: str | None) -> Iterator[Callable[..., dict[str, Any]]]:
    """A function that answers queries about the named PSFs: the service answers for ids; for files the tables are computed here."""
    ids = [psf for psf in psfs if psf is not None and is_psf_id(psf)]
    files = [psf for psf in psfs if psf is not None and not is_psf_id(psf)]
    if ids and files:
        raise click.UsageError(
            "expected two PSF ids or two files; got an id and a file. Upload the file first: heliopsf psf upload FILE"
        )
    if not ids:
        tables = {file: _tables(file) for file in files}

        def ask_files(psf: str, question: str, **wanted: Any) -> dict[str, Any]:
            name, _, other = question.partition("/")
            if other:
                return lookup.compare(tables[psf], tables[other])
            return lookup.QUESTIONS[name](tables[psf], **wanted)

        yield ask_files
        return
    with remote(server) as service:
        whole = {psf: whole_id(service, "psfs", psf) for psf in ids}

        def ask_service(psf: str, question: str, **wanted: Any) -> dict[str, Any]:
            name, _, other = question.partition("/")
            if other:
                return service.compare_psfs(whole[psf], whole[other])
            return service.answer([whole[psf]], name, wanted)

        yield ask_service


def _tables(file: str) -> dict[str, Any]:
    from psfcore.tables.make import tables_of

    return tables_of(_read(file))


def _read(file: str) -> Psf:
    from psfcore.fits.psfs import read_psf

    return read_psf(file, limits())


def _write(output: Path, psf: Psf, overwrite: bool) -> None:
    from psfcore.fits.psfs import write_psf

    text = psf.provenance.get("instrument_toml")
    with written(output, overwrite=overwrite) as partial:
        write_psf(partial, psf, instrument_file=None if text is None else text.encode())


def _curve_lines(answer: dict[str, Any]) -> list[str]:
    curves, sigma = answer["light_beyond_pct"], answer["sigma_points"]
    lines = [
        f"{answer['name']} {answer['version']}, sum {answer['sum_on_array']:.6f} on {answer['shape'][1]} x "
        f"{answer['shape'][0]} px, central pixel {answer['central_weight']:.4f}",
        "light beyond R, or outside the array, in percent:",
        f"{'R (px)':>10}" + "".join(f"{name:>{_width(name, sigma)}}" for name in curves),
    ]
    for n, radius in enumerate(answer["radii_px"]):
        values = (_with_sigma(curves[name][n], sigma.get(name, [None] * (n + 1))[n]) for name in curves)
        lines.append(
            f"{radius:>10g}"
            + "".join(f"{v:>{_width(k, sigma)}}" for k, v in zip(curves, values, strict=True))
        )
    return [*lines, f"({answer['resolution']})"]


def _width(name: str, sigma: dict[str, Any]) -> int:
    return 22 if name in sigma else 15


def _with_sigma(value: float, sigma: float | None) -> str:
    return f"{value:.3f}" if sigma is None else f"{value:.3f} ± {sigma:.3f}"


def _annulus_lines(answer: dict[str, Any]) -> list[str]:
    lines = [f"light between {answer['inner_px']:g} and {answer['outer_px']:g} px, in percent of all light:"]
    for name, light in answer["light"].items():
        sigma = answer["sigma"].get(name)
        lines.append(f"  {name:<14} {_with_sigma(100 * light, None if sigma is None else 100 * sigma)}")
    return [*lines, f"({answer['resolution']})"]


def _profile_lines(answer: dict[str, Any]) -> list[str]:
    weights = answer["mean_weight"]
    lines = ["mean weight of a pixel:", f"{'R (px)':>10}" + "".join(f"{name:>15}" for name in weights)]
    for n, radius in enumerate(answer["radius_px"]):
        if radius <= 20 or radius % 10 == 0:
            lines.append(f"{radius:>10g}" + "".join(f"{row[n]:>15.4e}" for row in weights.values()))
    return lines


def _compare_lines(answer: dict[str, Any]) -> list[str]:
    one, other = answer["one"], answer["other"]
    lines = [
        f"{other['name']} {other['version']} minus {one['name']} {one['version']}: sum {answer['difference_of_sums']:+.6f}, "
        f"central pixel {answer['difference_of_central_weights']:+.5f}; light beyond R in percentage points:"
    ]
    points = answer["difference_points"]
    lines.append(f"{'R (px)':>10}" + "".join(f"{name:>15}" for name in points))
    shown = [n for n, r in enumerate(answer["radii_px"]) if r in (0.0, *SHOWN_RADII_PX)]
    for n in shown:
        radius = answer["radii_px"][n]
        lines.append(f"{radius:>10g}" + "".join(f"{row[n]:>+15.3f}" for row in points.values()))
    lines.append(
        f"{'largest':>10}" + "".join(f"{most:>+15.3f}" for most in answer["largest_points"].values())
    )
    return lines


_LINES = {
    "curve": _curve_lines,
    "annulus": _annulus_lines,
    "profile": _profile_lines,
    "compare": _compare_lines,
}
