"""Compiled kernels on disk: no process may load the wrong one, even if others start or die at the same time."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from psfcore.compiled import MARK, KernelFiles, compiled, kernel_folder, trusted

ROOT = Path(__file__).parents[2]


def test_two_processes_that_compile_at_once_keep_both_kernels(tmp_path: Path) -> None:
    """The second process writes its kernel after the first found no file and before the first writes its own."""
    first, second = (KernelFiles(str(tmp_path), "f.py311", "source") for _ in range(2))
    write = first._open_for_write

    def late(path: str) -> Any:
        second.save(("length 512",), "code for 512")
        return write(path)

    first._open_for_write = late
    first.save(("length 64",), "code for 64")
    third = KernelFiles(str(tmp_path), "f.py311", "source")
    assert (third.load(("length 64",)), third.load(("length 512",))) == ("code for 64", "code for 512")
    assert third.load(("length 8",)) is None


def test_a_kernel_of_a_changed_source_is_not_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    KernelFiles(str(tmp_path), "f.py311", "before").save(("float32",), "old code")
    now = KernelFiles(str(tmp_path), "f.py311", "now")
    assert now.load(("float32",)) is None
    now.save(("float32",), "new code")
    assert now.load(("float32",)) == "new code"
    assert len(list(tmp_path.iterdir())) == 1, "and the old code's file is gone"
    files = KernelFiles(str(tmp_path), "f.py311", "the same")
    files.save(("float32",), "code")
    assert files.load(("float32",)) == "code"
    monkeypatch.setattr("psfcore.compiled.sources_sha256", lambda: "another")
    assert files.load(("float32",)) is None


def test_a_kernel_file_cut_short_by_a_power_failure_is_compiled_again(tmp_path: Path) -> None:
    files = KernelFiles(str(tmp_path), "f.py311", "source")
    for left in (0, 10, 64, -1):
        files.save(("float32",), "code")
        (kept,) = tmp_path.iterdir()
        kept.write_bytes(kept.read_bytes()[:left])
        assert files.load(("float32",)) is None
    files.save(("float32",), "code")
    assert files.load(("float32",)) == "code"


def test_a_kernel_that_cannot_be_written_is_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = KernelFiles(str(tmp_path), "f.py311", "source")

    def full(path: str) -> Any:
        raise OSError(28, "No space left on device")

    files._open_for_write = full
    files.save(("float32",), "code")
    files.save(("float64",), "code")
    assert "No space left" in caplog.text and len(caplog.records) == 1, "a folder is named once"


def test_kernels_that_others_can_write_or_rename_are_not_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files = KernelFiles(str(tmp_path), "f.py311", "source")
    files.save(("float32",), "code")
    assert files.load(("float32",)) == "code"
    for mode in (0o777, 0o1777, 0o770):
        tmp_path.chmod(mode)
        assert files.load(("float32",)) is None
        files.save(("float64",), "code")
        assert len(list(tmp_path.iterdir())) == 1 and "nobody else can write" in caplog.text
    assert len(caplog.records) == 1, "a folder is named once"
    tmp_path.chmod(0o700)
    (kept,) = tmp_path.iterdir()
    kept.chmod(0o666)
    assert files.load(("float32",)) is None
    folder = tmp_path / "open" / "kernels"
    folder.mkdir(parents=True)
    files = KernelFiles(str(folder), "f.py311", "source")
    files.save(("float32",), "code")
    folder.parent.chmod(0o777)
    assert files.load(("float32",)) is None
    folder.parent.chmod(0o1777)  # as /tmp: nobody can rename what is not his
    assert files.load(("float32",)) == "code"


def test_the_kernels_are_kept_in_a_private_folder_where_the_usual_one_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(tmp_path / "cache"))
    usual = tmp_path / "usual"
    usual.mkdir()
    assert kernel_folder(usual) == str(usual)
    kernel_folder.cache_clear()
    usual.chmod(0o777)
    private = Path(kernel_folder(usual))
    kernel_folder.cache_clear()
    assert private.is_relative_to(tmp_path / "cache") and private.stat().st_mode & 0o777 == 0o700
    files = KernelFiles(str(private), "f.py311", "source")
    files.save(("float32",), "code")
    assert files.load(("float32",)) == "code"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another user")
def test_a_kernel_folder_of_another_user_is_not_used(tmp_path: Path) -> None:
    os.chown(tmp_path, 12345, 12345)
    assert not trusted(tmp_path)


def kernel_names(source: ast.Module) -> set[str]:
    """Names used in the bodies of a file's kernels."""
    kernels = [
        node
        for node in ast.walk(source)
        if isinstance(node, ast.FunctionDef)
        and any("compiled" in ast.unparse(d) for d in node.decorator_list)
    ]
    lines = [line for kernel in kernels for line in kernel.body]
    return {one.id for line in lines for one in ast.walk(line) if isinstance(one, ast.Name)}


def test_kernels_use_names_only_from_files_that_define_kernels() -> None:
    """A change in a name that a kernel uses must change the hash of the sources."""
    sources = {path: path.read_bytes() for path in (ROOT / "psfcore").rglob("*.py")}
    looked_at = 0
    for path, content in sources.items():
        if MARK not in content or path.name == "compiled.py":
            continue
        tree = ast.parse(content)
        names = kernel_names(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("psfcore"):
                used = names & {alias.asname or alias.name for alias in node.names}
                looked_at += len(used)
                origin = ROOT / (node.module.replace(".", "/") + ".py")
                assert not used or MARK in sources[origin], f"{path.name} holds {used} of {node.module}"
    assert looked_at > 5


# Two kernels that one function makes, and a third that calls both.
MODULE = """
import sys
import numpy as np
from psfcore.convolution import fft_kernels
from psfcore.compiled import compiled

def adding(amount):
    @compiled(name=f"add_{amount}")
    def add(x):
        for k in range(x.size):
            x[k] += amount
    return add

add_1, add_20 = adding(1), adding(20)

@compiled()
def add_both(x):
    add_1(x)
    add_20(x)

def run(kernel):
    x = np.zeros(3)
    kernel(x)
    print(*x, sum(kernel.stats.cache_hits.values()))
"""


def test_first_kernels_of_two_processes_are_not_mixed_up(tmp_path: Path) -> None:
    """numba numbers symbols per process: both kernels are number 1, and a third process links both."""
    (tmp_path / "kernels.py").write_text(MODULE)
    said = [
        subprocess.run(
            [sys.executable, "-c", f"import kernels; kernels.run(kernels.{kernel})"],
            check=True,
            cwd=tmp_path,
            env={"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
        ).stdout.split()
        for kernel in ("add_1", "add_20", "add_both", "add_1")
    ]
    assert said == [
        ["1.0", "1.0", "1.0", "0"],
        ["20.0", "20.0", "20.0", "0"],
        ["21.0", "21.0", "21.0", "0"],
        ["1.0", "1.0", "1.0", "1"],
    ], "the last kernel must not be compiled again"


# A kernel that is called by its address; the kernel that calls it does not contain a copy of it.
CALLED = """
import sys
import numpy as np
from psfcore.convolution import fft_kernels

plan = fft_kernels.make_plan(192)
x = np.zeros((192, 2, 16), np.float32)
x[0, 0] = 1
fft_kernels.forward(x.reshape(-1), plan)
assert (x[:, 0] == 1).all() and (x[:, 1] == 0).all()
passes = fft_kernels._FORWARD[8], fft_kernels._FORWARD[3], fft_kernels._INVERSE[8]
print(*(kernel._kernel.cache_hits for kernel in passes), sum(fft_kernels.forward.stats.cache_hits.values()))
print(prepared := "numba.np.linalg" in sys.modules)
if not prepared:
    fft_kernels.inverse(x.reshape(-1), plan)
    assert np.allclose(x[0, 0] / 192, 1, rtol=1e-6) and np.allclose(x[1:], 0, atol=1e-4)
    assert not fft_kernels.inverse.stats.cache_hits, "this process compiles it"
"""


def test_a_kernel_that_is_called_by_its_address_is_kept_and_loaded(tmp_path: Path) -> None:
    """Its address differs between processes, so a kernel on disk must not contain the address. A process that only
    loads kernels does not prepare numba's compiler, which imports all functions that numba knows. It can compile others
    later.
    """
    said = [
        subprocess.run(
            [sys.executable, "-c", CALLED],
            check=True,
            env={"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
        ).stdout.split()
        for _ in range(2)
    ]
    assert said == [["0", "0", "0", "0", "True"], ["1", "1", "1", "1", "False"]]
    assert list(tmp_path.rglob("*forward_8*")), "the passes are kept here"
    assert not list(tmp_path.rglob("*forward_4*")), "a plan compiles only the passes that it needs"


@pytest.mark.parametrize("place", ["cache", "/proc/nowhere"])
def test_where_numba_finds_no_folder_kernels_are_kept_in_the_cache_or_not_at_all(
    tmp_path: Path, place: str
) -> None:
    """As in a container whose user owns neither the installation nor a home."""
    (tmp_path / "kernels.py").write_text(MODULE)
    script = (
        "import kernels, psfcore.compiled as c; kernels.run(kernels.add_20); kernels.run(kernels.add_1); "
        "print(c.folder_of_kernels()[1])"
    )
    done = [
        subprocess.run(
            [sys.executable, "-c", script],
            check=True,
            cwd=tmp_path,
            env={
                "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator",  # numba's folder that no variable names
                "HELIOPSF_CACHE_DIR": str(tmp_path / place),
                "PYTHONPATH": str(ROOT),
            },
            capture_output=True,
            text=True,
        )
        for _ in range(2)
    ]
    kept = place == "cache"
    for number, one in enumerate(done):
        hits = str(number if kept else 0)
        assert one.stdout.split() == [*["20.0"] * 3, hits, *["1.0"] * 3, hits, str(kept)], one.stderr
        told = [line for line in one.stderr.splitlines() if "NUMBA_CACHE_DIR" in line]
        assert len(told) == (0 if kept else 1), "it is said once"


def test_a_function_that_uses_constants_needs_a_name() -> None:
    amount = 3
    with pytest.raises(TypeError, match=r"expected an argument name: .*add uses constants"):

        @compiled()
        def add(x):  # type: ignore[no-untyped-def]
            return x + amount


def test_every_cached_kernel_uses_compiled() -> None:
    sources = [path for path in (ROOT / "psfcore").rglob("*.py") if path.name != "compiled.py"]
    assert sources and not [path for path in sources if re.search(r"cache\s*=\s*True", path.read_text())]
