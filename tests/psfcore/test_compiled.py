"""Compiled kernels on disk: no process may load the wrong one, even if others start or die at the same time."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba import typeof

from psfcore.compiled import Unknown, compiled, spelled
from psfcore.kernel_files import MARK, Kept, KernelFiles, folders_of, private_folder, trusted, writable_of

ROOT = Path(__file__).parents[2]
CODE, OTHER = Kept(None, b"code"), Kept(None, b"other code")


def files_in(folder: Path, stamp: str = "source") -> KernelFiles:
    return KernelFiles((folder,), "f", stamp)


def test_two_processes_that_compile_at_once_keep_both_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second process writes its kernel after the first found no file and before the first writes its own."""
    first, second = (files_in(tmp_path) for _ in range(2))
    write = Path.write_bytes

    def late(path: Path, content: bytes) -> int:
        monkeypatch.setattr(Path, "write_bytes", write)
        second.save("length 512", OTHER)
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", late)
    first.save("length 64", CODE)
    third = files_in(tmp_path)
    assert (third.load("length 64"), third.load("length 512")) == (CODE, OTHER)
    assert third.load("length 8") is None


def test_a_kernel_of_a_changed_source_is_not_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files_in(tmp_path, "before").save("float32", OTHER)
    now = files_in(tmp_path, "now")
    assert now.load("float32") is None and not now.any_kept()
    now.save("float32", CODE)
    assert now.load("float32") == CODE and now.any_kept()
    assert len(list(tmp_path.iterdir())) == 1, "and the old code's file is gone"
    for what in ("kernel_files.sources_sha256", "kernel_files.compiler_version", "kernel_files.processor"):
        with monkeypatch.context() as patched:
            patched.setattr(f"psfcore.{what}", lambda: "another")
            assert now.load("float32") is None, what
    assert now.load("float32") == CODE


def test_a_kernel_file_cut_short_by_a_power_failure_is_compiled_again(tmp_path: Path) -> None:
    files = files_in(tmp_path)
    for left in (0, 10, 64, -1):
        files.save("float32", CODE)
        (kept,) = tmp_path.iterdir()
        kept.write_bytes(kept.read_bytes()[:left])
        assert files.load("float32") is None
    files.save("float32", CODE)
    assert files.load("float32") == CODE


def test_a_kernel_that_cannot_be_written_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    files = files_in(tmp_path)
    files.save("float32", CODE)
    files.save("float64", CODE)
    assert "No space left" in caplog.text and len(caplog.records) == 1, "a folder is named once"


def test_kernels_that_others_can_write_or_rename_are_not_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files = files_in(tmp_path)
    files.save("float32", CODE)
    assert files.load("float32") == CODE
    for mode in (0o777, 0o1777, 0o770):
        tmp_path.chmod(mode)
        assert files.load("float32") is None
        files.save("float64", CODE)
        assert len(list(tmp_path.iterdir())) == 1 and "nobody else can write" in caplog.text
    assert len(caplog.records) == 1, "a folder is named once"
    tmp_path.chmod(0o700)
    (kept,) = tmp_path.iterdir()
    kept.chmod(0o666)
    assert files.load("float32") is None
    folder = tmp_path / "open" / "kernels"
    files = files_in(folder)
    files.save("float32", CODE)
    folder.parent.chmod(0o777)
    assert files.load("float32") is None
    folder.parent.chmod(0o1777)  # as /tmp: nobody can rename what is not his
    assert files.load("float32") == CODE


def test_kernels_are_written_to_a_private_folder_where_the_usual_one_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "usual"))
    usual, private = folders_of(ROOT / "psfcore" / "compiled.py")
    assert usual.is_relative_to(tmp_path / "usual") and private == private_folder()
    assert writable_of((usual, private)) == usual
    usual.chmod(0o777)
    assert writable_of((usual, private)) == private
    assert private.is_relative_to(tmp_path / "cache") and private.stat().st_mode & 0o777 == 0o700
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    assert folders_of(ROOT / "psfcore" / "compiled.py")[0] == ROOT / "psfcore" / "__pycache__"


def test_kernels_of_a_shared_folder_are_used_and_others_are_kept_in_the_private_one(tmp_path: Path) -> None:
    """An administrator compiled some, and the user cannot write to the folder."""
    shared, private = tmp_path / "shared", tmp_path / "private"
    files_in(shared).save("float32", CODE)
    shared.chmod(0o777)  # stands for a folder to which this user may not write: root may write to all
    files = KernelFiles((shared, private), "f", "source")
    files.save("float64", OTHER)
    shared.chmod(0o755)
    assert [len(list(folder.iterdir())) for folder in (shared, private)] == [1, 1]
    assert (files.load("float32"), files.load("float64")) == (CODE, OTHER)


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
                used = [alias for alias in node.names if (alias.asname or alias.name) in names]
                looked_at += len(used)
                for alias in used:  # a name of a module, or a module of a package
                    module, origin = (
                        ROOT / (dotted.replace(".", "/") + ".py")
                        for dotted in (node.module, f"{node.module}.{alias.name}")
                    )
                    content = sources.get(module) or sources[origin]
                    assert MARK in content, f"{path.name} holds {alias.name} of {node.module}"
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
    print(*x, "numba" in sys.modules)
"""


def test_first_kernels_of_two_processes_are_not_mixed_up(tmp_path: Path) -> None:
    """numba numbers symbols per process: both kernels are number 1, and a third process links both."""
    (tmp_path / "kernels.py").write_text(MODULE)
    said = [
        said_of(f"import kernels; kernels.run(kernels.{kernel})", tmp_path)
        for kernel in ("add_1", "add_20", "add_both", "add_1")
    ]
    assert said == [
        ["1.0", "1.0", "1.0", "True"],
        ["20.0", "20.0", "20.0", "True"],
        ["21.0", "21.0", "21.0", "True"],
        ["1.0", "1.0", "1.0", "False"],
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
print("numba" in sys.modules, prepared := "numba.np.linalg" in sys.modules)
if not prepared:
    fft_kernels.inverse(x.reshape(-1), plan)
    assert np.allclose(x[0, 0] / 192, 1, rtol=1e-6) and np.allclose(x[1:], 0, atol=1e-4)
    assert "numba.np.linalg" in sys.modules, "this process compiles it"
"""


def test_a_kernel_that_is_called_by_its_address_is_kept_and_loaded(tmp_path: Path) -> None:
    """Its address differs between processes, so a kernel on disk must not contain the address. A process that only
    loads kernels does not import numba. It can compile others later.
    """
    assert [said_of(CALLED, tmp_path) for _ in range(2)] == [["True", "True"], ["False", "False"]]
    assert list(tmp_path.rglob("*forward_8*")), "the passes are kept here"
    assert not list(tmp_path.rglob("*forward_4*")), "a plan compiles only the passes that it needs"


def said_of(script: str, kernels: Path, **environment: str) -> list[str]:
    """The words that a script prints, whose kernels are kept in a folder."""
    return subprocess.run(
        [sys.executable, "-c", script],
        check=True,
        cwd=kernels,
        env={"NUMBA_CACHE_DIR": str(kernels / "cache"), "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
    ).stdout.split()


# Kernels that return arrays and tuples, allocate, and raise exceptions.
VALUES = """
import sys, tracemalloc
from typing import NamedTuple
import numpy as np
from psfcore.compiled import compiled

class Pair(NamedTuple):
    plane: np.ndarray
    factor: float

@compiled()
def scaled(pair, values, negative):
    out = np.empty(pair.plane.shape)
    for n in range(out.size):
        out[n] = pair.plane[n] * pair.factor + values[1][n]
    if negative:
        raise ValueError("negative")
    return out, out.sum()

@compiled()
def ratio(a, b):
    return a // b, np.ones(a).sum()

def fails(kernel, *arguments):
    try:
        kernel(*arguments)
    except (ArithmeticError, TypeError, ValueError) as error:
        return type(error).__name__
"""
PRINTED = """
from values import *
ones = np.ones(3, np.float32)
assert ratio(7, 2) == (3, 7.0)
print("numba" in sys.modules)
plane, total = scaled(Pair(ones, 2.5), (ones, ones), False)
assert plane.tolist() == [3.5] * 3 and total == 10.5
print(fails(ratio, 1, 0), fails(scaled, Pair(ones, 2.5), (ones, ones), True))
large = np.ones(10_000)
run = lambda: [scaled(Pair(large, 2.0), (large, large), False) for _ in range(50)]
run()
tracemalloc.start()
run()
print(tracemalloc.get_traced_memory()[0] < 40_000)
"""


def test_a_kept_kernel_returns_and_raises_without_numba_what_it_returned_with_numba(tmp_path: Path) -> None:
    (tmp_path / "values.py").write_text(VALUES)
    raised = ["ZeroDivisionError", "ValueError", "True"]
    assert [said_of(PRINTED, tmp_path) for _ in range(2)] == [["True", *raised], ["False", *raised]]


def test_a_kept_kernel_that_needs_the_rest_of_numba_is_loaded_by_numba(tmp_path: Path) -> None:
    """As on processors whose object code numba links in other ways. It is not compiled again."""
    (tmp_path / "kernels.py").write_text(MODULE)
    first = "import kernels; kernels.run(kernels.add_20)"
    other = "import platform; platform.machine = lambda: 'another'; "
    assert said_of(first, tmp_path) == ["20.0"] * 3 + ["True"]
    prepared = "; print('numba.np.linalg' in kernels.sys.modules)"
    assert said_of(other + first + prepared, tmp_path) == ["20.0"] * 3 + ["True", "False"]


class Plane(NamedTuple):
    one: object
    other: object


def test_types_are_spelled_as_numba_spells_them() -> None:
    """Otherwise a process would not find the kernels that numba compiled."""
    plane = np.zeros((4, 6), np.float32)
    fixed = plane.copy()
    fixed.flags.writeable = False
    numbers = [True, 1, 1.5, 1j, None, np.float32(1), np.float64(1), np.int64(1), np.uint8(1), np.bool_(1)]
    arrays = [
        plane,
        plane.T,
        plane[:, ::2],
        plane[:, 0],
        plane[:0],
        fixed,
        np.zeros(()),
        np.zeros(2, complex),
    ]
    arrays += [np.zeros(2, kind) for kind in (bool, np.int32, np.intp, np.uint16)]
    tuples = [(), (1, 2), (1, 2.0), (plane, (plane, 1)), Plane(1, plane), Plane(plane, plane)]
    for value in (*numbers, *arrays, *tuples):
        assert spelled(value) == str(typeof(value)), value
    for value in (
        "text",
        [1],
        np.zeros(2, ">f4"),
        np.zeros(9, np.uint8)[1:].view("f4"),
        plane.view(np.matrix),
    ):
        with pytest.raises(Unknown):
            spelled(value)


@pytest.mark.parametrize("place", ["cache", "/proc/nowhere"])
def test_where_the_usual_folder_cannot_be_made_kernels_are_kept_in_the_cache_or_not_at_all(
    tmp_path: Path, place: str
) -> None:
    """As in a container whose user owns neither the installation nor a home."""
    (tmp_path / "kernels.py").write_text(MODULE)
    script = (
        "import kernels, psfcore.kernel_files as c; kernels.run(kernels.add_20); kernels.run(kernels.add_1); "
        "print(c.folder_of_kernels()[1])"
    )
    done = [
        subprocess.run(
            [sys.executable, "-c", script],
            check=True,
            cwd=tmp_path,
            env={
                "NUMBA_CACHE_DIR": "/proc/nowhere",
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
        compiles = str(not kept or number == 0)
        assert one.stdout.split() == [*["20.0"] * 3, compiles, *["1.0"] * 3, compiles, str(kept)], one.stderr
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
