"""Changes of status, version numbers and ranges of times, without a database."""

from __future__ import annotations

import math
from itertools import product

import pytest

from psfcore.errors import DataError
from workers.versions.series import channel_of, series_of, word
from workers.versions.status import MAY_BECOME, PsfStatus, check_transition, check_version, next_version
from workers.versions.validity import Validity, iso, seconds

DRAFT, CERTIFIED, DEPRECATED = PsfStatus
ALLOWED = {
    (DRAFT, CERTIFIED),
    (CERTIFIED, CERTIFIED),
    (CERTIFIED, DEPRECATED),
    (DEPRECATED, DEPRECATED),
}


@pytest.mark.parametrize(("before", "after"), list(product(PsfStatus, PsfStatus)))
def test_allowed_and_refused_changes_of_status(before: PsfStatus, after: PsfStatus) -> None:
    if (before, after) in ALLOWED:
        check_transition(before, after)
        return
    with pytest.raises(DataError, match=f"expected status .* for a {before} PSF; got {after}") as caught:
        check_transition(before, after)
    assert caught.value.code == "wrong-transition"
    assert all(state in caught.value.message for state in MAY_BECOME[before])


@pytest.mark.parametrize(
    ("released", "following"),
    [
        ([], "1.0.0"),
        (["1.0.0"], "1.1.0"),
        (["1.9.0", "1.10.2", "1.2.30"], "1.11.0"),
        (["2.0.0", "1.10.2"], "2.1.0"),
    ],
)
def test_the_next_version_is_after_the_highest_by_number(released: list[str], following: str) -> None:
    assert next_version(released) == following
    assert check_version(following, released) == following


@pytest.mark.parametrize(
    ("version", "code"),
    [
        (None, "version-missing"),
        ("1.0", "bad-version"),
        ("v1.0.0", "bad-version"),
        ("01.0.0", "bad-version"),
        ("1.0.0-draft", "bad-version"),
        ("1.0.0\n", "bad-version"),
        ("1.0.1234567", "bad-version"),
        ("١.0.0", "bad-version"),
        ("1.0.0", "version-taken"),
    ],
)
def test_invalid_versions_are_refused_and_a_free_one_is_named(version: str | None, code: str) -> None:
    with pytest.raises(DataError, match=r"the next free version is 1\.1\.0") as caught:
        check_version(version, ["1.0.0"])
    assert caught.value.code == code


@pytest.mark.parametrize(
    ("text", "at"),
    [
        ("1970-01-02", 86400.0),
        ("1970-01-01T00:00:01", 1.0),
        ("1970-01-01T00:00:01Z", 1.0),
        ("1970-01-01T01:00:01.500+01:00", 1.5),
        ("1969-12-31T23:59:59Z", -1.0),
    ],
)
def test_times_are_read_and_written(text: str, at: float) -> None:
    assert seconds(text) == at
    told = iso(at)
    assert told is not None and told.endswith("Z") and seconds(told) == at


@pytest.mark.parametrize(
    "text", ["2024", "5", "now", "2024-13-01", "2024-01-01 12:00", "2024-01-01T25:00", "", "1e9"]
)
def test_invalid_times_are_refused(text: str) -> None:
    with pytest.raises(DataError, match="expected a time such as") as caught:
        seconds(text)
    assert caught.value.code == "bad-time"


A, B, C = (f"20{year}-01-01" for year in (20, 21, 22))


@pytest.mark.parametrize(
    ("one", "other", "overlap"),
    [
        ((A, B), (B, C), False),
        ((A, C), (B, C), True),
        ((A, C), (B, None), True),
        ((None, B), (B, None), False),
        ((None, None), (A, B), True),
        ((A, B), (A, B), True),
        ((None, B), (None, A), True),
    ],
)
def test_ranges_are_half_open(
    one: tuple[str | None, str | None], other: tuple[str | None, str | None], overlap: bool
) -> None:
    first, second = Validity.of(*one), Validity.of(*other)
    assert first.overlaps(second) == second.overlaps(first) == overlap
    assert first.holds(first.start) or first.start == -math.inf
    assert not first.holds(first.end)


@pytest.mark.parametrize(("start", "end"), [(B, A), (A, A)])
def test_an_empty_range_is_refused(start: str, end: str) -> None:
    with pytest.raises(DataError, match="expected valid_from before valid_to") as caught:
        Validity.of(start, end)
    assert caught.value.code == "empty-range"


def test_series_and_their_names() -> None:
    assert series_of("hri_euv", "174", "total") == "hri_euv/174/total"
    assert series_of("mine", None, "total") == "mine/-/total"
    assert series_of(None, "174", "total") is None
    assert (channel_of("aia_3", 193.0), channel_of("hri_euv", None), channel_of("mine", None)) == (
        "193",
        "174",
        None,
    )
    assert (channel_of("x", math.nan), channel_of("x", 1e300), channel_of("x", -5.0)) == (None, None, None)
    assert (word("AIA_3"), word("EUI/FSI 304"), word("  "), word(None)) == (
        "aia_3",
        "eui_fsi_304",
        None,
        None,
    )


def test_the_version_of_an_interpolated_psf_is_not_counted() -> None:
    """It is deprecated together with its ends, without having been certified."""
    assert next_version(["1.2.0", "0.1.0+0123abcd"]) == "1.3.0"
    assert next_version(["0.1.0+0123abcd"]) == "1.0.0"
