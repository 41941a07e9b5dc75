"""The blind set judges the gap library: neither of the two may use code of the other."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

HERE = Path(__file__).parents[2]


def test_the_blind_set_and_the_gap_library_share_no_code(subtests: pytest.Subtests) -> None:
    for room, other in (("blind", "gap"), ("gap", "blind")):
        with subtests.test(str((room, other))):
            files = sorted((HERE / "psfcore" / room).rglob("*.py"))
            assert files
            wrong = [
                (str(path.relative_to(HERE)), name)
                for path in files
                for name in _imports(path)
                if name == f"psfcore.{other}" or name.startswith(f"psfcore.{other}.")
            ]
            assert wrong == []


def _imports(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: expected absolute imports"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found
