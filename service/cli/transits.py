"""The commands on a transit: ``report`` tests a PSF on it; ``gap`` finds where the fitted model and the images differ
and which effect explains the difference, measures on blind cases how often this is right, and says what a planned
transit would show.

A command imports numerical libraries only when it is called, so that other commands start fast.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from psfcore.errors import DataError
from service.cli.connection import SERVER_OR_LOCAL, connection, named_psf, psf_option
from service.cli.options import (
    DRAWN,
    FILE,
    JSON,
    OUTPUT,
    OUTPUT_FOLDER,
    PLOT,
    SEED,
    is_local,
    limits,
    options_of,
    write_file,
    write_json,
    writes_files,
)
from service.cli.progress import Report as Progress
from service.cli.progress import echo, progress_bar, say
from service.client.operations import Operations
from workers.contract.requests import GapDiagnose, Report

THREADS = 2  # of a plan
# Programs for a blind set, each with a folder of images and the file of its result as further arguments. The diagnosis
# runs in another process, which does not know the withheld effects, and imports nothing from the working folder.
DIAGNOSE = (
    sys.executable,
    "-P",
    "-c",
    "import sys; from service.cli.main import main; main(['gap', sys.argv[1], '--json', sys.argv[2], '--local'])",
)
# The bound too, because the blind set and the gap library share no code.
BOUND = (sys.executable, "-P", "-m", "psfcore.gap.bound")


@contextmanager
def _reporting(
    json_file: Path | None, *, gap_effects: str = ""
) -> Iterator[tuple[Operations, Path, Progress]]:
    """A service, the file for the numbers of its report, and the function that shows its progress.

    Parameters
    ----------
    json_file
        The file for the numbers; None: a temporary file.
    gap_effects
        Files and modules that add effects to the gap library, as in `connection`.
    """
    with (
        TemporaryDirectory(prefix="heliopsf-") as folder,
        connection(gap_effects=gap_effects) as service,
        progress_bar() as show,
    ):
        yield service, json_file or Path(folder) / "report.json", show


@click.command()
@click.argument("transit", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", type=DRAWN, help="Write the result as an HTML page")
@JSON
@PLOT
@psf_option("PSF to test: an id or a file [default: fit a PSF to TRANSIT]")
@options_of(Report, "dark_offsets", "shapes", "seed", "noise", "saturation_dn")
@SERVER_OR_LOCAL
@writes_files
def report(
    transit: Path,
    output: Path | None,
    json_file: Path | None,
    plot: Path | None,
    psf: str | None,
    **parameters: object,
) -> None:
    """Fit a PSF to TRANSIT, or test a PSF on it: compare simulated and observed light in the occulter's disc.

    TRANSIT is a folder with a transit.json, or a .zip or .tar file of such a folder. Without --psf every image is
    tested with a PSF that was fitted to other images. Name at least one output: -o, --json or --plot.
    """
    if output is None and json_file is None and plot is None:
        raise click.UsageError(
            "expected an output: -o PAGE.html, --json FILE or --plot FILE; got none of them"
        )
    if parameters["shapes"] and psf is not None:
        raise click.UsageError(
            "--shapes fits every shape to TRANSIT, so it cannot be used with --psf: remove one of the two"
        )
    with _reporting(json_file) as (service, numbers, show):
        found = service.report(
            transit,
            numbers,
            page=output,
            preview=plot,
            progress=show,
            psf_id=named_psf(service, psf),
            **parameters,
        )
        told = json.loads(numbers.read_text("utf-8"))
    from psfcore.evaluation.summary_lines import summary_lines

    files = ", ".join(str(path) for path in (output, json_file, plot) if path is not None)
    echo(f"{files}: {found['details']['sentence']}")
    echo("\n".join(summary_lines(told["evaluation"], told.get("shapes"))))
    for limit in found["details"]["limits"]:
        echo(f"  note: {limit}")
    for missing in found["details"]["not_shown"]:
        echo(f"  not shown: {missing['what']} ({missing['why']})")


# --- a gap ----------------------------------------------------------------------------------------------


class _DiagnosisByDefault(click.Group):
    """A group whose default command is ``diagnose``: ``heliopsf gap DIR`` means ``heliopsf gap diagnose DIR``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = ["diagnose", *args]
        return super().parse_args(ctx, args)


@click.group(
    cls=_DiagnosisByDefault,
    help="Find out why a fitted PSF and a transit differ. `heliopsf gap TRANSIT` is short for `heliopsf gap diagnose "
    "TRANSIT`. `heliopsf gap diagnose -h` lists its options.",
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
    help="Write the corrected PSF (FITS): the PSF fitted with the named effects in the model; for a tie, with the "
    "most probable one",
)
@click.option(
    "--effects",
    metavar="FILE.py|MODULE[,...]",
    help="Also test the effects in these files, whose code is executed. Only with --local; in a service set "
    "HELIOPSF_GAP_EFFECTS",
)
@options_of(GapDiagnose, "coverage", "seed", "noise", "saturation_dn")
@SERVER_OR_LOCAL
@writes_files
def diagnose(
    transit: Path,
    output: Path | None,
    json_file: Path | None,
    plot: Path | None,
    psf: str | None,
    corrected_file: Path | None,
    effects: str | None,
    overwrite: bool,
    **parameters: object,
) -> None:
    """Diagnose the gap between TRANSIT and the model fitted to it: which effect explains the residuals.

    TRANSIT is a folder with a transit.json, or a .zip or .tar file of such a folder.
    """
    if effects is not None and not is_local():
        raise click.UsageError(
            "--effects: expected --local with it; a service tests the effects in HELIOPSF_GAP_EFFECTS"
        )
    with _reporting(json_file, gap_effects=effects or "") as (service, numbers, show):
        found = service.diagnose_gap(
            transit,
            numbers,
            page=output,
            preview=plot,
            progress=show,
            psf_id=named_psf(service, psf),
            # A service always makes the corrected PSF and keeps it, so that later requests find it.
            correct=corrected_file is not None or not is_local(),
            overwrite=overwrite,
            **parameters,
        )
        report = json.loads(numbers.read_text("utf-8"))
        corrected = found["details"]["corrected_psf_id"]
        if corrected_file is not None and corrected is not None:
            service.download(f"/v1/psfs/{corrected}/file", corrected_file, overwrite=overwrite)
    echo("\n".join(_lines(report)))
    files = [output, json_file, plot, corrected_file if corrected else None]
    if any(files):
        echo(f"written: {', '.join(str(path) for path in files if path is not None)}")
    step = _next_step(
        report, f"{shlex.quote(str(transit))}{' --local' if is_local() else ''}", output, corrected_file
    )
    if step:
        echo(f"next: {step}")
    if corrected_file is not None and corrected is None:
        raise click.ClickException(
            f"{corrected_file} was not written: the diagnosis gave no corrected PSF (verdict "
            f"{report['verdict']})"
        )


def _next_step(report: dict[str, Any], transit: str, page: Path | None, corrected: Path | None) -> str:
    """What to do with this verdict, in one line; empty if there is nothing to do."""
    if report["verdict"] in ("inconclusive", "tie"):
        return "`heliopsf gap plan PLAN` tells whether images that are not taken yet would decide"
    if report["psf"]["with_answer"] is not None and corrected is None:
        names = report["answer"] or ["field_dependent_scatter"]  # another form of it has no name of its own
        named = " and ".join(name.replace("_", " ") for name in names)
        return f"`heliopsf gap {transit} --corrected PSF.fits` writes the PSF that was fitted with {named} in the model"
    if any(cause["field"] for cause in report["causes"]):
        where = "-o PAGE.html writes a page with" if page is None else f"{page} has"
        return f"{where} the map or the curve of the change; --effects FILE.py tests a form of yours (docs/gap.md)"
    return ""


def _lines(report: dict[str, Any]) -> list[str]:
    """The answer of the report as lines to print: where, which, how far; then the verdict, what could not be tested,
    and cautions.
    """
    answer = f" ({', '.join(report['answer'])})" if report["answer"] else ""
    out = [*report["lines"], f"verdict: {report['verdict']}{answer}"]
    if "held_out_with_terms" in report["psf"]:
        out.append(f"  {report['psf']['held_out_with_terms']['sentence']}")
    if report["untestable"]:
        out.append(f"  not testable: {', '.join(one['name'] for one in report['untestable'])}")
    return out + [f"  caution: {caution}" for caution in report["cautions"]]


# --- blind cases ----------------------------------------------------------------------------------------


@gap.command(short_help="Test the diagnosis on simulated cases.")
@click.option("--cases", default=24, type=click.IntRange(1, 9999), help="Number of cases")
@click.option("--seed", default=1, type=click.IntRange(0), help="Seed of random numbers")
@click.option("-o", "--output", required=True, type=OUTPUT_FOLDER, help="Folder of the set")
@click.option("--size", "size_px", default=256, type=click.IntRange(128, 1024), help="Width and height, px")
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
    help="Residual in the discs, percent, that remains when the PSF is fitted to images with the effect; repeat to "
    "vary it [default: random, 0.5 to 10]",
)
@click.option("--clean-only", is_flag=True, help="Make only cases without an effect, to count false alarms")
@click.option(
    "--synthetic",
    "built_diffraction",
    is_flag=True,
    callback=lambda context, parameter, synthetic: not synthetic,
    help="Use a synthetic diffraction PSF, which is made faster than the PSF of the instrument",
)
@click.option(
    "--make-only", is_flag=True, help="Make and seal the cases and keep the transits, but diagnose nothing"
)
def blind(
    output: Path, processes: int, keep: bool, scenes: tuple[Path, ...], make_only: bool, **parameters: Any
) -> None:
    """Test the diagnosis on simulated cases whose effect is withheld from the diagnosis. To continue a stopped run,
    repeat the command.
    """
    from psfcore.blind.case_set import alone_in, make_set
    from psfcore.blind.cases import SetPlan
    from psfcore.blind.run_set import run_set
    from psfcore.blind.score import write_score
    from psfcore.simulate.inputs import image_rate

    plan = SetPlan(**parameters)
    if plan.clean_only and plan.only:
        raise click.UsageError("expected one of --clean-only and --only; got both")
    with alone_in(output):
        planes = [image_rate(file, limits()) for file in scenes]
        blind_set, not_made = make_set(output, plan, scenes=planes, processes=processes, progress=say)
        numbers = [number for number in range(plan.cases) if number not in not_made]
        if not numbers:
            why = next(iter(not_made.values()))
            raise DataError(
                "no-case-made", f"none of the {plan.cases} cases could be made; the first failed with: {why}"
            )
        if make_only:
            echo(f"{output}: {len(numbers)} of {plan.cases} cases made and sealed")
            return
        run_set(blind_set, numbers, DIAGNOSE, bound=BOUND, processes=processes, keep=keep, progress=say)
        echo(write_score(blind_set, numbers, not_made))


# --- a planned transit ----------------------------------------------------------------------------------


@gap.command(short_help="Find what a planned transit would show.")
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

    PLAN is a plan (JSON), the truth.json of a simulated transit, a transit.json, or a folder with a transit.json. Its
    images need not exist: transit.json may state size_px, and the exposure_s of each image.
    """
    from psfcore.gap.planning import limits_of_file
    from psfcore.gap.report.limits import lines, plan_page

    with progress_bar() as show:
        found = limits_of_file(
            plan_file,
            limits(),
            instrument=instrument,
            diffraction=diffraction,
            seed=seed,
            threads=THREADS,
            progress=show,
        )
    write_json(json_file, found.as_json(), overwrite=overwrite)
    write_file(output, lambda file: file.write_text(plan_page(found), "utf-8"), overwrite=overwrite)
    echo("\n".join(lines(found)))
