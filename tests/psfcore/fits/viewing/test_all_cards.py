"""The cards of a file are listed as the file has them."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import HeaderError
from psfcore.fits.header import FitsLimits
from psfcore.fits.viewing.all_cards import all_cards
from tests.psfcore.fits import raw_files

LIMITS = FitsLimits(max_pixels=10_000)


def test_every_card_of_every_hdu_in_the_order_of_the_file(tmp_path: Path) -> None:
    header = fits.Header([("TELESCOP", "TEST", "who"), ("ANSWER", 42), ("RATE", 0.25, "Hz"), ("YES", True)])
    header["ESO TEL X"] = 3  # HIERARCH
    header["LONG"] = "x" * 100
    for line in ("first", "second"):
        header.add_comment(line)
        header.add_history(line)
    header["LAST"] = fits.card.Undefined()
    path = tmp_path / "x.fits"
    plane = fits.ImageHDU(np.zeros((2, 2), np.uint8), name="QUALITY")
    fits.HDUList([fits.PrimaryHDU(np.zeros((4, 4), "f4"), header), plane]).writeto(path)
    first, second = all_cards(path, LIMITS)
    assert (first.index, first.name, second.index, second.name) == (0, "PRIMARY", 1, "QUALITY")
    with fits.open(path) as hdus:
        for listed, hdu in zip((first, second), hdus, strict=True):
            expected = [
                (c.keyword, None if isinstance(c.value, fits.card.Undefined) else c.value, c.comment)
                for c in hdu.header.cards
            ]
            assert listed.cards == expected
    assert ("HISTORY", "first", "") in first.cards and ("LAST", None, "") in first.cards


def test_a_damaged_card_is_listed_and_all_values_are_json(tmp_path: Path) -> None:
    cards = ["BAD     = 1 2 3", "NOTNUM  = NaN", "HUGE    = 1E400", "COMPLEX = (1.0, 2.0)", "UNCLOSED= 'abc"]
    path = tmp_path / "x.fits"
    path.write_bytes(raw_files.block(*raw_files.image_cards(4, 2, 8, *cards), data=bytes(8)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Python would remember each text of a warning for ever
        (listed,) = all_cards(path, LIMITS)
    values = {keyword: value for keyword, value, _comment in listed.cards}
    assert values["BAD"] == "1 2 3" and values["NOTNUM"] == "NaN" and values["HUGE"] == "inf"
    assert values["COMPLEX"] == "(1+2j)" and values["UNCLOSED"] == "'abc"
    assert json.loads(json.dumps(listed.cards, allow_nan=False))


def test_headers_beyond_the_limits_are_refused(tmp_path: Path) -> None:
    cards = raw_files.image_cards(4, 2, 8, *["COMMENT x"] * 100)
    (tmp_path / "x.fits").write_bytes(raw_files.block(*cards, data=bytes(8)))
    with pytest.raises(HeaderError, match=r"^header-too-long"):
        all_cards(tmp_path / "x.fits", FitsLimits(max_pixels=100, max_header_bytes=2880))
