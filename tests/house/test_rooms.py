"""The layout of the code: no circular imports between rooms."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).parents[2]
PACKAGES = ("heliopsf", "psfcore", "workers", "service", "benchmarks", "studies")


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
