"""Print how many lines and files each room has, beside the number of lines that it is meant to have.

    python -m tests.house.lines        (make lines)

A room is a folder. The lines of its tests are those of the folder with the same path in tests/.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

HERE = Path(__file__).parents[2]
SOURCES = ("*.py", "*.html", "*.js", "*.css")
SMALL = 80
# Each room, and the lines that it is meant to have. "." after a folder: the files of this folder alone.
ROOMS: dict[tuple[str, ...], int] = {
    ("psfcore/.",): 1300,
    ("psfcore/fits",): 1400,
    ("psfcore/instruments",): 500,
    ("psfcore/convolution",): 1000,
    ("psfcore/deconvolve",): 2700,
    ("psfcore/diffraction", "psfcore/tables"): 2000,
    ("psfcore/scatter",): 3000,
    ("psfcore/transit",): 1500,
    ("psfcore/simulate",): 1200,
    ("psfcore/evaluation", "psfcore/flare"): 1900,
    ("psfcore/report", "psfcore/drawing"): 1500,
    ("psfcore/gap",): 6100,
    ("psfcore/blind",): 2300,
    ("workers/.", "workers/broker"): 1000,
    ("workers/contract",): 1000,
    ("workers/catalogue",): 3000,
    ("workers/intake", "workers/files", "workers/run", "workers/bulk"): 2900,
    ("workers/tasks",): 1500,
    ("service/.", "service/http", "service/api"): 4200,
    ("service/vo",): 1800,
    ("service/client", "service/cli"): 4400,
    ("service/pages",): 4900,
    ("heliopsf",): 1000,
    ("benchmarks", "studies"): 1800,
}


def files_of(folders: Iterable[str]) -> list[Path]:
    """The source files of folders."""
    found: list[Path] = []
    for folder in folders:
        alone = folder.endswith("/.")
        path = HERE / folder.removesuffix("/.")
        found += [file for kind in SOURCES for file in (path.glob(kind) if alone else path.rglob(kind))]
    return found


def lines_of(files: Iterable[Path]) -> list[int]:
    """The number of lines of each file."""
    return [len(file.read_text("utf-8").splitlines()) for file in files]


def main() -> None:
    """Print the table."""
    print(f"{'room':<48}{'lines':>7}{'meant':>7}{'files':>7}{f'< {SMALL}':>6}{'tests':>7}")
    totals = [0] * 5
    for folders, meant in ROOMS.items():
        lines = lines_of(files_of(folders))
        tests = sum(lines_of(files_of(f"tests/{folder}" for folder in folders)))
        row = [sum(lines), meant, len(lines), sum(count < SMALL for count in lines), tests]
        totals = [a + b for a, b in zip(totals, row, strict=True)]
        _tell(", ".join(folder.removesuffix("/.") for folder in folders), row)
    _tell("together", totals)
    _tell("tests, all", [sum(lines_of(files_of(["tests"]))), 28_000])


def _tell(name: str, numbers: list[int]) -> None:
    widths = (7, 7, 7, 6, 7)
    print(f"{name:<48}" + "".join(f"{one:>{width}}" for one, width in zip(numbers, widths, strict=False)))


if __name__ == "__main__":
    main()
