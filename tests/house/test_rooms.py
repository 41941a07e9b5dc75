"""The layout of the code: no circular imports between rooms, no overfull folder, no prefix in place of a folder."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

HERE = Path(__file__).parents[2]
PACKAGES = ("heliopsf", "psfcore", "workers", "service", "benchmarks", "studies")
MOST_FILES = 15
# Folders that hold one thing of many equal parts: each catalogue table, and each kind of job, has its file there.
# The revisions of the database are a history, which grows by one file a revision and is read by no one else.
LARGER = {"workers/catalogue": 17, "workers/catalogue/migrations/versions": 100}
# Richardson-Lucy is the method's own name; revisions of the database are numbered.
OWN_NAMES = {"psfcore/deconvolve/methods": "richardson"}


def _files() -> list[Path]:
    found = [
        path.relative_to(HERE) for package in PACKAGES for path in sorted((HERE / package).rglob("*.py"))
    ]
    assert len(found) > 100
    return found


def _module(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse((HERE / path).read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
            yield node.module


def _graphs() -> dict[str, dict[str, set[str]]]:
    """For every folder: which of its members (files and folders) import which of its other members."""
    files = _files()
    modules = {_module(path): path for path in files if path.name != "__init__.py"}
    graphs: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for path in files:
        for name in _imports(path):
            target = modules.get(name)
            if target is None or target == path:
                continue
            here, there = path.parts, target.parts
            level = next(i for i, (a, b) in enumerate(zip(here, there, strict=False)) if a != b)
            graphs["/".join(here[:level]) or "."][here[level]].add(there[level])
    return graphs


def _circle(graph: dict[str, set[str]]) -> list[str]:
    """Members that are left once everything without imports inside the folder is taken away, again and again."""
    left = {name: set(targets) for name, targets in graph.items()}
    while True:
        ends = {target for targets in left.values() for target in targets} - set(left)
        free = {name for name, targets in left.items() if targets <= ends}
        if not free:
            return sorted(left)
        left = {name: targets - free for name, targets in left.items() if name not in free}


def test_a_circle_is_found() -> None:
    assert _circle({"a": {"b"}, "b": {"c"}, "d": {"a"}}) == []
    assert _circle({"a": {"b"}, "b": {"c", "a"}, "c": set()}) == ["a", "b"]


def test_no_circular_imports_at_any_level() -> None:
    circles = {level: circle for level, graph in _graphs().items() if (circle := _circle(graph))}
    assert circles == {}


def _folders() -> dict[str, list[str]]:
    folders: dict[str, list[str]] = defaultdict(list)
    for path in _files():
        if path.name not in ("__init__.py", "__main__.py"):
            folders[path.parent.as_posix()].append(path.stem)
    return folders


def test_no_folder_is_overfull() -> None:
    overfull = {
        folder: len(names)
        for folder, names in _folders().items()
        if len(names) > LARGER.get(folder, MOST_FILES)
    }
    assert overfull == {}


def test_no_three_files_share_a_prefix(subtests: pytest.Subtests) -> None:
    for folder in sorted(_folders()):
        with subtests.test(str(folder)):
            shared: dict[str, list[str]] = defaultdict(list)
            for name in _folders()[folder]:
                prefix = name.split("_")[0]
                if OWN_NAMES.get(folder) != prefix:
                    shared[prefix].append(name)
            assert {prefix: names for prefix, names in shared.items() if len(names) > 2} == {}
