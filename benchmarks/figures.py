"""The figures that `make bench` compares with their goals and with their stored values, and the parts of pages that
programs write.

A benchmark states a figure by its name with `tell`. `python -m benchmarks` collects the figures of all benchmarks and
prints the table. `benchmarks/stored.json` has the values of an earlier run on each kind of machine. Times are compared
as ratios to 1 F of their own run (see benchmarks/timing.py), all other figures as they are. 1 F depends on the memory
and the transforms of a machine, but the start of a program on its processor, so the ratios of two kinds of machine may
differ.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.timing import THREADS

COLLECTED = "HELIOPSF_BENCH_FIGURES"  # environment variable: the file to which `tell` appends
STORED = Path(__file__).with_name("stored.json")
REGRESSION = 1.20


@dataclass(frozen=True)
class Wanted:
    """The unit of a figure, and its goal. more: the goal is a lower limit, not an upper one."""

    unit: str
    goal: float
    more: bool = False


# Goals in seconds hold for an idle machine with two cores. Goals in F and percent hold on any machine.
WANTED: dict[str, Wanted] = {
    "first result, 2048 px, empty caches": Wanted("s", 15),
    "second result, 2048 px": Wanted("s", 4),
    "import heliopsf": Wanted("s", 0.3),
    "import service.app": Wanted("s", 1.5),
    "heliopsf --version": Wanted("s", 0.4),
    "PSF of HRI_EUV, 2048 px": Wanted("s", 3),
    "PSF with a mount without symmetry, 2048 px": Wanted("s", 15),
    "20 steps, 2048 px": Wanted("s", 1.1),
    "20 steps, 2048 px: memory of the process": Wanted("GiB", 0.5),
    "memory for a pixel of the padded plane, 2048 px": Wanted("bytes", 12),
    "bulk, one worker: overhead": Wanted("%", 2),
    "bulk, two workers: overhead": Wanted("%", 2),
    "bulk: gain of two workers / of two plain processes": Wanted("%", 97, more=True),
    "fit of 126 images of 2048 px": Wanted("s", 300),
    "diagnosis of 30 images of 512 px": Wanted("s", 75),
    "diagnosis of 30 images of 512 px: memory": Wanted("GiB", 2),
    "preview, 2048 px": Wanted("F", 4),
    "orders of a rotated mesh, 2048 px": Wanted("F", 6),
    "design study of 32 meshes": Wanted("F", 15),
    "viewer: first sight, 2048 px": Wanted("s", 1.0),
    "viewer: all pixels, 2048 px": Wanted("s", 3.0),
    "viewer: a blink": Wanted("s", 0.05),
    "viewer: memory of a tab, 4096 px": Wanted("MB", 300),
}


@dataclass(frozen=True)
class Figure:
    """A measured figure. value: in the unit of `WANTED`. f_s: 1 F of the same run, in s; only for times."""

    name: str
    value: float
    f_s: float | None = None

    @property
    def compared(self) -> float:
        """The number that is compared with an earlier run: the ratio to 1 F of a time, else the value."""
        return self.value if self.f_s is None else self.value / self.f_s


def tell(name: str, value: float, f_s: float | None = None) -> None:
    """Print a figure beside its goal, and add it to the table of `python -m benchmarks` if that runs the benchmark.

    f_s: 1 F of the same run, in s; needed for a figure in seconds. Raises KeyError for a name without a goal,
    ValueError for a time without f_s.
    """
    wanted = WANTED[name]
    if (wanted.unit == "s") != (f_s is not None):
        raise ValueError(f"{name}: expected f_s with a figure in seconds, and only with such a figure")
    figure = Figure(name, float(value), f_s)
    print(line(figure, None), flush=True)
    if path := os.environ.get(COLLECTED):
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(figure)) + "\n")


def kind_of_machine() -> str:
    """The processor and its number of cores."""
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    model = names[0].partition(":")[2].strip() if names else platform.processor()
    return f"{model}, {THREADS} cores"


def stored() -> dict[str, dict[str, dict[str, Any]]]:
    """The figures of earlier runs, by kind of machine and name, each with its date."""
    return dict(json.loads(STORED.read_text("utf-8"))) if STORED.is_file() else {}


def keep(figures: Iterable[Figure]) -> None:
    """Replace the stored figures of this kind of machine; figures that were not measured stay."""
    kept, date = stored(), {"date": time.strftime("%Y-%m-%d")}
    kept.setdefault(kind_of_machine(), {}).update({one.name: asdict(one) | date for one in figures})
    STORED.write_text(json.dumps(kept, indent=1) + "\n", "utf-8")


def change(figure: Figure, before: Figure) -> float:
    """How many times worse a figure is than before; below 1: better."""
    now, then = figure.compared, before.compared
    if WANTED[figure.name].more:
        now, then = then, now
    return now / then if then else float("inf")


def reached(figure: Figure) -> bool:
    """Whether a figure reaches its goal."""
    wanted = WANTED[figure.name]
    return figure.value >= wanted.goal if wanted.more else figure.value <= wanted.goal


def is_regression(figure: Figure, before: Figure) -> bool:
    """Whether a figure is worse than before by more than 20 %. A figure in percent must also miss its goal: an overhead
    of 0.2 % after 0.1 % is noise."""
    return change(figure, before) > REGRESSION and (WANTED[figure.name].unit != "%" or not reached(figure))


def line(figure: Figure, before: Figure | None) -> str:
    """A line of the table: the figure, its ratio to 1 F, its goal, the stored figure, and how many times worse it
    is."""
    wanted = WANTED[figure.name]
    in_f = "" if figure.f_s is None else f"{figure.compared:8.1f} F"
    goal = f"goal {'>=' if wanted.more else '<='} {wanted.goal:g} {wanted.unit}"
    state = "reached" if reached(figure) else "missed"
    text = f"{figure.name:<52}{figure.value:8.2f} {wanted.unit:<6}{in_f:>10}  {goal:<18}{state:<8}"
    if before is None:
        return text.rstrip()
    unit = wanted.unit if before.f_s is None else "F"
    return f"{text} before {before.compared:.1f} {unit}: x {change(figure, before):.2f}"


def figure_of(row: Mapping[str, Any]) -> Figure:
    """The figure of a stored or collected row."""
    return Figure(row["name"], row["value"], row["f_s"])


def table(figures: Iterable[Figure], earlier: Mapping[str, Mapping[str, Any]]) -> str:
    """The table of all figures beside goals and stored figures, then the regressions and the figures that are
    missing."""
    found = {figure.name: figure for figure in figures}
    before = {name: figure_of(row) for name, row in earlier.items()}
    lines = [line(found[name], before.get(name)) for name in WANTED if name in found]
    for name, figure in found.items():
        if name in before and is_regression(figure, before[name]):
            worse = change(figure, before[name])
            lines.append(
                f"REGRESSION: {name} is {worse:.2f} times worse than stored (limit {REGRESSION:.2f})"
            )
    lines += [f"not measured: {name}" for name in WANTED if name not in found]
    return "\n".join(lines)


def with_part(page: str, name: str, part: str) -> str:
    """The page with a new part between the comments `begin NAME` and `end NAME`. Raises ValueError if it does not have
    them."""
    begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->\n"
    before, found, rest = page.partition(begin)
    _, there, after = rest.partition(end)
    if not (found and there):
        raise ValueError(
            f"expected the lines {begin.strip()} and {end.strip()} in the page; they are not there"
        )
    return f"{before}{begin}\n{part.strip()}\n\n{end}{after}"


def write_part(path: Path, name: str, part: str) -> None:
    """Replace the part of a page, as `with_part` does."""
    path.write_text(with_part(path.read_text("utf-8"), name, part), "utf-8")
