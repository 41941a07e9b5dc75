"""``heliopsf gap blind``: makes transits with a withheld effect, stores a hash of each effect (the seal), diagnoses the transits, and compares the
answers with the effects.

The command imports numerical libraries only when it is called, so that other commands start fast.
"""

from __future__ import annotations

import sys
from pathlib import Path

import click

from psfcore.errors import DataError
from service.cli.options import FILE, OUTPUT_FOLDER, limits, user_errors
from service.cli.progress import echo

# The diagnosis runs as a command in another process, which does not know the withheld effects.
DIAGNOSE = (
    sys.executable,
    "-P",  # nothing is imported from the working folder
    "-c",
    "from service.cli.main import main; main()",
    "gap",
    "{transit}",
    "--json",
    "{report}",
    "--local",
)
# The ideal observer also runs in another process, because the blind set and the gap library share no code.
IDEAL = (sys.executable, "-P", "-m", "psfcore.gap.ideal_observer", "{expected}", "{ideal}")


@click.command(short_help="Test the diagnosis on simulated cases.")
@click.option("--cases", default=24, type=click.IntRange(1, 9999), help="Number of cases")
@click.option("--seed", default=1, type=click.IntRange(0), help="Seed of random numbers")
@click.option("-o", "--output", required=True, type=OUTPUT_FOLDER, help="Folder of the set")
@click.option("--size", default=256, type=click.IntRange(128, 1024), help="Width and height, px")
@click.option("--images", default=18, type=click.IntRange(6, 200), help="Images per transit")
@click.option(
    "--processes",
    default=2,
    type=click.IntRange(1, 64),
    help="Number of diagnoses that run at the same time",
)
@click.option("--keep", is_flag=True, help="Keep the images of each case after their use")
@click.option("--scenes", multiple=True, type=FILE, help="Take scenes from these images (FITS), in turn")
@click.option("--only", multiple=True, metavar="EFFECT", help="Use only these effects, one per case, in turn")
@click.option(
    "--left",
    "left_pct",
    multiple=True,
    type=click.FloatRange(0.05, 50),
    metavar="PCT",
    help="Residual in the discs, percent, that remains when the PSF is fitted to images with the effect; repeat to vary it "
    "[default: random, 0.5 to 10]",
)
@click.option(
    "--simulator",
    default="",
    show_default=False,
    metavar="FILE.py|MODULE",
    help="Let the function make_case of this file or module make the cases; its code is executed (docs/gap.md)",
)
@click.option("--clean-only", is_flag=True, help="Make only cases without an effect, to count false alarms")
@click.option(
    "--synthetic",
    is_flag=True,
    help="Use a synthetic diffraction PSF, which is made faster than the PSF of the instrument",
)
@click.option(
    "--make-only", is_flag=True, help="Make and seal the cases and keep the transits, but diagnose nothing"
)
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
    simulator: str,
    clean_only: bool,
    synthetic: bool,
    make_only: bool,
) -> None:
    """Test the diagnosis on simulated cases whose effect is withheld from the diagnosis. To continue a stopped run,
    repeat the command."""
    from psfcore.blind.case_set import alone_in, make_set
    from psfcore.blind.cases import SetPlan
    from psfcore.blind.run_set import run_set
    from psfcore.blind.score import write_score
    from psfcore.simulate.inputs import image_rate

    def say(line: str) -> None:
        echo(line, err=True)

    if clean_only and only:
        raise click.UsageError("expected one of --clean-only and --only; got both")
    if simulator and (only or clean_only or synthetic or left_pct or scenes):
        raise click.UsageError(
            "expected --simulator without --only, --left, --scenes, --clean-only and --synthetic, because the simulator "
            "chooses its cases; got one of them"
        )
    with user_errors(), alone_in(output):
        plan = SetPlan(cases, seed, size, images, 0, only, clean_only, not synthetic, left_pct, simulator)
        planes = [image_rate(file, limits()) for file in scenes]
        made, not_made = make_set(output, plan, scenes=planes, processes=processes, progress=say)
        numbers = [number for number in plan.numbers if number not in not_made]
        if not numbers:
            why = next(iter(not_made.values()))
            raise DataError(
                "no-case-made", f"none of the {cases} cases could be made; the first failed with: {why}"
            )
        if make_only:
            echo(f"{output}: {len(numbers)} of {cases} cases made and sealed")
            return
        run_set(made, numbers, DIAGNOSE, ideal=IDEAL, processes=processes, keep=keep, progress=say)
        echo(write_score(made, numbers, not_made))


COMMANDS = (blind,)


if __name__ == "__main__":
    blind()
