"""Layouts of output files: what they may contain, and that no value leads out of the folder."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psfcore.errors import DataError
from workers.contract.bulk import FIELDS, FieldValue, check_layout, laid_out

VALUES: dict[str, FieldValue] = {
    "stem": "image 0",
    "folder": PurePosixPath("2020/03"),
    "telescop": "SOLO/EUI/HRI_EUV",
    "instrume": "EUI",
    "detector": None,
    "wavelnth": "174",
    "date": datetime(2020, 3, 1, 12, 30, tzinfo=UTC),
    "product": "a" * 16,
    "psf": "b" * 16,
}


PATHS = (
    ("{stem}.fits", "image_0.fits"),
    (
        "{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits",
        "SOLO_EUI_HRI_EUV/2020/03/01/image_0_deconvolved.fits",
    ),
    ("{folder}/{stem}-{product}.fits", f"2020/03/image_0-{'a' * 16}.fits"),
    ("l2-{wavelnth}/{date:%Y%m%dT%H%M}.fits", "l2-174/20200301T1230.fits"),
)
REFUSED = (
    ("{name}.fits", "expected the fields stem, folder"),
    ("{stem.__class__}.fits", "expected the fields stem"),
    ("{stem!r}.fits", "expected the fields stem"),
    ("{}.fits", "expected the fields stem"),
    ("{stem:>9}.fits", "only for the field date"),
    ("{date}.fits", "expected a form of the date"),
    ("{date:%c}.fits", "expected a form of the date"),
    ("{date:%Y %m}.fits", "expected a form of the date"),
    ("/{stem}.fits", "expected a relative path"),
    ("{stem}.png", "that ends in .fits"),
    ("../{stem}.fits", "begins with a full stop"),
    ("a/./{stem}.fits", "begins with a full stop"),
    ("a//{stem}.fits", "between two slashes"),
    ("{stem", "expected fields in braces"),
    ("a b/{stem}.fits", "outside of fields"),
)


def test_a_layout_gives_a_path_or_is_refused() -> None:
    for layout, path in PATHS:
        check_layout(layout)
        assert laid_out(layout, VALUES) == PurePosixPath(path)
    for layout, words in REFUSED:
        with pytest.raises(ValueError, match=words):
            check_layout(layout)


def test_a_missing_value_is_an_error_of_the_image() -> None:
    with pytest.raises(DataError, match=r"value for the field detector \(DETECTOR\); got none"):
        laid_out("{detector}/{stem}.fits", VALUES)


@given(
    st.dictionaries(st.sampled_from(sorted(set(FIELDS) - {"date", "folder"})), st.text(max_size=30)),
    st.text(max_size=30),
)
def test_no_value_leads_out_of_the_folder(values: dict[str, Any], folder: str) -> None:
    everything = VALUES | {"detector": "x"} | values | {"folder": PurePosixPath(folder)}
    layout = "/".join(f"{{{name}}}" for name in FIELDS if name != "date") + "/{date:%Y/%m}.fits"
    check_layout(layout)
    try:
        path = laid_out(layout, everything)
    except DataError as error:
        assert error.code == "no-output-name"
        return
    assert not path.is_absolute() and all(part and not part.startswith(".") for part in path.parts)
    assert path.name == "03.fits" and path.as_posix().isascii()
