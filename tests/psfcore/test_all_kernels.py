"""One command compiles every kernel, so that no user waits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from psfcore.all_kernels import works
from psfcore.deconvolve.methods.registry import method_names
from psfcore.instruments.files import telescope_of, telescopes
from psfcore.kernel_files import MARK

ROOT = Path(__file__).parents[2]
# Imports all modules with kernels, and prints the kernels that are not kept.
CHECK = """
import importlib, sys
from psfcore import compiled
for name in sys.argv[1:]:
    importlib.import_module(name)
print(len(compiled.KERNELS), *(one.__qualname__ for one in compiled.KERNELS if not compiled.is_kept(one)))
"""


def test_the_work_uses_every_method_and_every_telescope() -> None:
    names = set(works())
    built = {telescope_of(name.removeprefix("PSF of ")) for name in names if name.startswith("PSF of ")}
    assert set(method_names()) <= names and built == set(telescopes())


@pytest.mark.slow  # half a minute
def test_all_kernels_are_compiled(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    code = "from psfcore.all_kernels import compile_all; print(*compile_all(2), *compile_all(2))"
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "psfcore").rglob("*.py")
        if MARK in path.read_bytes()
    ]
    said = []
    for command in (["-c", code], ["-c", CHECK, *modules]):
        done = subprocess.run(
            [sys.executable, *command],
            env=environment,
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        said.append(done.stdout.split())
    (new, kept, none, still), kernels = map(int, said[0]), said[1]
    assert new == kept == still and none == 0
    assert len(kernels) == 1 and 0 < int(kernels[0]) <= kept, "a kernel may have several types of arguments"
