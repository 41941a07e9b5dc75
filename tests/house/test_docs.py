"""The documentation: what can be checked without building the site. `tests/whole/test_docs_site.py` builds it."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path

import click
import pytest

from service.cli.main import main

HERE = Path(__file__).parents[2]
DOCS = HERE / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.py"))
PAGES = sorted(page for page in DOCS.iterdir() if page.suffix in (".md", ".rst"))
TEXTS = [page for page in PAGES if page.suffix == ".md"] + [
    HERE / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
]


def test_every_page_is_in_the_navigation_and_the_start_page_names_every_tutorial() -> None:
    blocks = [
        block
        for page in PAGES
        for block in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text("utf-8"), flags=re.S)
    ]
    entries = [line for block in blocks for line in block.splitlines() if line and line[0] != ":"]
    listed = [entry.partition("<")[2].rstrip(">") or entry for entry in entries]
    assert sorted(listed) == sorted(
        ["_gallery/index", *(page.stem for page in PAGES if page.stem != "index")]
    )
    named = re.findall(r"_gallery/(\w+)\.rst", (DOCS / "index.md").read_text("utf-8"))
    assert named == [path.stem for path in TUTORIALS]


def test_relative_links_lead_to_files(subtests: pytest.Subtests) -> None:
    for path in TEXTS:
        with subtests.test(str(path)):
            for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text("utf-8")):
                if "://" in target:
                    continue
                # The site makes the pages in _gallery from the tutorials.
                made = re.fullmatch(r"_gallery/(\w+)\.rst", target)
                file = DOCS / "tutorials" / f"{made[1]}.py" if made else path.parent / target
                assert file.is_file(), target


def test_tutorials_compile_and_begin_with_a_title(subtests: pytest.Subtests) -> None:
    for path in TUTORIALS:
        with subtests.test(str(path)):
            title = ast.get_docstring(ast.parse(path.read_text("utf-8")))
            assert title is not None
            heading, underline = title.splitlines()[:2]
            assert underline == "=" * len(heading)


def test_the_commands_of_tutorials_and_their_options_exist(subtests: pytest.Subtests) -> None:
    for path in TUTORIALS:
        with subtests.test(str(path)):
            for line in re.findall(r"^#    \$ heliopsf (.+)$", path.read_text("utf-8"), flags=re.M):
                words, command = shlex.split(line, comments=True), main
                while isinstance(command, click.Group):
                    _, command, words = command.resolve_command(click.Context(command), words)
                known = {name for one in command.params for name in (*one.opts, *one.secondary_opts)}
                assert {word for word in words if word.startswith("-")} <= known, line


def test_the_site_names_no_other_host() -> None:
    for name in ("conf.py", "site.css"):
        assert "//" not in (DOCS / name).read_text("utf-8"), name


def test_the_numbers_of_aiapy_are_those_of_the_comparison() -> None:
    tutorial = (DOCS / "tutorials" / "2_aia.py").read_text("utf-8")
    page = (DOCS / "aia.md").read_text("utf-8")
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line[:6] == "| 171 "
    ]
    arms, *light = rows
    assert f"arms_deg = np.array([{arms[2]}])" in tutorial
    assert f"radii_px = [{', '.join(row[1] for row in light)}]" in tutorial
    assert f"aiapy_pct = [{', '.join(row[3] for row in light)}]" in tutorial
    assert re.search(r"aiapy [\d.]+\d", page)[0] in tutorial  # type: ignore[index]
