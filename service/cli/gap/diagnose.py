"""``heliopsf gap``: where the fitted model and the images of a transit part, and which effect explains it.

Everything numerical is imported by the command, so that the others start fast.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from service.cli.connection import LOCAL, SERVER, connection, named_psf
from service.cli.gap.blind import blind
from service.cli.options import (
    NOISE,
    OUTPUT,
    PLOT,
    SATURATION,
    check_writable,
    progress_bar,
    user_errors,
)
from service.client.http import Operations

SHOWN = 6


class _DiagnosisByDefault(click.Group):
    """A group whose first word may also be a transit: ``heliopsf gap DIR`` is ``heliopsf gap diagnose DIR``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = ["diagnose", *args]
        return super().parse_args(ctx, args)


@click.group(
    cls=_DiagnosisByDefault,
    help="Diagnose a transit (heliopsf gap TRANSIT ...; its options: heliopsf gap diagnose -h), or judge the diagnosis.",
)
def gap() -> None:
    """The gap between a fitted model and the images."""


@gap.command()
@click.argument("transit", type=click.Path(exists=True, path_type=Path))
@click.option("--json", "report_file", type=OUTPUT, help="Write the report (schema gap/1)")
@click.option("--html", "page_file", type=OUTPUT, help="Write it as a page to read")
@PLOT
@click.option(
    "--psf", metavar="ID|FILE", help="A PSF fitted to a transit: its shape is fitted, from its values"
)
@click.option(
    "--corrected",
    "corrected_file",
    type=OUTPUT,
    help="Write the PSF with the answer in the model, of a tie with the best of those tied (FITS)",
)
@click.option(
    "--effects",
    metavar="FILE.py|MODULE[,...]",
    help="Try effects of your own too; their code is run. With --local: a service has HELIOPSF_GAP_EFFECTS",
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=1, show_default=True, help="Of all draws")
@NOISE
@SATURATION
@SERVER
@LOCAL
def diagnose(
    transit: Path,
    report_file: Path | None,
    page_file: Path | None,
    plot: Path | None,
    psf: str | None,
    corrected_file: Path | None,
    effects: str | None,
    seed: int,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    server: str | None,
    local: bool,
) -> None:
    """Diagnose the gap between TRANSIT, a folder (or a .zip or .tar of one), and the model fitted to it."""
    check_writable(report_file, page_file, plot, corrected_file)
    if effects is not None and not local:
        raise click.UsageError(
            "--effects: expected --local with it; a service runs those of HELIOPSF_GAP_EFFECTS"
        )
    with (
        user_errors(),
        TemporaryDirectory(prefix="heliopsf-") as folder,
        _service(server, local, effects) as service,
        progress_bar() as say,
    ):
        numbers = report_file or Path(folder) / "report.json"
        found = service.diagnose_gap(
            transit,
            numbers,
            page=page_file,
            preview=plot,
            progress=say,
            noise=noise or None,
            psf_id=named_psf(service, psf),
            saturation_dn=saturation_dn,
            seed=seed,
            # A service keeps it for whoever asks next.
            correct=corrected_file is not None or not local,
        )
        report = json.loads(numbers.read_text("utf-8"))
        corrected = found["details"]["corrected_psf_id"]
        if corrected_file is not None and corrected is not None:
            service.download(f"/v1/psfs/{corrected}/file", corrected_file)
    click.echo("\n".join(_lines(report)))
    if corrected_file is not None and corrected is None:
        raise click.ClickException(
            f"{corrected_file} was not written: no effect was found that could be added (verdict {report['verdict']})"
        )


@contextmanager
def _service(server: str | None, local: bool, effects: str | None) -> Iterator[Operations]:
    """A service; one in this process, where effects are named, that tries these too."""
    if effects is None:
        with connection(server, local) as service:
            yield service
        return
    from service.local import local_service

    with local_service(gap_effects=effects) as own:
        yield own


def _lines(report: dict[str, Any]) -> list[str]:
    """What is said of a report on a terminal."""
    so_far = "best so far: " if report["verdict"] == "inconclusive" else ""
    answer = f" ({so_far}{', '.join(report['answer'])})" if report["answer"] else ""
    out = [report["sentence"], f"verdict: {report['verdict']}{answer}"]
    together = report.get("together", ())  # reports of earlier versions have none
    for effect in [*together, *report["effects"]][:SHOWN]:
        closure = effect["closure"]
        closed = "" if closure is None else f", held-out closure {100 * closure['value']:.0f} %"
        numbers = ", ".join(
            f"{name} {p['value']:.3g} +- {p['sigma']:.2g} {p['unit']}".strip()
            for name, p in effect["parameters"].items()
        )
        out.append(f"  {effect['name']:<24} p = {effect['p_value']:.2g}{closed}: {numbers}")
    out += [f"  looks like: {one['form']} (score {one['score']:.1f})" for one in report["looks_like"]]
    out += [f"  not testable: {one['name']} ({one['why']})" for one in report["untestable"]]
    return out + [f"  caution: {caution}" for caution in report["cautions"]]


gap.add_command(blind)
COMMANDS = (gap,)
