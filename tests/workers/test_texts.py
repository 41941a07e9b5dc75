"""Texts of people: what is refused, what is dropped, and what stays."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter, ValidationError

from service.client.outputs import base_name
from workers.texts import Line, Lines, Name, printable
from workers.versions import label

# Marks of direction, controls of C0 and C1, separators of lines, spaces of no width.
HIDDEN = "\u202e\u2066\u200f\u061c\x1b\x9b\x85\u2028\u200b\ufeff"


def test_what_cannot_be_printed_is_refused_in_labels_and_dropped_from_names_of_files() -> None:
    for sign in HIDDEN:
        for kind in (Line, Name, Lines):
            with pytest.raises(ValidationError):
                TypeAdapter(kind).validate_python(f"a{sign}b")
        assert printable(f"a{sign}b") == label(f"a{sign}b", 9) == base_name(f"x/a{sign}b") == "ab", ascii(
            sign
        )
    for text in ("", "Größe 3″ ☀ 太陽 שמש"):
        assert TypeAdapter(Line).validate_python(text) == printable(text) == text
    assert TypeAdapter(Lines).validate_python("one\n\ttwo") == "one\n\ttwo"
    for kind, text in ((Name, ""), (Line, "one\ntwo")):
        with pytest.raises(ValidationError):
            TypeAdapter(kind).validate_python(text)
