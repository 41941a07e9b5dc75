"""To which variant of a channel an image belongs, by its filter and its plate scale."""

from __future__ import annotations

from typing import Any

import pytest

from psfcore.errors import DataError
from workers.versions.variants import is_variant_of, variant_for, without_variant

KNOWN = ("174-open_1", "174-open_2", "174-0.984arcsec", "174-open_2-0.984arcsec")


def cards(filter_name: str | None = None, scale: float | None = None, **more: Any) -> dict[str, Any]:
    known = {"FILTER": filter_name, "CDELT1": scale, "CDELT2": scale} | more
    return {key: value for key, value in known.items() if value is not None}


BELONGS: tuple[tuple[dict[str, Any], str | None], ...] = (
    (cards(), None),
    (cards("Open 1"), "174-open_1"),
    (cards("OPEN-2", 0.492), "174-open_2"),
    (cards("closed", 0.492), None),
    (cards(None, 0.984), "174-0.984arcsec"),
    (cards("closed", -0.99), "174-0.984arcsec"),
    (cards("closed", 1.0), None),
    (cards("open 2", 0.984), "174-open_2-0.984arcsec"),
    (cards(None, 0.984 / 3600, CUNIT1="deg", CUNIT2="deg"), "174-0.984arcsec"),
    (cards(None, 0.984, CDELT2=0.492), None),
    (cards(EC_FW1_="Open 1", EC_FW2_="Ti_poly"), "174-open_1"),
    (cards(EC_FW1_="Al_poly", EC_FW2_="Open 2"), "174-open_2"),
)


def test_an_image_belongs_to_the_variant_whose_properties_all_agree() -> None:
    for header, variant in BELONGS:
        assert variant_for(header, KNOWN) == variant, header
        assert variant_for(header, KNOWN[::-1]) == variant, "in any order"
        assert variant_for(header, ()) is None


def test_two_variants_that_agree_equally_well_are_refused() -> None:
    with pytest.raises(DataError, match=r"174-0\.984arcsec, 174-open_1") as caught:
        variant_for(cards("open 1", 0.984), KNOWN)
    assert caught.value.code == "several-variants-fit"


def test_names_of_variants() -> None:
    assert without_variant("174-open_2") == without_variant("174") == "174"
    assert is_variant_of("174-open_2", "174")
    for other in ("174", "174-", "304-open_2", "1740-x"):
        assert not is_variant_of(other, "174")
