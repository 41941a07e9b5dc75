"""``heliopsf gap plan``: computes which effects a planned transit would show, before its images are taken.

The command imports numerical libraries only when it is called, so that other commands start fast.
"""

from __future__ import annotations

from pathlib import Path

import click

from service.cli.options import (
    DRAWN,
    FILE,
    JSON,
    SEED,
    limits,
    progress_bar,
    user_errors,
    write_json,
    writes_files,
)
from service.cli.progress import echo
from service.client.outputs import written

THREADS = 2


@click.command(short_help="Find what a planned transit would show.")
@click.argument("plan_file", metavar="PLAN", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", type=DRAWN, help="Write the result as an HTML page")
@JSON
@click.option(
    "--instrument",
    metavar="NAME|FILE",
    help="Use the diffraction PSF of this instrument [default: the instrument of the transit, else hri_euv]",
)
@click.option("--diffraction", type=FILE, help="Use this diffraction PSF (FITS, sum 1)")
@SEED
@writes_files
def plan(
    plan_file: Path,
    output: Path | None,
    json_file: Path | None,
    instrument: str | None,
    diffraction: Path | None,
    seed: int,
    overwrite: bool,
) -> None:
    """Find the strength at which each effect would be found in the images of PLAN, and which effects would look alike.

    PLAN is a plan (JSON), the truth.json of a simulated transit, a transit.json, or a folder with a transit.json. Its images
    need not exist: transit.json may state size_px, and the exposure_s of each image.
    """
    from psfcore.gap.planning import limits_of_file
    from psfcore.gap.report.limits import lines, plan_page

    with user_errors():
        with progress_bar() as say:
            found = limits_of_file(
                plan_file,
                limits(),
                instrument=instrument,
                diffraction=diffraction,
                seed=seed,
                threads=THREADS,
                progress=say,
            )
        write_json(json_file, found.as_json(), overwrite=overwrite)
        if output is not None:
            with written(output, overwrite=overwrite) as partial:
                partial.write_text(plan_page(found), "utf-8")
    echo("\n".join(lines(found)))


COMMANDS = (plan,)


if __name__ == "__main__":
    plan()
