"""Version numbers, ranges and steps of time, and variants of a channel, without a database."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from psfcore.errors import DataError
from workers.versions import (
    FEWEST_STEPS,
    LONGEST_STEP_S,
    Validity,
    channel_of,
    check_version,
    interpolated_time,
    is_variant_of,
    iso,
    next_version,
    seconds,
    series_of,
    variant_for,
    without_variant,
    word,
)

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


DAY = 86_400.0


def test_the_nearest_of_enough_steps() -> None:
    start = seconds("2022-03-01T06:30:00.25")
    for days in (0.01, 0.5, 7.0, 63.9, 64.0, 365.25, 3000.0):
        end = start + days * DAY
        times = np.linspace(start, end, 4001)
        found = np.array([interpolated_time(start, end, float(at)) for at in times])
        step = min(LONGEST_STEP_S, days * DAY / FEWEST_STEPS)
        assert np.abs(found - times).max() <= 0.5 * step + 0.5 + 1e-6, "nearest step, to a whole second"
        assert found.min() >= start and found.max() <= end and (np.diff(found) >= 0).all(), days
        assert len(set(found)) <= max(FEWEST_STEPS, np.ceil(days)) + 1, days
        assert interpolated_time(start, end, start) == start and interpolated_time(start, end, end) == end


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
