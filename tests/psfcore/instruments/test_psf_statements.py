"""What is said of a PSF, in one place: title, version, assumptions, scatter, and published PSFs."""

from __future__ import annotations

from pathlib import Path

from psfcore.build import build_psf
from psfcore.fits.blocks import LIMITS
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.instruments.files import instrument_names, telescope_of
from psfcore.instruments.model import load_instrument, parse_instrument
from psfcore.instruments.psf_statements import (
    assumptions,
    caveats,
    curves_once,
    mesh_is_assumed,
    offer,
    published_text,
    published_with_scatter,
    remarks,
    scatter_left,
    title,
    version_text,
)
from psfcore.instruments.published import PUBLISHED, published_for
from psfcore.instruments.unknown import TELESCOPES
from tests.conftest import SMALL_INSTRUMENT


def test_every_shipped_draft_says_what_it_assumes_and_what_scatter_it_leaves() -> None:
    for name in instrument_names():
        instrument = load_instrument(name)
        left = scatter_left(name, name, {})
        assert bool(assumptions(name, name, {})) == (instrument.status == "draft")
        assert (left is None) == (instrument.scatter is not None)
        assert left is None or ("10 to 35 %" in left) == (telescope_of(name) == "SDO/AIA"), name
        assert mesh_is_assumed(name, name, {}) == any(mesh.basis == "assumed" for mesh in instrument.meshes)


def test_other_psfs_say_what_their_provenance_does() -> None:
    assumed = {"mount_basis": "assumed", "mesh_basis": "assumed", "scatter_basis": "inferred"}
    assert [len(caveats("mine", "mine", one)) for one in ({}, {"mount_basis": "none"}, assumed)] == [0, 1, 3]
    left = scatter_left("mine", "mine", {"mount_basis": "drawing"})
    assert left is not None and "%" not in left, "the share of another telescope is not known"
    for name, provenance in (
        ("aia_171_2025", {}),
        ("mine", {"mount_basis": "none", "scatter_basis": "fitted"}),
    ):
        assert scatter_left(name, "aia_171", provenance) is None, name
    assert scatter_left("hri_euv", "hri_euv", {"component": "DIFFRACTION"}) is not None
    changed = {
        "mount_basis": "drawing",
        "mesh_basis": "assumed",
    }  # a copy of the shipped file, under its name
    assert assumptions("hri_euv", "hri_euv", changed) == ["mesh of the filter assumed"]
    assert mesh_is_assumed("hri_euv", "hri_euv", changed)
    assert len(remarks("mine", None, {}, "draft")) == 1 and remarks("mine", None, {}, "certified") == []


def test_a_psf_that_was_read_from_a_file_says_what_it_said_when_it_was_built(tmp_path: Path) -> None:
    instrument = parse_instrument(SMALL_INSTRUMENT, "small")
    for component in (None, "AIRY"):
        built = build_psf(instrument, size=64, component=component)
        file = tmp_path / f"{component}.fits"
        write_psf(file, built)
        read = read_psf(file, LIMITS)
        said = [caveats(psf.name, psf.instrument, psf.provenance) for psf in (built, read)]
        assert said[0] == said[1] and len(said[0]) == (1 if component is None else 2), component
        assert component is None or component in said[0][0]


def test_a_published_psf_with_the_scatter_that_stays_is_offered() -> None:
    assert published_with_scatter("aia_171", "aia_171", {}) == ["aia_171_2025"]
    left, lacks = (caveats("aia_171", "aia_171", {}, convolved=one)[-1] for one in (False, True))
    assert "stays" in left and "missing" in lacks and "10 to 35 %" in lacks
    assert "`heliopsf psf get aia_171_2025`" in offer(["aia_171_2025"])
    for name in ("hri_euv", "trace_171", "mine"):
        assert published_with_scatter(name, name, {}) == [], name
    assert published_with_scatter("aia_171_2025", "aia_171", {}) == [], "it contains the scatter"


def test_title_and_version() -> None:
    assert title("aia_171", "1.0.0", "certified") == "PSF aia_171 1.0.0 (certified)"
    assert title("aia_171", "", None) == "PSF aia_171"
    assert version_text("0.2.0", "draft", "0003662b" + "0" * 56) == "0.2.0-draft+0003662b"
    assert version_text("1.0.0", "released") == "1.0.0"


def test_the_published_psfs_of_a_telescope_are_named_for_its_channel() -> None:
    text = published_text("Hinode/XRT", None)
    assert text is not None and "xrt_560ev_2017" in text and "xrt_1kev_2017" in text
    assert [one.name for one in published_for("SDO/AIA", 171.1)] == ["aia_171_2025"]
    assert published_text("SDO/AIA", 1600.0) is None and published_text("TRACE", 171.0) is None
    by_hand = [name for name in PUBLISHED for one in TELESCOPES if name in str(one.ways)]
    assert by_hand == [], "the table names them"


def test_curves_that_are_the_same_are_one_with_all_names() -> None:
    curves = {"TOTAL": [1.0, 0.5], "AIRY": [1.0, 0.2], "DIFFRACTION": [1.0, 0.5]}
    once = curves_once(curves, lambda one, other: one == other)
    assert once == {("AIRY",): [1.0, 0.2], ("TOTAL", "DIFFRACTION"): [1.0, 0.5]}
