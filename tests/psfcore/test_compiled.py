"""Machine code on disk: no process may be given another kernel's, whatever starts or dies at the same moment."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psfcore.compiled import KernelFiles, compiled

ROOT = Path(__file__).parents[2]


def test_two_processes_that_compile_at_once_keep_both_kernels(tmp_path: Path) -> None:
    """The second writes its kernel while the first, which found nothing there before, is about to write its own."""
    first, second = (KernelFiles(str(tmp_path), "f.py311", "source") for _ in range(2))
    write = first._save_data

    def late(name: str, data: Any) -> None:
        second.save(("length 512",), "code for 512")
        write(name, data)

    first._save_data = late
    first.save(("length 64",), "code for 64")
    third = KernelFiles(str(tmp_path), "f.py311", "source")
    assert (third.load(("length 64",)), third.load(("length 512",))) == ("code for 64", "code for 512")
    assert third.load(("length 8",)) is None


def test_code_of_a_source_that_has_changed_is_not_loaded(tmp_path: Path) -> None:
    KernelFiles(str(tmp_path), "f.py311", "before").save(("float32",), "old code")
    now = KernelFiles(str(tmp_path), "f.py311", "now")
    assert now.load(("float32",)) is None
    now.save(("float32",), "new code")
    assert now.load(("float32",)) == "new code"
    assert len(list(tmp_path.iterdir())) == 1, "and the old code's file is gone"


def _adding(amount: int) -> Callable[..., Any]:
    @compiled()
    def add(x):  # type: ignore[no-untyped-def]
        return x + amount

    return add


def test_closures_of_one_name_are_kernels_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for amount in (1, 2, 1, 2):
        add = _adding(amount)
        add._cache._cache_file._cache_path = str(tmp_path)
        assert add(10) == 10 + amount
        assert add(np.float32(0.5)) == 0.5 + amount
        hits = sum(add.stats.cache_hits.values())
    assert hits == 2, "the last was not compiled again"
    assert len(list(tmp_path.iterdir())) == 4


def test_a_new_process_finds_every_kernel(tmp_path: Path) -> None:
    """A key that told a place in memory would be another in each process, and all would be compiled again."""
    script = (
        "import numpy as np\n"
        "from psfcore.fft_kernels import make_plan\n"
        "from psfcore import fft_kernels as k\n"
        "plan = make_plan(64)\n"
        "buffer = np.zeros(64 * 32, dtype=np.float32)\n"
        "k.forward(buffer, 64, plan.radices, plan.lengths, plan.twiddles, plan.offsets)\n"
    )
    counts = []
    for _ in range(2):
        subprocess.run(
            [sys.executable, "-c", script],
            check=True,
            cwd=ROOT,
            env={"NUMBA_CACHE_DIR": str(tmp_path), "PATH": ""},
        )
        counts.append(sorted(path.name for path in tmp_path.rglob("*.nbc")))
    assert counts[0] and counts[0] == counts[1]


def test_no_kernel_is_kept_in_another_way() -> None:
    sources = [path for path in (ROOT / "psfcore").rglob("*.py") if path.name != "compiled.py"]
    assert sources and not [path for path in sources if re.search(r"cache\s*=\s*True", path.read_text())]
