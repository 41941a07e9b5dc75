"""The filter and the plate scale of an image choose among the certified PSFs of its channel."""

from __future__ import annotations

from typing import Any

import pytest

from psfcore.errors import DataError
from tests.workers.psf_examples import OWNER, certify, header_of, identity, psf, years
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.contexts import Pin
from workers.intake.psf_choice import look_for_image, picked_for_image


@pytest.fixture
def certified(catalogue: Catalogue) -> Catalogue:
    """At the same time: a PSF for the channel, and one for each of two variants."""
    for name, channel in (("plain", None), ("open_2", "174-open_2"), ("binned", "174-0.984arcsec")):
        catalogue.add(psf(name))
        certify(catalogue, name, "1.0.0", years(2020, 2022), channel=channel)
    return catalogue


def image(
    filter_name: str | None, scale: float = 0.492, date: str = "2021-06-01", **more: Any
) -> dict[str, Any]:
    cards = {"FILTER": filter_name, "CDELT1": scale, "CDELT2": scale, "DETECTOR": "HRI_EUV"}
    known = {key: value for key, value in cards.items() if value is not None}
    return header_of(date, **({"cards": known} | more))


def chosen(catalogue: Catalogue, header: dict[str, Any], context: str | None = None) -> str:
    found = picked_for_image(catalogue, header, OWNER, context)
    assert found is not None
    assert look_for_image(catalogue, header, OWNER, context).one().id == found.one().id
    return found.one().name


def test_the_header_chooses_the_variant(certified: Catalogue) -> None:
    assert chosen(certified, image(None)) == "plain"
    assert chosen(certified, image("closed")) == "plain"
    assert chosen(certified, image("Open 2")) == "open_2"
    assert chosen(certified, image(None, 0.984)) == "binned"
    with pytest.raises(DataError) as caught:
        chosen(certified, image("Open 2", 0.984))
    assert caught.value.code == "several-variants-fit"
    assert picked_for_image(certified, image("Open 2"), "somebody", None) is None
    assert chosen(certified, image("Open 2", wavelnth=174.5)) == "open_2"


def test_a_variant_has_its_own_versions_ranges_and_interpolation(certified: Catalogue) -> None:
    row = certified.psfs.released("hri_euv/174-open_2/total", OWNER)
    assert list(row) == ["1.0.0"]
    late = image("Open 2", date="2023-06-01")
    with pytest.raises(DataError, match="channel 174-open_2") as caught:
        chosen(certified, late)
    assert caught.value.code == "no-psf-fits", "the PSF of the channel alone is not used in its place"
    certified.add(psf("later"))
    certify(certified, "later", "2.0.0", years(2024, None), channel="174-open_2")
    certified.series.set_interpolated("hri_euv/174-open_2/total", OWNER, True, "x")
    found = picked_for_image(certified, late, OWNER, None)
    assert found is not None and found.interpolation is not None
    assert found.interpolation.before_psf_id == identity("open_2")
    plain = picked_for_image(certified, image(None, date="2023-06-01"), OWNER, None)
    assert plain is not None and plain.interpolation is None


def test_a_context_chooses_among_its_own_variants(certified: Catalogue) -> None:
    certified.contexts.create("plain", OWNER, "x", pins=[Pin(identity("plain"))])
    certified.contexts.create("all", OWNER, "x")
    assert chosen(certified, image("Open 2"), "plain") == "plain"
    assert chosen(certified, image("Open 2"), "all") == "open_2"
    assert chosen(certified, image("Open 2"), "now") == "open_2"


def test_only_a_draft_becomes_a_variant_of_its_channel(certified: Catalogue) -> None:
    certified.add(psf("other"))
    for channel in ("304", "304-open_2", "1740"):
        with pytest.raises(DataError) as caught:
            certify(certified, "other", "9.0.0", channel=channel)
        assert caught.value.code == "line-known"
    with pytest.raises(DataError) as caught:
        certify(certified, "plain", "1.0.0", years(2020, 2021), channel="174-open_1")
    assert caught.value.code == "line-known", "a certified PSF keeps its series"
