"""The share of branches that the fast tests run, by room: `make coverage` writes the table into CONTRIBUTING.md."""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import Path

from coverage import Coverage

BEGIN, END = "<!-- coverage -->\n", "<!-- end of coverage -->\n"
LEAST_PCT = 85.0


def rooms(files: dict[str, dict[str, dict[str, int]]]) -> dict[str, tuple[int, int]]:
    """The branches of each folder, and those that ran. files: of the JSON report of coverage."""
    counts: dict[str, tuple[int, int]] = defaultdict(lambda: (0, 0))
    for file, report in files.items():
        summary, room = report["summary"], str(Path(file).parent)
        there, ran = counts[room]
        counts[room] = there + summary["num_branches"], ran + summary["covered_branches"]
    return dict(sorted(counts.items()))


def table(counts: dict[str, tuple[int, int]]) -> str:
    """The table in Markdown: all rooms together, and each room."""
    total = tuple(map(sum, zip(*counts.values(), strict=True)))
    rows = {"all": total, **counts}
    lines = ["| room | branches | run by the tests |", "|---|---|---|"]
    lines += [
        f"| {room} | {there} | {100 * ran / there:.0f} % |" for room, (there, ran) in rows.items() if there
    ]
    return "\n".join(lines) + "\n"


def main(page: Path) -> None:
    """Write the table of the last `make coverage` into a page."""
    data = Coverage()
    data.load()
    text = Path(".coverage.json")
    data.json_report(outfile=str(text))
    counts = rooms(json.loads(text.read_text())["files"])
    before, _, rest = page.read_text("utf-8").partition(BEGIN)
    page.write_text(before + BEGIN + table(counts) + END + rest.partition(END)[2], "utf-8")
    print(table(counts))
    low = [room for room, (there, ran) in counts.items() if there and 100 * ran / there < LEAST_PCT]
    print(f"below {LEAST_PCT:g} %: {', '.join(low) or 'none'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
