"""Time the gap diagnosis of 30 images of 512 px, and measure its memory; part of `make bench`.

    python -m benchmarks.gap [--keep DIR]

The transit is a case of the blind set (`psfcore.blind`) whose effect, a ghost, leaves about ten percent, so that the
diagnosis has to refit. The time is that of the whole command `heliopsf gap --local`, fit included. --keep: keep transit and report in DIR.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.figures import tell
from benchmarks.timing import measured_process, reference
from psfcore.blind.case_set import SetPlan, make_set

PLAN = SetPlan(cases=1, seed=7, size_px=512, images=30, only=("ghost",), left_pct=(10.0,))
COMMAND = (sys.executable, "-m", "service.cli", "gap")


def diagnosed(folder: Path) -> None:
    """Make the case in an empty folder, diagnose it, and state the figures."""
    case, failed = make_set(folder / "set", PLAN)
    if failed:
        raise SystemExit(f"gap: the case could not be made: {failed}")
    f_s = reference()
    report = folder / "report.json"
    command = [*COMMAND, str(case.transit(0)), "--local", "--overwrite", "--json", str(report)]
    took_s, gib = measured_process(command, os.environ)
    verdict = json.loads(report.read_text("utf-8"))["verdict"]
    print(f"verdict of the diagnosis: {verdict}; the effect in the images is a ghost")
    tell("diagnosis of 30 images of 512 px", took_s, f_s)
    tell("diagnosis of 30 images of 512 px: memory", gib)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--keep", type=Path, metavar="DIR")
    asked = parser.parse_args()
    with TemporaryDirectory(prefix="heliopsf-gap-") as temporary:
        diagnosed(asked.keep or Path(temporary))


if __name__ == "__main__":
    main()
