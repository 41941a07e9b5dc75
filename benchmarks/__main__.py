"""`make bench`: run all benchmarks, and print each figure beside its goal and the stored figure.

    python -m benchmarks [NAME ...] [--write]

NAME: benchmarks to run, by module; default: all, about 20 minutes on two idle cores. --write: replace the stored
figures of this kind of machine (`benchmarks/stored.json`) by those of this run; figures that were not measured stay. A
figure that is more than 20 % worse than stored is named as a regression. If a benchmark fails, the others still run;
the exit status is then 1.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.figures import COLLECTED, figure_of, keep, kind_of_machine, stored, table

BENCHMARKS: dict[str, tuple[str, ...]] = {
    "times": (),
    "bulk": ("--images", "48", "--steps", "20"),
    "viewer": (),
    "growth": ("--quick",),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[*BENCHMARKS, []], metavar="NAME")
    parser.add_argument("--write", action="store_true")
    chosen = parser.parse_args()
    failed = []
    with TemporaryDirectory(prefix="heliopsf-bench-") as folder:
        collected = Path(folder) / "figures.jsonl"
        collected.touch()
        for name in chosen.names or BENCHMARKS:
            print(f"\n--- {name}", flush=True)
            command = [sys.executable, "-m", f"benchmarks.{name}", *BENCHMARKS[name]]
            if subprocess.run(command, env=os.environ | {COLLECTED: str(collected)}).returncode:
                failed.append(name)
        figures = [figure_of(json.loads(text)) for text in collected.read_text("utf-8").splitlines()]
    here, earlier = kind_of_machine(), stored()
    print(f"\n--- figures, goals, and ratios to the stored figures of this kind of machine ({here})")
    if here not in earlier:
        print(f"none are stored for it, only for: {'; '.join(earlier) or 'none'}")
    print(table(figures, earlier.get(here, {})))
    if chosen.write:
        keep(figures)
    if failed:
        raise SystemExit(f"these benchmarks did not end well: {', '.join(failed)}")


if __name__ == "__main__":
    main()
