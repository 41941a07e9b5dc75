"""``heliopsf gap``: diagnoses where the fitted model and the images of a transit differ, and which effect explains the difference."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from service.cli.connection import LOCAL, SERVER, connection, named_psf, psf_option
from service.cli.fields import options_of
from service.cli.gap.blind import blind
from service.cli.gap.plan import plan
from service.cli.options import (
    DRAWN,
    JSON,
    OUTPUT,
    PLOT,
    progress_bar,
    user_errors,
    writes_files,
)
from service.cli.progress import echo
from workers.contract.requests import GapDiagnose

SHOWN = 3
UNKNOWN = "unknown"


class _DiagnosisByDefault(click.Group):
    """A group whose default command is ``diagnose``: ``heliopsf gap DIR`` means ``heliopsf gap diagnose DIR``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = ["diagnose", *args]
        return super().parse_args(ctx, args)


@click.group(
    cls=_DiagnosisByDefault,
    help="Find out why a fitted PSF and a transit differ. `heliopsf gap TRANSIT` is short for `heliopsf gap diagnose TRANSIT`. "
    "`heliopsf gap diagnose -h` lists its options.",
    short_help="Find why a fitted PSF and a transit differ.",
)
def gap() -> None:
    """The gap between a fitted model and the images of a transit."""


@gap.command(short_help="Find the effects that explain a gap.")
@click.argument("transit", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", type=DRAWN, help="Write the result as an HTML page")
@JSON
@PLOT
@psf_option(
    "PSF (an id or a file) with the shape and the start parameters of the fit [default: the default shape]"
)
@click.option(
    "--corrected",
    "corrected_file",
    type=OUTPUT,
    help="Write the corrected PSF (FITS): the PSF fitted with the answer in the model; for a tie, with the best effect",
)
@click.option(
    "--effects",
    metavar="FILE.py|MODULE[,...]",
    help="Also test the effects in these files, whose code is executed. Only with --local; in a service set HELIOPSF_GAP_EFFECTS",
)
@options_of(GapDiagnose, "coverage", "seed", "noise", "saturation_dn")
@SERVER
@LOCAL
@writes_files
def diagnose(
    transit: Path,
    output: Path | None,
    json_file: Path | None,
    plot: Path | None,
    psf: str | None,
    corrected_file: Path | None,
    effects: str | None,
    server: str | None,
    local: bool,
    overwrite: bool,
    **parameters: Any,
) -> None:
    """Diagnose the gap between TRANSIT and the model fitted to it: which effect explains the residuals.

    TRANSIT is a folder with a transit.json, or a .zip or .tar file of such a folder.
    """
    if effects is not None and not local:
        raise click.UsageError(
            "--effects: expected --local with it; a service tests the effects in HELIOPSF_GAP_EFFECTS"
        )
    with (
        user_errors(),
        TemporaryDirectory(prefix="heliopsf-") as folder,
        connection(server, local, gap_effects=effects or "") as service,
        progress_bar() as say,
    ):
        numbers = json_file or Path(folder) / "report.json"
        found = service.diagnose_gap(
            transit,
            numbers,
            page=output,
            preview=plot,
            progress=say,
            psf_id=named_psf(service, psf),
            # A service always makes the corrected PSF and keeps it, so that later requests find it.
            correct=corrected_file is not None or not local,
            overwrite=overwrite,
            **parameters,
        )
        report = json.loads(numbers.read_text("utf-8"))
        corrected = found["details"]["corrected_psf_id"]
        if corrected_file is not None and corrected is not None:
            service.download(f"/v1/psfs/{corrected}/file", corrected_file, overwrite=overwrite)
    echo("\n".join(_lines(report)))
    written = [str(path) for path in (output, json_file, plot) if path is not None]
    if corrected_file is not None and corrected is not None:
        written.append(str(corrected_file))
    if written:
        echo(f"written: {', '.join(written)}")
    step = _next_step(report, f"{transit}{' --local' if local else ''}", output, corrected_file)
    if step:
        echo(f"next: {step}")
    if corrected_file is not None and corrected is None:
        raise click.ClickException(
            f"{corrected_file} was not written: the diagnosis found no effect for a corrected PSF (verdict {report['verdict']})"
        )


def _next_step(report: dict[str, Any], transit: str, page: Path | None, corrected: Path | None) -> str:
    """What to do with this verdict, in one line; empty if there is nothing to do."""
    if report["verdict"] in ("attributed", "tie") and corrected is None:
        return f"`heliopsf gap {transit} --corrected PSF.fits` writes the PSF without the effect"
    if report["verdict"] in ("inconclusive", "tie"):
        return "`heliopsf gap plan PLAN` tells whether images that are not taken yet would decide"
    if report["verdict"] == "unknown":
        where = "-o PAGE.html writes a page with" if page is None else f"{page} has"
        return f"{where} the map or the curve of the unknown cause"
    return ""


def _lines(report: dict[str, Any]) -> list[str]:
    """The answer of the report as lines to print. The JSON and the page have all effects."""
    so_far = "most probable: " if report["verdict"] == "inconclusive" else ""
    answer = f" ({so_far}{', '.join(report['answer'])})" if report["answer"] else ""
    out = [report["sentence"], f"verdict: {report['verdict']}{answer}"]
    in_set = {" + ".join(names) for names in report["set"]["members"]}
    # The fields of an unknown cause follow as their own lines.
    named = [one for one in (*report["together"], *report["effects"]) if one["name"] in in_set - {UNKNOWN}]
    for effect in named[:SHOWN]:
        closure = effect["closure"]
        closed = "" if closure is None else f", held-out closure {100 * closure['value']:.0f} %"
        numbers = ", ".join(
            f"{name} {p['value']:.3g} ± {p['sigma']:.2g} {p['unit']}".strip()
            for name, p in effect["parameters"].items()
            if not name.rpartition(".")[2].startswith("bump_")
        )
        found = f"P = {effect['probability']:.2f}{closed}"
        out.append(f"  {effect['name']:<24} {found}{': ' if numbers else ''}{numbers}")
    if report["verdict"] != "none":
        out += [f"  looks like: {_field(one)}" for one in report["unknown"]["fields"]]
    if report["untestable"]:
        out.append(f"  not testable: {', '.join(one['name'] for one in report['untestable'])}")
    return out + [f"  caution: {caution}" for caution in report["cautions"]]


def _field(field: dict[str, Any]) -> str:
    """A field of an unknown cause as text."""
    beside = "".join(f", beside {name}" for name in field["beside"])
    said = f"{field['words']}{beside} (P = {field['probability']:.2f})"
    if field["strength"] is not None:
        value, sigma = field["strength"]["value"], field["strength"]["sigma"]
        said += f": {value:.3g} ± {sigma:.2g} {field['unit']}".rstrip()
    if field["closure"] is not None:
        said += f", held-out closure {100 * field['closure']['value']:.0f} %"
    return said


gap.add_command(blind)
gap.add_command(plan)
COMMANDS = (gap,)
