"""Names of output files by a layout such as ``{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits``.

A layout is a relative path with fields in braces. Values from headers and file names become parts of names: all
characters except letters, digits, full stops, underscores and hyphens are replaced. Therefore no value can lead out of
the output folder.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import datetime
from pathlib import PurePosixPath
from string import Formatter

from psfcore.errors import DataError

FIELDS = {
    "stem": "name of the input file without its ending",
    "folder": "folder of the input file below the folder that the operator allows",
    "telescop": "TELESCOP",
    "instrume": "INSTRUME",
    "detector": "DETECTOR",
    "wavelnth": "WAVELNTH",
    "date": "time of the observation, in the form of strftime: {date:%Y/%m/%d}",
    "product": "first 16 digits of the product's id",
    "psf": "first 16 digits of the PSF's id",
}
DATE_PARTS = frozenset("YmdHMSj")
MOST_IN_PART, MOST_IN_PATH = 200, 1200
_LITERAL = re.compile(r"[A-Za-z0-9._/=+-]*")
_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9._-]+")
Value = str | datetime | PurePosixPath | None


def check_layout(layout: str) -> None:
    """Raise ValueError if a layout cannot be used: an unknown field, a character or a path that is not allowed."""
    for literal, name, form, conversion in _parsed(layout):
        if not _LITERAL.fullmatch(literal):
            raise ValueError(f"expected letters, digits and . _ / = + - outside of fields; got {literal!r}")
        if name is None:
            continue
        if name not in FIELDS or conversion:
            raise ValueError(f"expected the fields {', '.join(FIELDS)}; got {name!r}")
        if name == "date":
            _check_date_form(form or "")
        elif form:
            raise ValueError(f"expected a form after a colon only for the field date; got {name}:{form}")
    if layout.startswith("/") or not layout.endswith(".fits"):
        raise ValueError(f"expected a relative path that ends in .fits; got {layout!r}")
    if any(part.startswith(".") for part in layout.split("/")):
        raise ValueError(f"expected no part of the path that begins with a full stop; got {layout!r}")
    if "" in layout.split("/"):
        raise ValueError(f"expected a name between two slashes; got {layout!r}")


def laid_out(layout: str, values: Mapping[str, Value]) -> PurePosixPath:
    """The relative path of an output file. values: the values of the fields; None: the image lacks the value.

    Raises DataError "no-output-name" if a value is missing or the path cannot be used.
    """
    text = ""
    for literal, name, form, _ in _parsed(layout):
        text += literal + ("" if name is None else _written(name, form or "", values[name]))
    path = PurePosixPath(*(part for part in text.split("/") if part))
    if any(part.startswith(".") or len(part) > MOST_IN_PART for part in path.parts):
        raise _no_name(
            f"parts of a path that have at most {MOST_IN_PART} characters and do not begin with a full stop",
            text,
        )
    return path


def _parsed(layout: str) -> list[tuple[str, str | None, str | None, str | None]]:
    try:
        return list(Formatter().parse(layout))
    except ValueError as error:
        raise ValueError(f"expected fields in braces, as in {{stem}}; got {layout!r} ({error})") from error


def _check_date_form(form: str) -> None:
    parts = re.findall(r"%(.?)", form)
    rest = re.sub(r"%.?", "", form)
    if not parts or not DATE_PARTS.issuperset(parts) or not _LITERAL.fullmatch(rest):
        wanted = ", ".join(f"%{part}" for part in sorted(DATE_PARTS))
        raise ValueError(f"expected a form of the date with {wanted}, as in {{date:%Y/%m/%d}}; got {form!r}")


def _written(name: str, form: str, value: Value) -> str:
    if isinstance(value, datetime):
        return value.strftime(form)
    if isinstance(value, PurePosixPath):
        return "/".join(_as_part(part) for part in value.parts)
    found = _as_part(value or "")
    if not found:
        raise _no_name(f"an image with a value for the field {name} ({FIELDS[name]})", "none")
    return found


def _as_part(text: str) -> str:
    return _NOT_IN_A_NAME.sub("_", text).strip("._-")[:MOST_IN_PART]


def _no_name(expected: str, got: str) -> DataError:
    return DataError("no-output-name", f"expected {expected}; got {got}: use another layout of the output")
