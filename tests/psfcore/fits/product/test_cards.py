"""The cards of a product that say which file it is and what it was made from."""

from __future__ import annotations

from astropy.io import fits

from psfcore.fits.product.cards import described

SHA = "a" * 64


def made(**cards: object) -> tuple[fits.Header, dict[str, object], list[str]]:
    own = described(
        fits.Header(list(cards.items())), filename="own.fits", creator="heliopsf 1.2.3", sha256=SHA
    )
    return own.header, {key: value for key, (value, _) in own.cards.items()}, own.history


def test_a_product_describes_itself_and_points_to_its_input() -> None:
    source = {"DATE": "2022-04-19T17:47:09", "PARENT": "solo_L1.fits", "LEVEL": "L2", "VERSION": 1}
    source |= {"FILENAME": "solo_L2.fits", "ORIGIN": "Royal Observatory of Belgium"}
    header, cards, history = made(
        **source, CREATOR="euiprep.py", JOBID="7", LVL_NUM=1.5, TELESCOP="SOLO/EUI/FSI"
    )
    own = {"FILENAME": "own.fits", "PARENT": "solo_L2.fits", "CREATOR": "heliopsf 1.2.3"}
    assert cards == own | {"LEVEL": "L3", "DCNVPASS": 1}
    assert not {"DATE", "ORIGIN", "VERSION", "JOBID"} & set(header)
    assert header["TELESCOP"] == "SOLO/EUI/FSI" and header["LVL_NUM"] == 1.5
    assert SHA in history
    assert {f"input {key}: {value}" for key, value in source.items()} <= set(history)


def test_what_the_input_does_not_say_is_not_invented() -> None:
    header, cards, history = made(PARENT="earlier.fits", TELESCOP="X")
    assert set(cards) == {"FILENAME", "CREATOR", "DCNVPASS"} and "PARENT" not in header
    assert history == ["SHA-256 of the input file:", SHA, "input PARENT: earlier.fits"]


def test_passes_are_counted() -> None:
    assert made(PSFID="x")[1]["DCNVPASS"] == 2, "a product of an earlier version has no count"
    assert made(PSFID="x", DCNVPASS=2)[1]["DCNVPASS"] == 3
    assert made(DCNVPASS=2)[1]["DCNVPASS"] == 1, "the card alone makes no product"
    assert made(PSFSUM=1.0)[1]["DCNVPASS"] == 1
