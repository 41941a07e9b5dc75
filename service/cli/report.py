"""The command ``report``: tests a PSF on a transit."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from service.cli.connection import LOCAL, SERVER, connection, named_psf, psf_option
from service.cli.fields import options_of
from service.cli.options import (
    DRAWN,
    JSON,
    PLOT,
    progress_bar,
    user_errors,
    writes_files,
)
from service.cli.progress import echo
from workers.contract.requests import Report


@click.command()
@click.argument("transit", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", type=DRAWN, help="Write the result as an HTML page")
@JSON
@PLOT
@psf_option("PSF to test: an id or a file [default: fit a PSF to TRANSIT]")
@options_of(Report, "dark_offsets", "shapes", "seed", "noise", "saturation_dn")
@SERVER
@LOCAL
@writes_files
def report(
    transit: Path,
    output: Path | None,
    json_file: Path | None,
    plot: Path | None,
    psf: str | None,
    server: str | None,
    local: bool,
    overwrite: bool,
    **parameters: Any,
) -> None:
    """Fit a PSF to TRANSIT, or test a PSF on it: compare simulated and observed light in the occulter's disc.

    TRANSIT is a folder with a transit.json, or a .zip or .tar file of such a folder. Without --psf every image is tested with
    a PSF that was fitted to other images. Name at least one output: -o, --json or --plot.
    """
    if output is None and json_file is None and plot is None:
        raise click.UsageError(
            "expected an output: -o PAGE.html, --json FILE or --plot FILE; got none of them"
        )
    if parameters["shapes"] and psf is not None:
        raise click.UsageError(
            "--shapes fits every shape to TRANSIT, so it cannot be used with --psf: remove one of the two"
        )
    with (
        user_errors(),
        TemporaryDirectory(prefix="heliopsf-") as folder,
        connection(server, local) as service,
        progress_bar() as say,
    ):
        numbers = json_file or Path(folder) / "report.json"
        found = service.report(
            transit,
            numbers,
            page=output,
            preview=plot,
            progress=say,
            psf_id=named_psf(service, psf),
            overwrite=overwrite,
            **parameters,
        )
        told = json.loads(numbers.read_text("utf-8"))
    from psfcore.evaluation.summary_lines import summary_lines

    written = ", ".join(str(path) for path in (output, json_file, plot) if path is not None)
    echo(f"{written}: {found['details']['sentence']}")
    echo("\n".join(summary_lines(told["evaluation"], told.get("shapes"))))
    for limit in found["details"]["limits"]:
        echo(f"  note: {limit}")
    for missing in found["details"]["not_shown"]:
        echo(f"  not shown: {missing['what']} ({missing['why']})")


COMMANDS = (report,)
