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


def test_allowed_and_refused_changes_of_status() -> None:
    for before, after in product(PsfStatus, PsfStatus):
        if (before, after) in ALLOWED:
            check_transition(before, after)
            continue
        with pytest.raises(DataError, match=f"expected status .* for a {before} PSF; got {after}") as caught:
            check_transition(before, after)
        assert caught.value.code == "wrong-transition"
        assert all(state in caught.value.message for state in MAY_BECOME[before])


# Released versions, and the next one. That of an interpolated PSF, which is deprecated with its ends, does not count.
NEXT: tuple[tuple[list[str], str], ...] = (
    ([], "1.0.0"),
    (["1.0.0"], "1.1.0"),
    (["1.9.0", "1.10.2", "1.2.30"], "1.11.0"),
    (["2.0.0", "1.10.2"], "2.1.0"),
    (["1.2.0", "0.1.0+0123abcd"], "1.3.0"),
    (["0.1.0+0123abcd"], "1.0.0"),
)
INVALID = ("1.0", "v1.0.0", "01.0.0", "1.0.0-draft", "1.0.0\n", "1.0.1234567", "١.0.0")


def test_the_next_version_is_after_the_highest_by_number_and_invalid_ones_are_refused() -> None:
    for released, following in NEXT:
        assert next_version(released) == following
        assert check_version(following, released) == following
    for version, code in (
        (None, "version-missing"),
        ("1.0.0", "version-taken"),
        *((bad, "bad-version") for bad in INVALID),
    ):
        with pytest.raises(DataError, match=r"the next free version is 1\.1\.0") as caught:
            check_version(version, ["1.0.0"])
        assert caught.value.code == code, version


def test_times_are_read_and_written() -> None:
    for text, at in (
        ("1970-01-02", 86400.0),
        ("1970-01-01T00:00:01", 1.0),
        ("1970-01-01T00:00:01Z", 1.0),
        ("1970-01-01T01:00:01.500+01:00", 1.5),
        ("1969-12-31T23:59:59Z", -1.0),
    ):
        assert seconds(text) == at
        again = iso(at)
        assert again is not None and again.endswith("Z") and seconds(again) == at
    for text in ("2024", "5", "now", "2024-13-01", "2024-01-01 12:00", "2024-01-01T25:00", "", "1e9"):
        with pytest.raises(DataError, match="expected a time such as") as caught:
            seconds(text)
        assert caught.value.code == "bad-time", text


A, B, C = (f"20{year}-01-01" for year in (20, 21, 22))
OVERLAPS: tuple[tuple[tuple[str | None, str | None], tuple[str | None, str | None], bool], ...] = (
    ((A, B), (B, C), False),
    ((A, C), (B, C), True),
    ((A, C), (B, None), True),
    ((None, B), (B, None), False),
    ((None, None), (A, B), True),
    ((A, B), (A, B), True),
    ((None, B), (None, A), True),
)


def test_ranges_are_half_open_and_not_empty() -> None:
    for one, other, overlap in OVERLAPS:
        first, second = Validity.of(*one), Validity.of(*other)
        assert first.overlaps(second) == second.overlaps(first) == overlap, (one, other)
        assert first.holds(first.start) or first.start == -math.inf
        assert not first.holds(first.end)
    for start, end in ((B, A), (A, A)):
        with pytest.raises(DataError, match="expected valid_from before valid_to") as caught:
            Validity.of(start, end)
        assert caught.value.code == "empty-range"


def test_series_and_their_names() -> None:
    assert series_of("hri_euv", "174", "total") == "hri_euv/174/total"
    assert series_of("mine", None, "total") == "mine/-/total"
    assert series_of(None, "174", "total") is None
    assert [channel_of("aia_3", 193.0), channel_of("hri_euv", None)] == ["193", "174"]
    for name, wavelength in (("mine", None), ("x", math.nan), ("x", 1e300), ("x", -5.0)):
        assert channel_of(name, wavelength) is None
    words = [word(text) for text in ("AIA_3", "EUI/FSI 304", "  ", None)]
    assert words == ["aia_3", "eui_fsi_304", None, None]
