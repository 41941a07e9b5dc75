"""Immutable contexts, the default context and its history, and the one PSF that fits an image."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from tests.workers.databases import BOTH
from tests.workers.psf_examples import (
    OWNER,
    certify,
    deprecate,
    header_of,
    identity,
    pin,
    psf,
    refused,
    years,
)
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.psfs import PsfFilter
from workers.intake.psf_choice import look, look_for_image, picked_for_image
from workers.versions import iso, seconds

LINE = PsfFilter("hri_euv", "174", "total")


@pytest.fixture
def certified(catalogue: Catalogue) -> Catalogue:
    """Two years of one series, certified, and a draft."""
    for name, year in (("a", 2020), ("b", 2021)):
        catalogue.add(psf(name))
        certify(catalogue, name, f"1.{year - 2020}.0", years(year, year + 1))
    catalogue.add(psf("draft"))
    return catalogue


def header(**cards: Any) -> dict[str, Any]:
    """What an image's upload is kept with, as far as a PSF is found by it."""
    return header_of("2020-06-01T12:00:00.123", **cards)


def pinned(catalogue: Catalogue, name: str) -> list[tuple[str, str | None, str | None, str]]:
    context = catalogue.contexts.named(name, OWNER)
    return [
        (pin.series, iso(pin.valid_from), iso(pin.valid_to), pin.version)
        for pin in catalogue.contexts.pins(context.id, OWNER)
    ]


def test_a_context_pins_certified_psfs_and_never_changes(certified: Catalogue) -> None:
    made, new = certified.contexts.create("first", OWNER, "tester", reason="a start")
    assert new and (made.pins, made.created_by, made.reason) == (2, "tester", "a start")
    there = pinned(certified, "first")
    assert there == [
        ("hri_euv/174/total", "2020-01-01T00:00:00Z", "2021-01-01T00:00:00Z", "1.0.0"),
        ("hri_euv/174/total", "2021-01-01T00:00:00Z", "2022-01-01T00:00:00Z", "1.1.0"),
    ]
    certify(certified, "draft", "2.0.0", years(2020, None), supersedes=(identity("a"), identity("b")))
    assert pinned(certified, "first") == there
    found = look(certified, PsfFilter(valid_at=seconds("2021-06-01")), OWNER, "first").one()
    assert (found.name, found.status) == ("b", "deprecated"), "pinned is pinned"
    assert look(certified, PsfFilter(valid_at=seconds("2021-06-01")), OWNER, None).one().name == "draft"


def test_the_same_set_under_the_same_name_is_the_same_context(certified: Catalogue) -> None:
    first, new = certified.contexts.create("first", OWNER, "x")
    same, again = certified.contexts.create("first", OWNER, "y")
    assert (new, again) == (True, False) and same.id == first.id and same.created_by == "x"
    other, _ = certified.contexts.create("second", OWNER, "x")
    assert other.id != first.id
    deprecate(certified, "a")
    message = refused("name-taken", lambda: certified.contexts.create("first", OWNER, "x"))
    assert first.id in message
    assert certified.contexts.find(first.id, OWNER) is not None
    assert certified.contexts.find(first.id, "somebody") is None
    assert certified.contexts.find("first", "somebody") is None


def test_a_context_of_given_psfs(certified: Catalogue) -> None:
    pins = [
        pin("draft", years(2022, None)),
        pin("a"),
        pin("b", years(2021, 2022)),
    ]
    certified.contexts.create("mixed", OWNER, "x", pins=pins)
    assert [pin[1:] for pin in pinned(certified, "mixed")] == [
        ("2020-01-01T00:00:00Z", "2021-01-01T00:00:00Z", "1.0.0"),
        ("2021-01-01T00:00:00Z", "2022-01-01T00:00:00Z", "1.1.0"),
        ("2022-01-01T00:00:00Z", None, "0.1.0+draft"),
    ]
    turned, new = certified.contexts.create("mixed", OWNER, "x", pins=pins[::-1])
    assert not new, "the order in which pins are given is no part of the set"
    assert turned.pins == 3


def test_invalid_contexts_are_refused(certified: Catalogue) -> None:
    create = certified.contexts.create
    for name in ("", "now", "default", "a b", "../x", "a" * 64, "-x"):
        refused("bad-name", lambda name=name: create(name, OWNER, "x"))
    refused("nothing-to-pin", lambda: create("empty", OWNER, "x", pins=[]))
    refused("nothing-to-pin", lambda: create("empty", "somebody", "x"))
    refused("no-such-psf", lambda: create("wrong", OWNER, "x", pins=[pin("nobody")]))
    twice = [pin("a"), pin("draft", years(2020, 2021))]
    message = refused("ranges-overlap", lambda: create("twice", OWNER, "x", pins=twice))
    assert identity("a") in message and identity("draft") in message
    certified.add(psf("nameless", instrument=None))
    refused("no-line", lambda: create("wrong", OWNER, "x", pins=[pin("nameless")]))
    for name in ("empty", "wrong", "twice"):
        assert certified.contexts.find(name, OWNER) is None


@BOTH
def test_simultaneous_identical_contexts_are_made_once(certified: Catalogue) -> None:
    start = threading.Barrier(6)

    def make(_: int) -> tuple[str, bool]:
        start.wait()
        row, new = certified.contexts.create("first", OWNER, "x")
        return row.id, new

    with ThreadPoolExecutor(6) as pool:
        made = list(pool.map(make, range(6)))
    assert len({identity for identity, _ in made}) == 1 and sum(new for _, new in made) == 1


def test_the_default_context_changes_and_keeps_a_history(certified: Catalogue) -> None:
    contexts = certified.contexts
    assert contexts.default(OWNER) is None and contexts.default_changes(OWNER) == []
    first, _ = contexts.create("first", OWNER, "x")
    second, _ = contexts.create("second", OWNER, "x")
    contexts.set_default("first", OWNER, "ann", "good")
    contexts.set_default(second.id, OWNER, "bob", "better")
    contexts.set_default(None, OWNER, "ann")
    contexts.set_default("first", OWNER, "ann", "back")
    now = contexts.default(OWNER)
    assert now is not None and now.id == first.id and contexts.default("somebody") is None
    history = [(move.context_id, move.by, move.reason) for move in contexts.default_changes(OWNER)]
    assert history == [
        (first.id, "ann", "back"), (None, "ann", ""), (second.id, "bob", "better"), (first.id, "ann", "good"),
    ]  # fmt: skip
    refused("no-such-context", lambda: contexts.set_default("third", OWNER, "ann"))


# The one PSF ----------------------------------------------------------------------------------------


# Filters that leave no PSF, and what the error says of them.
NOTHING = (
    (PsfFilter("aia"), "no PSF has instrument aia"),
    (PsfFilter("hri_euv", "193"), "no PSF with instrument hri_euv has channel 193"),
    (
        PsfFilter("hri_euv", "174", "total", valid_at=seconds("2030-01-01")),
        " has valid_at 2030-01-01T00:00:00Z",
    ),
    (PsfFilter(name="draft"), "no PSF with name draft has status certified"),
)


def test_only_certified_psfs_are_searched_by_default_and_one_must_fit(certified: Catalogue) -> None:
    at = seconds("2020-06-01")
    for filters, name in (
        (PsfFilter("hri_euv", valid_at=at), "a"),
        (PsfFilter(version="1.1.0"), "b"),
        (PsfFilter(status="draft"), "draft"),
    ):
        assert look(certified, filters, OWNER, None).one().name == name
    message = refused("several-psfs-fit", look(certified, LINE, OWNER, None).one)
    assert all(identity(name) in message for name in ("a", "b")) and identity("draft") not in message
    assert "instrument hri_euv, channel 174, kind total, status certified" in message
    for filters, words in NOTHING:
        assert words in refused("no-psf-fits", look(certified, filters, OWNER, None).one)


def test_the_default_context_is_searched_unless_the_request_says_now(certified: Catalogue) -> None:
    certified.contexts.create("old", OWNER, "x", pins=[pin("draft", years(None, None))])
    certified.contexts.set_default("old", OWNER, "x")
    at = seconds("2020-06-01")
    for context, name in ((None, "draft"), ("old", "draft"), ("now", "a")):
        found = look(certified, PsfFilter("hri_euv", "174", "total", valid_at=at), OWNER, context)
        assert found.one().name == name
        assert (found.context is None) == (context == "now")
    message = refused("no-psf-fits", look(certified, PsfFilter("hri_euv", "304"), OWNER, "old").one)
    assert "channel 304" in message
    refused("no-such-context", lambda: look(certified, LINE, OWNER, "unknown"))


def test_an_image_gets_the_psf_of_its_time_and_the_error_says_what_does_not_fit(certified: Catalogue) -> None:
    for date, name in (("2020-06-01", "a"), ("2021-01-01T00:00:00", "b")):
        found = picked_for_image(certified, header(date_obs=date), OWNER, None)
        assert found is not None and found.one().name == name
    far = header(date_obs="2030-01-01")
    assert "valid_at 2030-01-01" in refused("no-psf-fits", look_for_image(certified, far, OWNER, None).one)
    other = header(instrument=None, detector="FSI", wavelnth=304.0)
    message = refused("no-psf-fits", look_for_image(certified, other, OWNER, None).one)
    assert "no PSF has instrument fsi" in message
    nameless = header(instrument=None, detector=None, instrume=None)
    for cards, owner in ((header(wavelnth=304.0), OWNER), (header(), "somebody"), (nameless, OWNER)):
        assert picked_for_image(certified, cards, owner, None) is None, "nothing certified: as before"


def test_images_without_a_time_or_a_name(certified: Catalogue) -> None:
    for date in (None, "yesterday"):
        cards = header(date_obs=date)
        message = refused("no-date", lambda cards=cards: look_for_image(certified, cards, OWNER, None))
        assert "hri_euv/174/total" in message
    certified.add(psf("always", channel="304"))
    certify(certified, "always", "1.0.0")
    found = look_for_image(certified, header(wavelnth=304.0, date_obs=None), OWNER, None)
    assert found.one().name == "always"
    nameless = header(instrument=None, detector=None, instrume=None)
    refused("no-instrument", lambda: look_for_image(certified, nameless, OWNER, None))
    certified.add(psf("aia", instrument="aia_3", channel="193"))
    certify(certified, "aia", "1.0.0")
    cards = header(instrument=None, detector=None, instrume="AIA_3", wavelnth=193.0)
    assert look_for_image(certified, cards, OWNER, None).one().name == "aia", "by the header's word"


def test_a_deconvolution_in_a_context_uses_no_psf_outside_it(certified: Catalogue) -> None:
    certified.add(psf("other", channel="304"))
    certified.contexts.create("other", OWNER, "x", pins=[pin("other")])
    refused("no-psf-fits", lambda: picked_for_image(certified, header(), OWNER, "other"))
    certified.contexts.set_default("other", OWNER, "x")
    refused("no-psf-fits", lambda: picked_for_image(certified, header(), OWNER, None))
    now = picked_for_image(certified, header(), OWNER, "now")
    assert now is not None and now.one().name == "a" and now.context is None
    assert picked_for_image(certified, header(wavelnth=193.0), OWNER, None) is None, "in no series: as before"
    refused("no-psf-fits", lambda: picked_for_image(certified, header(wavelnth=193.0), OWNER, "other"))
