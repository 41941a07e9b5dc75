"""Code that a user names, in a Python file or in a module that can be imported: find it, hash it, import it, and report
its errors.

This module imports no numerical library.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from psfcore.errors import DataError

# A function that makes an error from the name of a source and a description of the fault.
Bad = Callable[[str, str], DataError]


def is_file(source: str) -> bool:
    """Whether a source is a file name (it ends in .py); otherwise it is the name of a module."""
    return source.endswith(".py")


def sha256_of_source(source: str, bad: Bad) -> str:
    """SHA-256 (hex) of the source text of a file (path ending in .py) or of a module. Raises the error of `bad`.

    The hash does not cover other files that the text imports. To find a module, Python imports its parent packages.
    """
    try:
        text = _file_of(source).read_bytes()
    except (OSError, ImportError, ValueError) as error:
        raise bad(source, f"expected a readable Python file (.py) or module; got {error}") from error
    return hashlib.sha256(text).hexdigest()


def _file_of(source: str) -> Path:
    if is_file(source):
        return Path(source)
    spec = importlib.util.find_spec(source)
    if spec is None:
        raise ImportError(f"No module named {source!r}")
    if not spec.has_location or spec.origin is None:
        raise ImportError(f"the module {source!r}, which has no source file")
    return Path(spec.origin)


def module_in_file(path: Path, prefix: str) -> ModuleType:
    """The module in a file, imported again, under a name that begins with `prefix` and that no other module has."""
    name = prefix + hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module in sys.modules
    spec.loader.exec_module(module)
    return module


@contextmanager
def named_errors(source: str, bad: Bad) -> Iterator[None]:
    """Run user code; if it raises an error other than DataError, raise the error that `bad` makes.

    Parameters
    ----------
    source
        The file or module of the code. The message names the line of the code.
    """
    try:
        yield
    except DataError:
        raise
    # The code may raise any error. A full traceback would mainly show the code of this software.
    except Exception as error:
        raise bad(source, f"{type(error).__name__}: {error}{_line(error, source)}") from error


def _line(error: Exception, source: str) -> str:
    """The line of the user's code that raised an error, as text; empty if the line is unknown."""
    if isinstance(error, SyntaxError):
        return ""  # the message of a SyntaxError contains the line
    name = Path(source).name if is_file(source) else f"{source.rpartition('.')[2]}.py"
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).name == name]
    return f" (line {lines[-1]})" if lines else ""
