"""A value that takes long to make, made by one worker of xdist and read by the others."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

import pytest

T = TypeVar("T")


def once_a_run(make: Callable[[], T], name: str, folders: pytest.TempPathFactory) -> T:
    """The value that ``make`` returns. It is made by the first worker that asks; the others wait and read it from a
    file.

    name: of the file, below the temporary folder of this run. Without xdist, the value is made and returned.
    """
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return make()
    path = shared_folder(folders) / f"{name}.pickle"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.exists():
            return cast(T, pickle.loads(path.read_bytes()))
        value = make()
        partial = path.with_suffix(".partial")
        partial.write_bytes(pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL))
        partial.replace(path)
    return value


def shared_folder(folders: pytest.TempPathFactory) -> Path:
    """The temporary folder of the run; each worker has a folder of its own in it."""
    return folders.getbasetemp().parent
