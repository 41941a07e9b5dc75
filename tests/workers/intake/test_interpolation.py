"""Between which PSFs the PSF of an image is interpolated: certified ones, or those that a context pins."""

from __future__ import annotations

from typing import Any

import pytest

from tests.workers.psf_examples import OWNER, certify, deprecate, header_of, identity, psf, refused, years
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.contexts import Pin
from workers.catalogue.tables import PsfRow
from workers.contract.identities import interpolated_psf_identity
from workers.contract.requests import Deconvolve, PsfInterpolate
from workers.intake.psf_choice import picked_for_image, reasoned_psf
from workers.intake.requests import resolved_deconvolution

SERIES = "hri_euv/174/total"


@pytest.fixture
def certified(catalogue: Catalogue) -> Catalogue:
    """PSFs certified for 2020, 2022 and 2024, and nothing for the years between."""
    for name, year in (("a", 2020), ("b", 2022), ("c", 2024)):
        catalogue.add(psf(name))
        certify(catalogue, name, f"1.{year - 2020}.0", years(year, year + 1))
    return catalogue


def interpolation(
    catalogue: Catalogue, date: str | None, context: str | None = None
) -> PsfInterpolate | None:
    found = picked_for_image(catalogue, header_of(date), OWNER, context)
    return None if found is None else found.interpolation


def allow(catalogue: Catalogue, interpolated: bool = True, **asked: Any) -> None:
    catalogue.series.set_interpolated(SERIES, OWNER, interpolated, "tester", **asked)


def test_only_a_series_that_says_so_is_interpolated(certified: Catalogue) -> None:
    assert interpolation(certified, "2021-06-01") is None
    allow(certified)
    found = interpolation(certified, "2021-06-01T20:00:00")
    assert found is not None
    assert (found.before_psf_id, found.after_psf_id) == (identity("a"), identity("b"))
    assert (found.before_time, found.after_time) == ("2021-01-01T00:00:00Z", "2022-01-01T00:00:00Z")
    assert found.time == "2021-06-02T00:00:00Z", "the nearest step of a day"
    allow(certified, False)
    assert interpolation(certified, "2021-06-01") is None
    changes = certified.series.changes(SERIES, OWNER)
    assert [(one.interpolated, one.by) for one in changes] == [(False, "tester"), (True, "tester")]


def test_within_a_range_the_certified_psf_is_used_and_beyond_the_ends_nothing_is_extrapolated(
    certified: Catalogue,
) -> None:
    allow(certified)
    inside = picked_for_image(certified, header_of("2022-06-01"), OWNER, None)
    assert inside is not None and inside.one().name == "b" and inside.interpolation is None
    for date in ("2019-12-31", "2025-01-01"):
        found = picked_for_image(certified, header_of(date), OWNER, None)
        assert found is not None and found.interpolation is None
        refused("no-psf-fits", found.one)
    first, last = interpolation(certified, "2021-01-01"), interpolation(certified, "2021-12-31T23:59:59")
    assert first is not None and first.time == first.before_time
    assert last is not None and last.time == last.after_time
    later = interpolation(certified, "2023-03-01")
    assert later is not None and later.before_psf_id == identity("b")
    refused("no-date", lambda: interpolation(certified, None))
    between = picked_for_image(certified, header_of("2021-06-01"), OWNER, None)
    assert between is not None
    message = refused("no-psf-fits", between.one)
    assert identity("a") in message and identity("b") in message and "interpolates" in message


def test_a_deconvolution_gets_the_id_of_the_interpolated_psf_and_how_to_make_it(certified: Catalogue) -> None:
    allow(certified)

    def resolved(date: str) -> Any:
        wanted = Deconvolve(image_id="1" * 64)
        return wanted, resolved_deconvolution(wanted, header_of(date), certified, OWNER)

    wanted, found = resolved("2021-06-01T13:00:00")
    assert found.psf_interpolation is not None and found.psf_recipe is None
    assert found.psf_id == interpolated_psf_identity(found.psf_interpolation)
    assert found.picked_for == "hri_euv"
    assert resolved("2021-06-02T03:00:00")[1].psf_id == found.psf_id, "images of a day share a PSF"
    assert resolved("2021-06-03T03:00:00")[1].psf_id != found.psf_id
    reason = reasoned_psf(wanted, found, certified, OWNER)
    assert reason.status is None and reason.version == f"0.1.0+{found.psf_id[:8]}"
    for words in (
        "interpolated to 2021-06-02",
        f"{identity('a')[:12]} (a 1.0.0)",
        "(b 1.2.0)",
        "makes it first",
    ):
        assert words in reason.why
    certified.add(interpolated_row("between", found.psf_id))
    there = reasoned_psf(wanted, found, certified, OWNER)
    assert there.status == "draft" and there.why.endswith("from 2022-01-01T00:00:00Z.")


def interpolated_row(name: str, psf_id: str) -> PsfRow:
    """The row of a PSF that was interpolated between a and b."""
    row = psf(
        name,
        origin="interpolated",
        details={"parents": {"before": identity("a"), "after": identity("b")}, "shape": [8, 8]},
    )
    row.id = psf_id
    return row


def test_a_context_keeps_whether_a_series_is_interpolated(certified: Catalogue) -> None:
    never, _ = certified.contexts.create("never", OWNER, "x")
    allow(certified)
    always, _ = certified.contexts.create("always", OWNER, "x")
    assert {pin.interpolated for pin in certified.contexts.pins(never.id, OWNER)} == {False}
    assert {pin.interpolated for pin in certified.contexts.pins(always.id, OWNER)} == {True}
    message = refused("name-taken", lambda: certified.contexts.create("never", OWNER, "x"))
    assert "interpolated" in message
    assert interpolation(certified, "2021-06-01", "never") is None
    before = interpolation(certified, "2021-06-01", "always")
    assert before is not None and before == interpolation(certified, "2021-06-01", "now")
    allow(certified, False)
    deprecate(certified, "a")
    assert interpolation(certified, "2021-06-01", "always") == before, "a context never changes"
    assert interpolation(certified, "2021-06-01", "now") is None
    certified.contexts.set_default("always", OWNER, "x")
    assert interpolation(certified, "2021-06-01") == before
    same, new = certified.contexts.create("never", OWNER, "x", pins=[Pin(identity(n)) for n in "abc"])
    assert not new and same.id == never.id


def test_a_context_interpolates_between_the_ranges_of_its_pins(certified: Catalogue) -> None:
    allow(certified)
    pins = [Pin(identity("a"), years(2019, 2020)), Pin(identity("c"))]
    certified.contexts.create("mine", OWNER, "x", pins=pins)
    found = interpolation(certified, "2022-06-01", "mine")
    assert found is not None
    assert (found.before_psf_id, found.before_time) == (identity("a"), "2020-01-01T00:00:00Z")
    assert (found.after_psf_id, found.after_time) == (identity("c"), "2024-01-01T00:00:00Z")


def test_interpolated_psfs_are_deprecated_with_an_end(certified: Catalogue) -> None:
    certified.add(interpolated_row("between", "7" * 64))
    certified.add(interpolated_row("kept", identity("kept")))
    certify(certified, "kept", "3.0.0", years(2021, 2022))
    certified.add(psf("other", origin="interpolated", details={"parents": {"before": identity("b")}}))
    deprecate(certified, "a")
    rows = [certified.get(PsfRow, name, OWNER) for name in ("7" * 64, identity("kept"), identity("other"))]
    assert [row.status for row in rows if row is not None] == ["deprecated", "certified", "draft"]
    (change,) = certified.psfs.changes("7" * 64, OWNER)
    assert f"interpolated from PSF {identity('a')[:12]}" in change.reason and "worse" in change.reason
    assert certified.psfs.released(SERIES, OWNER)
    certified.add(psf("d"))
    certify(certified, "d", "1.6.0", years(2025, None))


def test_unknown_series_and_other_kinds_are_refused(certified: Catalogue) -> None:
    certified.add(psf("mesh", kind="diffraction"))
    certify(certified, "mesh", "1.0.0")
    change = certified.series.set_interpolated
    message = refused("no-such-series", lambda: change("fsi/174/total", OWNER, True, "x"))
    assert "fsi/174/total" in message and "heliopsf psf series" in message
    refused("no-such-series", lambda: change(SERIES, "somebody", True, "x"))
    refused("no-such-series", lambda: certified.series.changes("fsi/174/total", OWNER))
    refused("series-not-total", lambda: change("hri_euv/174/diffraction", OWNER, True, "x"))
    assert list(certified.series.all(OWNER)) == ["hri_euv/174/diffraction", SERIES]
    assert certified.series.all("somebody") == {}


def test_changes_of_a_series_count_in_the_quota(certified: Catalogue) -> None:
    before = certified.owners.usage(OWNER, 0).used_rows
    allow(certified)
    allow(certified)
    assert certified.owners.usage(OWNER, 0).used_rows == before + 1, "the second changes nothing"


WRONG = (
    ({"time": "2020-12-31"}, "not extrapolated"),
    ({"time": "2022-01-01T00:00:01"}, "not extrapolated"),
    ({"after_time": "2021-01-01"}, "exchange the two PSFs"),
    ({"time": "soon"}, "pattern"),
    ({"time": "2021-02-31"}, "expected a time such as"),
    ({"before_psf_id": "x"}, "pattern"),
)


def test_requests_with_wrong_times_are_refused() -> None:
    known = {
        "before_psf_id": "a" * 64, "before_time": "2021-01-01", "after_psf_id": "b" * 64, "after_time": "2022-01-01",
        "time": "2021-05-01",
    }  # fmt: skip
    first = PsfInterpolate.model_validate(known)
    same = PsfInterpolate.model_validate(known | {"time": "2021-05-01T02:00:00+02:00"})
    assert interpolated_psf_identity(first) == interpolated_psf_identity(same), (
        "the same time in another form"
    )
    for changes, words in WRONG:
        with pytest.raises(ValueError, match=words):
            PsfInterpolate.model_validate(known | changes)
