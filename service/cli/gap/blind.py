"""``heliopsf gap blind``: transits with a withheld effect, made, sealed, diagnosed by ``heliopsf gap``, and scored.

Everything numerical is imported by the command, so that the others start fast.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from service.cli.options import FILE, user_errors
from workers.settings import Settings

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from psfcore.blind.case_set import BlindSet

# The command line itself, in a process that knows nothing of the set.
DIAGNOSE = (
    sys.executable,
    "-c",
    "from service.cli.main import main; main()",
    "gap",
    "{transit}",
    "--json",
    "{report}",
    "--local",
)


@click.command()
@click.option("--cases", default=24, show_default=True, type=click.IntRange(1, 9999))
@click.option("--seed", default=1, show_default=True, type=click.IntRange(0))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the set",
)
@click.option("--size", default=256, show_default=True, type=click.IntRange(128, 1024), help="Edge, px")
@click.option("--images", default=18, show_default=True, type=click.IntRange(6, 200))
@click.option("--processes", default=2, show_default=True, type=click.IntRange(1, 64))
@click.option("--keep", is_flag=True, help="Keep each transit after its report")
@click.option("--scenes", multiple=True, type=FILE, help="Images (FITS) to take scenes from, in turn")
@click.option("--only", multiple=True, metavar="EFFECT", help="Only single effects of these names, in turn")
@click.option(
    "--left",
    "left_pct",
    multiple=True,
    type=click.FloatRange(0.05, 50),
    metavar="PCT",
    help="What an effect is to leave in the discs after a refit, in turn (0.5 to 10, drawn)",
)
@click.option("--clean-only", is_flag=True, help="Only cases without any effect: false alarms")
@click.option("--synthetic", is_flag=True, help="Never the instrument's diffraction: starts faster")
@click.option("--make-only", is_flag=True, help="Make and seal, diagnose nothing; transits stay")
def blind(
    cases: int,
    seed: int,
    output: Path,
    size: int,
    images: int,
    processes: int,
    keep: bool,
    scenes: tuple[Path, ...],
    only: tuple[str, ...],
    left_pct: tuple[float, ...],
    clean_only: bool,
    synthetic: bool,
    make_only: bool,
) -> None:
    """Judge the diagnosis on cases whose effect it does not know. Goes on where an earlier run was stopped."""
    from psfcore.blind.case_set import SetPlan, alone_in, make_set
    from psfcore.blind.run_set import run_set

    def say(line: str) -> None:
        click.echo(line, err=True)

    if clean_only and only:
        raise click.UsageError("expected one of --clean-only and --only; got both")
    with user_errors(), alone_in(output):
        plan = SetPlan(cases, seed, size, images, 0, only, clean_only, not synthetic, left_pct)
        made, not_made = make_set(output, plan, scenes=_planes(scenes), processes=processes, progress=say)
        numbers = [number for number in plan.numbers if number not in not_made]
        if not numbers:
            why = next(iter(not_made.values()))
            raise DataError("no-case-made", f"expected cases that can be made; of {cases} none could: {why}")
        if make_only:
            click.echo(f"{output}: {len(numbers)} of {cases} cases made and sealed")
            return
        run_set(made, numbers, DIAGNOSE, processes=processes, keep=keep, progress=say)
        click.echo(_score(made, numbers, not_made))


COMMANDS = (blind,)


def _score(made: BlindSet, numbers: list[int], not_made: dict[int, str]) -> str:
    """Open the seals, write score.json, score.txt and score.png beside the cases; the table."""
    from psfcore.blind.plot import score_png
    from psfcore.blind.run_set import judged_cases
    from psfcore.blind.scoring import score, table

    judged, failures = judged_cases(made, numbers)
    found = score(judged, not_made | failures)
    text = table(found)
    (made.folder / "score.json").write_text(json.dumps(found.to_json(), indent=1, allow_nan=False), "utf-8")
    (made.folder / "score.txt").write_text(text + "\n", "utf-8")
    score_png(found, made.folder / "score.png")
    return text


def _planes(files: tuple[Path, ...]) -> list[NDArray[np.float64]]:
    """Pixels of images in DN/s, where their unit and exposure say how."""
    from psfcore.fits.fits_io import read_image

    limits = FitsLimits(max_pixels=Settings.model_fields["max_pixels"].default)
    planes = []
    for file in files:
        image = read_image(file, limits)
        in_dn = (image.unit or "").replace(" ", "").lower() == "dn"
        exposure_s = image.exposure_s if in_dn and image.exposure_s is not None else 1.0
        planes.append(image.pixels / exposure_s)
    return planes


if __name__ == "__main__":
    blind()
