"""Parts of the pages of the documentation that programs write."""

from __future__ import annotations

from pathlib import Path


def with_part(page: str, name: str, part: str) -> str:
    """The page with a new part between the comments `begin NAME` and `end NAME`. Raises ValueError if it does not have them."""
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
