"""The PSF of an image: the variant of its channel, the two PSFs between which its PSF is interpolated, and the error,
for people and for programs, if its PSF is not known."""

from __future__ import annotations

import pickle
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from tests.conftest import write_image, write_psf
from tests.in_process import InProcess
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
from workers.catalogue.tables import PsfRow
from workers.contract.identities import interpolated_psf_identity
from workers.contract.requests import Deconvolve, PsfInterpolate
from workers.intake.psf_choice import look_for_image, picked_for_image, reasoned_psf
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


def test_nothing_is_interpolated_within_a_range_or_beyond_the_ends(certified: Catalogue) -> None:
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
    assert {one.interpolated for one in certified.contexts.pins(never.id, OWNER)} == {False}
    assert {one.interpolated for one in certified.contexts.pins(always.id, OWNER)} == {True}
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
    same, new = certified.contexts.create("never", OWNER, "x", pins=[pin(n) for n in "abc"])
    assert not new and same.id == never.id


def test_a_context_interpolates_between_the_ranges_of_its_pins(certified: Catalogue) -> None:
    allow(certified)
    pins = [pin("a", years(2019, 2020)), pin("c")]
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


@pytest.fixture
def variants(catalogue: Catalogue) -> Catalogue:
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


def test_the_header_chooses_the_variant(variants: Catalogue) -> None:
    assert chosen(variants, image(None)) == "plain"
    assert chosen(variants, image("closed")) == "plain"
    assert chosen(variants, image("Open 2")) == "open_2"
    assert chosen(variants, image(None, 0.984)) == "binned"
    refused("several-variants-fit", lambda: chosen(variants, image("Open 2", 0.984)))
    assert picked_for_image(variants, image("Open 2"), "somebody", None) is None
    assert chosen(variants, image("Open 2", wavelnth=174.5)) == "open_2"


def test_a_variant_has_its_own_versions_ranges_and_interpolation(variants: Catalogue) -> None:
    row = variants.psfs.released("hri_euv/174-open_2/total", OWNER)
    assert list(row) == ["1.0.0"]
    late = image("Open 2", date="2023-06-01")
    # The PSF of the channel alone is not used in its place.
    assert "channel 174-open_2" in refused("no-psf-fits", lambda: chosen(variants, late))
    variants.add(psf("later"))
    certify(variants, "later", "2.0.0", years(2024, None), channel="174-open_2")
    variants.series.set_interpolated("hri_euv/174-open_2/total", OWNER, True, "x")
    found = picked_for_image(variants, late, OWNER, None)
    assert found is not None and found.interpolation is not None
    assert found.interpolation.before_psf_id == identity("open_2")
    plain = picked_for_image(variants, image(None, date="2023-06-01"), OWNER, None)
    assert plain is not None and plain.interpolation is None


def test_a_context_chooses_among_its_own_variants(variants: Catalogue) -> None:
    variants.contexts.create("plain", OWNER, "x", pins=[pin("plain")])
    variants.contexts.create("all", OWNER, "x")
    assert chosen(variants, image("Open 2"), "plain") == "plain"
    assert chosen(variants, image("Open 2"), "all") == "open_2"
    assert chosen(variants, image("Open 2"), "now") == "open_2"


def test_only_a_draft_becomes_a_variant_of_its_channel(variants: Catalogue) -> None:
    variants.add(psf("other"))
    for channel in ("304", "304-open_2", "1740"):
        refused("line-known", partial(certify, variants, "other", "9.0.0", channel=channel))
    # A certified PSF keeps its series.
    refused(
        "line-known", lambda: certify(variants, "plain", "1.0.0", years(2020, 2021), channel="174-open_1")
    )


# TELESCOP differs from that of the archive, so the image is not recognised as one of aia_171.
AIA = {"TELESCOP": "SDO", "INSTRUME": "AIA_3", "WAVELNTH": 171, "CDELT1": 0.6, "CDELT2": 0.6}


def upload(local: InProcess, path: Path, size: int, **cards: object) -> str:
    """A PSF of its own size, so that each has an id of its own."""
    write_psf(path, size=size)
    fits.writeto(path, fits.getdata(path), fits.Header(cards), overwrite=True)
    return str(local.upload_psf(path, name=path.stem)["id"])


def refused_image(local: InProcess, tmp_path: Path, **cards: object) -> DataError:
    tmp_path.mkdir(exist_ok=True)
    write_image(tmp_path / "i.fits", **cards)
    with pytest.raises(DataError) as caught:
        local.deconvolve(tmp_path / "i.fits")
    assert caught.value.code == "no-psf-for-instrument"
    return caught.value


def test_the_error_names_instruments_psfs_and_ways(local: InProcess, tmp_path: Path) -> None:
    of_telescope = upload(local, tmp_path / "aia.fits", 32, INSTRUME="AIA_3", WAVELNTH=171)
    of_scale = upload(local, tmp_path / "scale.fits", 34, CDELT1=0.602)
    upload(local, tmp_path / "channel.fits", 36, INSTRUME="AIA_2", WAVELNTH=193, CDELT1=0.6)
    upload(local, tmp_path / "far.fits", 38, INSTRUME="XRT", CDELT1=1.03)
    error = refused_image(local, tmp_path, **AIA)
    assert [psf["id"] for psf in error.fields["psfs"]] == [of_scale, of_telescope], "newest first"
    assert [psf["same"] for psf in error.fields["psfs"]] == [["plate_scale"], ["telescope", "channel"]]
    instruments = {one["name"]: one for one in error.fields["instruments"]}
    assert set(instruments) == set(instrument_names())
    assert instruments["aia_171"]["same"] == ["telescope", "channel", "plate_scale"]
    assert instruments["hri_euv"]["same"] == []
    assert [way["way"] for way in error.fields["ways"]] == ["name", "upload", "fit"]
    for named in (of_telescope, "aia_171", "SDO AIA_3", "171 angstrom"):
        assert named in error.message
    assert "hri_euv" not in error.message
    assert [one["name"] for one in error.fields["instruments"]][:4] == [
        "aia_171",
        "aia_94",
        "aia_131",
        "aia_193",
    ]
    again = pickle.loads(pickle.dumps(error))
    assert (again.code, again.message, again.fields) == (error.code, error.message, error.fields)


def test_what_does_not_agree_is_told_too(local: InProcess, tmp_path: Path) -> None:
    upload(local, tmp_path / "aia.fits", 32, INSTRUME="AIA_3", CDELT1=0.6)
    error = refused_image(local, tmp_path, **{**AIA, "WAVELNTH": 1600, "CDELT1": 2.4, "CDELT2": 2.4})
    (of_file,) = (one["told"] for one in error.fields["instruments"] if one["name"] == "aia_171")
    for told in ("same telescope, but", "171, not 1600 Å", "another pixel scale", "not 2.4 arcsec"):
        assert told in of_file
    (of_psf,) = (psf["told"] for psf in error.fields["psfs"])
    assert of_psf == "same telescope, but another pixel scale (0.6, not 2.4 arcsec)"
