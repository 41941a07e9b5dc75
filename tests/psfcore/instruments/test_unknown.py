"""Telescopes without an instrument file are recognised by the headers of their archives, and the error says what to
do."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io.fits import Header, PrimaryHDU

from psfcore.errors import DataError
from psfcore.fits.blocks import LIMITS
from psfcore.fits.header import read_summary, seen_by
from psfcore.instruments.published import published_for
from psfcore.instruments.unknown import TELESCOPES, WAYS, telescope_without_file, unknown_instrument

SUVI = "GOES-R Series Solar Ultraviolet Imager"

# The cards of real headers: those of sunpy's tests, and others whose cards differ.
HEADERS: list[tuple[str, dict[str, Any]]] = [
    ("TRACE", {"TELESCOP": "TRACE", "INSTRUME": "TRACE", "WAVE_LEN": "1600", "CDELT1": 0.5}),
    ("SOHO/EIT", {"TELESCOP": "SOHO", "INSTRUME": "EIT", "WAVELNTH": 195}),
    ("PROBA2/SWAP", {"TELESCOP": "PROBA2", "INSTRUME": "SWAP", "DETECTOR": "SWAP", "WAVELNTH": 174}),
    ("PROBA2/SWAP", {"TELESCOP": "PROBA2", "INSTRUME": "SWAP", "DETECTOR": "CMOS 1Kx1K", "WAVELNTH": 174}),
    ("GOES/SUVI", {"TELESCOP": "GOES-R", "INSTRUME": SUVI, "DETECTOR": "SUVI", "WAVELNTH": 195}),
    ("GOES/SUVI", {"TELESCOP": "G16", "INSTRUME": SUVI, "WAVELNTH": 93.9, "WAVEUNIT": "angstrom"}),
    ("Hinode/XRT", {"TELESCOP": "HINODE", "INSTRUME": "XRT", "EC_FW1_": "Open", "EC_FW2_": "Ti_poly"}),
    ("Hinode/XRT", {"TELESCOP": "HINODE", "INSTRUME": "XRT", "EC_FW1_": "Be_thin", "EC_FW2_": "Open"}),
    ("EUI/FSI", {"TELESCOP": "SOLO/EUI/FSI", "INSTRUME": "EUI", "DETECTOR": "FSI", "WAVELNTH": 174}),
    ("EUI/HRI_LYA", {"TELESCOP": "SOLO/EUI/HRI_LYA", "INSTRUME": "EUI", "DETECTOR": "HRI_LYA"}),
    ("SDO/AIA", {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 1600, "WAVEUNIT": "angstrom"}),
    ("SDO/AIA", {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 170, "WAVEUNIT": "nm"}),
]
OTHERS: list[dict[str, Any]] = [
    {},
    {"TELESCOP": "SOHO", "INSTRUME": "MDI", "WAVELNTH": 6768},
    {"INSTRUME": "SECCHI", "DETECTOR": "EUVI", "WAVELNTH": 171},
    {"TELESCOP": "SWIFT", "INSTRUME": "XRT"},
    {"TELESCOP": "HINODE", "INSTRUME": "SOT/WB"},
    {"TELESCOP": "SDO/HMI", "INSTRUME": "HMI_SIDE1", "WAVELNTH": 6173.0},
    {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171},
    {"TELESCOP": "SOLO/EUI/HRI_EUV", "INSTRUME": "EUI", "DETECTOR": "HRI_EUV", "WAVELNTH": 174},
]


def refusal(header: Header) -> DataError:
    seen = seen_by(header)
    assert seen["instrument"] is None
    return unknown_instrument(seen)


def test_the_error_names_the_telescope_the_reason_and_the_step() -> None:
    for name, cards in HEADERS:
        error = refusal(Header(cards))
        telescope = next(one for one in TELESCOPES if one.name == name)
        assert (error.fields["image"], error.fields["reason"]) == (name, telescope.reason), cards
        assert f"got an image of {name} (" in error.message and telescope.reason in error.message
        texts = {one["way"]: one["text"] for one in error.fields["ways"]}
        assert list(texts) == ["name", "upload", "fit"]
        for way, sentence in telescope.ways.items():
            assert texts[way].endswith(sentence)
            assert any(one.get("known", "").endswith(sentence) for one in error.fields["ways"])
        for published in published_for(name, seen_by(Header(cards))["wavelnth"]):
            assert published.name in texts["upload"], cards
        for recommended in list(telescope.ways.values())[:1]:
            assert recommended in error.message
    for cards in OTHERS:
        seen = seen_by(Header(cards))
        assert telescope_without_file(seen) is None, cards
        error = unknown_instrument(seen)
        assert (error.fields["reason"] is None) is bool(cards) and error.fields["ways"] == list(WAYS)


def test_an_image_that_names_nothing_is_not_quoted() -> None:
    error = refusal(Header({}))
    assert "an image of an unnamed instrument" in error.message and "''" not in error.message


def test_the_error_names_the_cards_that_the_header_lacks(tmp_path: Path) -> None:
    aia = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3"}
    for cards, named in (
        ({"BUNIT": "DN"}, ("TELESCOP", "INSTRUME")),
        (aia, ("WAVELNTH", "WAVEUNIT")),
        (aia | {"WAVELNTH": "EUV"}, ("WAVELNTH = 'EUV'",)),
        (aia | {"WAVELNTH": 171, "WAVEUNIT": "furlong"}, ("WAVELNTH = 171", "WAVEUNIT = 'furlong'")),
    ):
        path = tmp_path / "image.fits"
        PrimaryHDU(np.ones((8, 8), np.float32), Header(cards)).writeto(path, overwrite=True)
        summary = read_summary(path, LIMITS)
        assert summary.instrument is None, cards
        for seen in (asdict(summary), seen_by(Header(cards))):
            error = unknown_instrument(seen)
            told = error.fields["reason"]
            assert told[1:] in error.message and all(one in told for one in named if "=" not in one), cards
            assert "cards" not in seen or all(one in told for one in named), (cards, told)


def test_the_documentation_lists_every_telescope() -> None:
    table = (Path(__file__).parents[3] / "docs" / "instruments.md").read_text("utf-8")
    for telescope in TELESCOPES:
        assert f"\n| {telescope.name}" in table, telescope.name
