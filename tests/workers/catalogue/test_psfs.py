"""PSFs in the catalogue: certified, deprecated, superseded; found by properties and validity."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest

from psfcore.errors import DataError
from tests.workers.databases import BOTH
from tests.workers.psf_examples import OWNER, between, certify, deprecate, identity, psf, refused, years
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import PsfRow
from workers.contract.psf_status import StatusChange
from workers.versions import PsfStatus, seconds


@pytest.fixture
def three(catalogue: Catalogue) -> Catalogue:
    """Three drafts of one series."""
    for name in ("a", "b", "c"):
        catalogue.add(psf(name))
    return catalogue


def status(catalogue: Catalogue, name: str) -> str:
    row = catalogue.get(PsfRow, identity(name), OWNER)
    assert row is not None
    return row.status


def test_a_draft_is_certified_under_a_version_and_a_range(three: Catalogue) -> None:
    row = certify(three, "a", "1.0.0", years(2020, None))
    assert (row.status, row.version) == ("certified", "1.0.0")
    assert row.valid_from == seconds("2020-01-01") and row.valid_to == float("inf")
    (change,) = three.psfs.changes(row.id, OWNER)
    assert (change.status_before, change.status, change.by, change.reason) == (
        "draft", "certified", "tester", "tested",
    )  # fmt: skip
    assert (change.version_before, change.version) == ("0.1.0+a", "1.0.0")
    assert abs(change.at - time.time()) < 5


def test_ranges_of_a_series_may_not_overlap_and_the_error_names_the_other_psf(three: Catalogue) -> None:
    certify(three, "a", "1.0.0", years(2020, 2022))
    for validity in (years(None, None), years(2019, 2030), years(2020, 2022), years(2021, None)):
        refused("ranges-overlap", lambda validity=validity: certify(three, "c", "1.2.0", validity))
    message = refused("ranges-overlap", lambda: certify(three, "b", "1.1.0", years(2021, 2023)))
    assert identity("a") in message and "[2020-01-01T00:00:00Z, 2022-01-01T00:00:00Z)" in message
    assert status(three, "b") == "draft" and three.psfs.changes(identity("b"), OWNER) == []
    certify(three, "b", "1.1.0", years(2022, None))
    certify(three, "c", "1.2.0", years(None, 2020))


def test_other_series_and_owners_have_ranges_of_their_own(three: Catalogue) -> None:
    three.add(psf("other channel", channel="304"))
    three.add(psf("other kind", kind="diffraction"))
    three.add(psf("a", owner="somebody"))
    certify(three, "a", "1.0.0")
    certify(three, "other channel", "1.0.0")
    certify(three, "other kind", "1.0.0")
    asked = StatusChange(status=PsfStatus.CERTIFIED, reason="", version="1.0.0")
    assert three.psfs.change(identity("a"), "somebody", asked, "x").status == "certified"
    refused("no-such-psf", lambda: three.psfs.change(identity("b"), "somebody", asked, "x"))


def test_a_version_is_given_once_and_never_again(three: Catalogue) -> None:
    certify(three, "a", "1.0.0", years(2020, 2021))
    deprecate(three, "a")
    message = refused("version-taken", lambda: certify(three, "b", "1.0.0"))
    assert "the next free version is 1.1.0" in message
    assert three.psfs.released("hri_euv/174/total", OWNER) == ["1.0.0"]


def test_a_certified_psf_gets_another_range_and_keeps_its_version(three: Catalogue) -> None:
    certify(three, "a", "1.0.0", years(2020, None))
    again = StatusChange(status=PsfStatus.CERTIFIED, reason="ends", **between(years(2020, 2022)))
    row = three.psfs.change(identity("a"), OWNER, again, "tester")
    assert (row.version, row.valid_to) == ("1.0.0", seconds("2022-01-01"))
    row = three.psfs.change(
        identity("a"), OWNER, StatusChange(status=PsfStatus.CERTIFIED, reason="as it is"), "tester"
    )
    assert row.valid_to == seconds("2022-01-01"), "a range that is not spoken of stays"
    assert len(three.psfs.changes(identity("a"), OWNER)) == 3
    other = StatusChange(status=PsfStatus.CERTIFIED, reason="", version="2.0.0")
    refused("not-of-this-change", lambda: three.psfs.change(identity("a"), OWNER, other, "tester"))


def test_a_psf_supersedes_others_in_one_step(three: Catalogue) -> None:
    certify(three, "a", "1.0.0", years(2020, 2021))
    certify(three, "b", "1.1.0", years(2021, None))
    asked = [identity("a"), identity("b")]
    certify(three, "c", "2.0.0", years(2020, None), supersedes=asked)
    for name in ("a", "b"):
        row = three.get(PsfRow, identity(name), OWNER)
        assert row is not None and (row.status, row.successor_id) == ("deprecated", identity("c"))
        assert [change.status for change in three.psfs.changes(row.id, OWNER)] == ["certified", "deprecated"]


def test_an_invalid_supersession_changes_nothing(three: Catalogue) -> None:
    certify(three, "a", "1.0.0")
    three.add(psf("far", channel="304"))
    certify(three, "far", "1.0.0")
    for others in (("b",), ("c",), ("far",), ("a", "nobody")):
        asked = [*map(identity, others)]
        refused("not-to-supersede", lambda asked=asked: certify(three, "c", "2.0.0", supersedes=asked))
    statuses = [status(three, name) for name in ("a", "c", "far")]
    assert statuses == ["certified", "draft", "certified"]


def test_deprecation_names_a_certified_successor_of_the_series(three: Catalogue) -> None:
    certify(three, "a", "1.0.0", years(2020, 2021))
    three.add(psf("far", channel="304"))
    certify(three, "far", "1.0.0")
    for other in ("a", "b", "far", "nobody"):
        refused("no-such-successor", lambda other=other: deprecate(three, "a", other))
    assert status(three, "a") == "certified"
    deprecate(three, "a")
    refused("successor-named", lambda: deprecate(three, "a"))
    certify(three, "b", "1.1.0", years(2020, 2021))
    assert deprecate(three, "a", "b").successor_id == identity("b"), "named later, once"
    certify(three, "c", "1.2.0", years(2021, 2022))
    refused("successor-named", lambda: deprecate(three, "a", "c"))


def test_wrong_transitions_change_nothing(three: Catalogue) -> None:
    refused("wrong-transition", lambda: deprecate(three, "a"))
    certify(three, "a", "1.0.0")
    deprecate(three, "a")
    refused("wrong-transition", lambda: certify(three, "a", "1.1.0"))
    back = StatusChange(status=PsfStatus.DRAFT, reason="")
    refused("wrong-transition", lambda: three.psfs.change(identity("a"), OWNER, back, "x"))
    with_version = StatusChange(status=PsfStatus.DEPRECATED, reason="", version="1.0.0")
    certify(three, "b", "1.1.0")
    refused("not-of-this-change", lambda: three.psfs.change(identity("b"), OWNER, with_version, "x"))
    with_successor = StatusChange(
        status=PsfStatus.CERTIFIED, reason="", version="1.0.0", successor=identity("b")
    )
    refused("not-of-this-change", lambda: three.psfs.change(identity("c"), OWNER, with_successor, "x"))


def test_a_draft_without_a_series_gets_one_when_it_is_certified(catalogue: Catalogue) -> None:
    catalogue.add(psf("mine", instrument=None, channel=None, kind="uploaded", origin="uploaded"))
    refused("no-line", lambda: certify(catalogue, "mine", "1.0.0"))
    said = {"instrument": "aia_3", "channel": "193", "kind": "total"}
    row = certify(catalogue, "mine", "1.0.0", **said)
    assert (row.series, row.instrument, row.channel, row.kind) == ("aia_3/193/total", "aia_3", "193", "total")
    catalogue.add(psf("known"))
    refused("line-known", lambda: certify(catalogue, "known", "1.0.0", channel="304"))


def together(*works: Callable[[], object]) -> list[str]:
    """Do all at the same moment; what each was refused for, or "done"."""
    start = threading.Barrier(len(works))

    def one(work: Callable[[], object]) -> str:
        start.wait()
        try:
            work()
        except DataError as error:
            return error.code
        return "done"

    with ThreadPoolExecutor(len(works)) as pool:
        return list(pool.map(one, works))


@BOTH
def test_of_certifications_at_once_one_wins(catalogue: Catalogue) -> None:
    names = [str(n) for n in range(6)]
    for name in names:
        catalogue.add(psf(name))
    ended = together(
        *(lambda n=n, name=name: certify(catalogue, name, f"1.{n}.0") for n, name in enumerate(names))
    )
    assert sorted(ended) == ["done"] + ["ranges-overlap"] * 5
    (row,) = catalogue.psfs.page(PsfFilter(status="certified"), OWNER, limit=10)
    assert [change.status for change in catalogue.psfs.changes(row.id, OWNER)] == ["certified"]


@BOTH
def test_two_that_supersede_the_same_psf_at_once(three: Catalogue) -> None:
    certify(three, "a", "1.0.0")
    old = (identity("a"),)
    ended = together(
        lambda: certify(three, "b", "1.1.0", supersedes=old),
        lambda: certify(three, "c", "1.2.0", supersedes=old),
    )
    assert sorted(ended) == ["done", "not-to-supersede"]
    assert sorted(status(three, name) for name in "abc") == ["certified", "deprecated", "draft"]


# Found ----------------------------------------------------------------------------------------------


@pytest.fixture
def many(catalogue: Catalogue) -> Catalogue:
    """Two series with three certified versions each, one deprecated, and drafts."""
    n = 0
    for channel in ("174", "304"):
        for year in (2020, 2021, 2022):
            n += 1
            name = f"{channel} {year}"
            catalogue.add(psf(name, channel=channel, created_at=float(n)))
            certify(catalogue, name, f"1.{year - 2020}.0", years(year, year + 1))
    catalogue.add(psf("old", channel="304", created_at=8.0))
    certify(catalogue, "old", "0.9.0", years(2010, 2011))
    deprecate(catalogue, "old", "304 2020")
    catalogue.add(psf("draft", created_at=9.0))
    catalogue.add(psf("part", kind="diffraction", created_at=10.0))
    catalogue.add(psf("mine", instrument="mine", owner="somebody"))
    return catalogue


PAGES: tuple[tuple[PsfFilter, list[str]], ...] = (
    (PsfFilter(), ["part", "draft", "old", "304 2022", "304 2021", "304 2020", "174 2022", "174 2021", "174 2020"]),
    (PsfFilter(channel="304"), ["old", "304 2022", "304 2021", "304 2020"]),
    (PsfFilter(kind="diffraction"), ["part"]),
    (PsfFilter(name="old"), ["old"]),
    (PsfFilter(version="1.1.0"), ["304 2021", "174 2021"]),
    (PsfFilter(status="deprecated"), ["old"]),
    (PsfFilter("hri_euv", "174", "total"), ["draft", "174 2022", "174 2021", "174 2020"]),
    (PsfFilter("hri_euv", "174", "total", status="certified"), ["174 2022", "174 2021", "174 2020"]),
    (PsfFilter(valid_at=seconds("2021-06-01")), ["304 2021", "174 2021"]),
    (PsfFilter("hri_euv", "174", "total", valid_at=seconds("2021-01-01")), ["174 2021"]),
    (PsfFilter(channel="304", valid_at=seconds("2020-12-31T23:59:59.9")), ["304 2020"]),
    (PsfFilter(valid_at=seconds("2010-06-01")), []),
    (PsfFilter(valid_at=seconds("2023-01-01")), []),
    (PsfFilter(valid_at=seconds("2019-12-31")), []),
    (PsfFilter(instrument="mine"), []),
)  # fmt: skip
EMPTIED_BY: tuple[tuple[PsfFilter, str | None], ...] = (
    (PsfFilter("hri_euv", "174", "total"), None),
    (PsfFilter("aia"), "instrument"),
    (PsfFilter("hri_euv", "193", "total", status="certified"), "channel"),
    (PsfFilter("hri_euv", "304", "diffraction"), "kind"),
    (PsfFilter("hri_euv", "304", version="3.0.0"), "version"),
    (PsfFilter("hri_euv", "304", "total", status="certified", valid_at=0.0), "valid_at"),
    (PsfFilter(kind="diffraction", status="certified"), "status"),
)


def test_lists_contain_psfs_that_meet_the_filters_newest_first(many: Catalogue) -> None:
    for filters, names in PAGES:
        assert [row.name for row in many.psfs.page(filters, OWNER, limit=50)] == names, filters
        paged: list[str] = []
        after = None
        while page := many.psfs.page(filters, OWNER, limit=2, after=after):
            paged += [row.name for row in page]
            after = (page[-1].created_at, page[-1].id)
        assert paged == names, filters
    for filters, name in EMPTIED_BY:
        assert many.psfs.emptied_by(filters, OWNER) == name, filters
