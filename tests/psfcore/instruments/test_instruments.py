"""Instrument files load, match headers, agree with publications, and are refused with the key that is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from psfcore.diffraction.mesh_series import order_spacing_px
from psfcore.errors import DataError
from psfcore.fits.header import known_instrument
from psfcore.instruments import files
from psfcore.instruments.files import (
    instrument_names,
    instrument_path,
    match_instrument,
    telescope_of,
    telescopes,
)
from psfcore.instruments.model import Instrument, Mesh, SpectralLine, load_instrument, parse_instrument
from tests.conftest import SMALL_INSTRUMENT


def test_every_shipped_instrument_loads_under_its_own_name() -> None:
    for name in instrument_names():
        instrument = load_instrument(name)
        assert instrument.name == name
    hri = load_instrument("hri_euv")
    assert hri.mount is not None and (hri.mount.basis, hri.status) == ("assumed", "draft")
    assert telescopes() == {
        "SDO/AIA": "94 to 335",
        "STEREO/EUVI": "171 to 304",
        "Solar Orbiter EUI/HRI_EUV": "174",
        "TRACE": "171 to 284",
    }
    assert telescope_of("aia_171") == "SDO/AIA"
    for name, words in (
        ("../../etc/passwd", "unknown-instrument: .*hri_euv"),
        ("no.toml", r"no-such-file: .*'no\.toml'"),
    ):
        with pytest.raises(DataError, match=words):
            load_instrument(name)
    instrument = replace(load_instrument("hri_euv"), distances=None)
    entrance, wheel = instrument.meshes
    assert instrument.mesh_distance_mm(entrance) == 4187.0
    with pytest.raises(DataError, match="distances: expected"):
        instrument.mesh_distance_mm(wheel)


def test_headers_are_matched() -> None:
    for cards, name in (
        ({"DETECTOR": "HRI_EUV"}, "hri_euv"),
        ({"DETECTOR": "hri_euv  "}, "hri_euv"),
        ({"DETECTOR": "FSI"}, None),
        ({"TELESCOP": "SDO/AIA", "WAVELNTH": 171.0}, "aia_171"),
        ({"TELESCOP": "SDO/AIA", "WAVELNTH": 303.8}, "aia_304"),
        ({"TELESCOP": "SDO/AIA", "WAVELNTH": 1600.0}, None),
        ({"TELESCOP": "SDO/AIA", "WAVELNTH": "171"}, None),
        ({"TELESCOP": "SDO/AIA"}, None),
        ({"TELESCOP": "TRACE", "WAVELNTH": 171.0}, "trace_171"),
        ({"TELESCOP": "TRACE", "WAVELNTH": 1600.0}, None),
        ({"OBSRVTRY": "STEREO_A", "DETECTOR": "EUVI", "WAVELNTH": 195.0}, "euvi_195_a"),
        ({"OBSRVTRY": "STEREO_B", "DETECTOR": "EUVI", "WAVELNTH": 195.0}, "euvi_195_b"),
        ({"DETECTOR": "EUVI", "WAVELNTH": 195.0}, None),
        ({"DETECTOR": 174}, None),
        ({}, None),
    ):
        assert match_instrument(cards) == name, cards


def test_filter_and_plate_scale_choose_among_variants_of_an_instrument(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A telescope with a file of its own for one filter, for binned images, and for both together."""
    text, cards = instrument_path("hri_euv").read_text("utf-8"), 'DETECTOR = "HRI_EUV"'
    binned, opened = "CDELT1 = 0.984", 'FILTER = "Open 2"'
    variants = {"": "", "_binned": binned, "_open": opened, "_ti": 'EC_FW2_ = "Ti_poly"'}
    for name, more in {**variants, "_both": f"{binned}\n{opened}"}.items():
        file = text.replace('name = "hri_euv"', f'name = "hri_euv{name}"').replace(cards, f"{cards}\n{more}")
        (tmp_path / f"hri_euv{name}.toml").write_text(file, "utf-8")
    monkeypatch.setattr(files, "_FOLDER", tmp_path)
    files.match_table.cache_clear()
    try:
        for seen, name in (
            ({}, "hri_euv"),
            ({"FILTER": "Open 1", "CDELT1": 0.492}, "hri_euv"),
            ({"FILTER": "open 2"}, "hri_euv_open"),
            ({"CDELT1": 0.99}, "hri_euv_binned"),
            ({"CDELT1": -0.984 / 3600, "CUNIT1": "deg"}, "hri_euv_binned"),
            ({"CDELT1": 1.0}, "hri_euv"),
            ({"FILTER": "Open 2", "CDELT1": 0.984}, "hri_euv_both"),
            ({"FILTER": "Open 2", "DETECTOR": "FSI"}, None),
            ({"EC_FW1_": "Open", "EC_FW2_": "Ti_poly"}, "hri_euv_ti"),
            ({"EC_FW1_": "Ti_poly", "EC_FW2_": "Open"}, "hri_euv"),
        ):
            assert known_instrument({"DETECTOR": "HRI_EUV", **seen}) == name, seen
        assert load_instrument("hri_euv_both").match["FILTER"] == "Open 2"
    finally:
        files.match_table.cache_clear()


def test_spectral_lines_are_the_normalised_bandpass_or_the_one_wavelength() -> None:
    instrument = load_instrument("hri_euv")
    assert [(line.wavelength_angstrom, line.weight) for line in instrument.spectral_lines] == [(174.0, 1.0)]
    lines = tuple(SpectralLine(wavelength_angstrom=171.0, weight=weight) for weight in (3.0, 1.0))
    assert [line.weight for line in replace(instrument, bandpass=lines).spectral_lines] == [0.75, 0.25]
    weak = "".join(f"[[bandpass]]\nwavelength_angstrom = 171.0\nweight = {w}\n" for w in ("1e6", "0.01"))
    kept = parse_instrument(SMALL_INSTRUMENT + weak, "mine.toml")
    assert kept.spectral_lines[1].weight == pytest.approx(1e-8)
    with pytest.raises(DataError, match=r"bandpass\.1\.weight: expected at least 1e-09 of the sum"):
        parse_instrument(SMALL_INSTRUMENT + weak.replace("1e6", "1e8"), "mine.toml")


# Table 2 of Grigis et al., AIA PSF characterization and deconvolution, as aiapy's filter_mesh_parameters gives it.
# Channel: angles of the four arms (degrees), spacing of the entrance mesh and of the focal-plane mesh (px).
MEASURED = {
    94: ((49.81, 40.16, -40.28, -49.92), 8.99, 0.207),
    131: ((50.27, 40.17, -39.70, -49.95), 12.37, 0.289),
    171: ((49.81, 39.57, -40.13, -50.38), 16.26, 0.377),
    193: ((49.82, 39.57, -40.12, -50.37), 18.39, 0.425),
    211: ((49.78, 40.08, -40.34, -49.95), 19.97, 0.465),
    304: ((49.76, 40.18, -40.14, -49.90), 28.87, 0.670),
    335: ((50.40, 39.80, -39.64, -50.25), 31.83, 0.738),
}


def spacing_px(instrument: Instrument, mesh: Mesh) -> float:
    return order_spacing_px(
        wavelength_angstrom=instrument.wavelength_angstrom,
        distance_mm=instrument.mesh_distance_mm(mesh),
        pitch_um=mesh.pitch_um,
        pixel_pitch_um=instrument.detector.pixel_pitch_um,
    )


def test_the_meshes_have_the_measured_arms_and_orders() -> None:
    """A square mesh has two arms, 90 degrees apart. The measured spacing gives a pitch within 1 % of the nominal
    one."""
    for channel, (arms_deg, entrance_px, focal_px) in MEASURED.items():
        aia = load_instrument(f"aia_{channel}")
        *entrance, focal = aia.meshes
        assert all(mesh.place == "entrance" for mesh in entrance), channel
        arms = sorted(angle for mesh in entrance for angle in (mesh.angle_deg, mesh.angle_deg - 90))
        assert arms == pytest.approx(sorted(arms_deg), abs=0.065), channel
        assert sum(mesh.share for mesh in entrance) == 1, channel
        assert [spacing_px(aia, mesh) for mesh in entrance] == pytest.approx([entrance_px] * 2, abs=0.005)
        assert spacing_px(aia, focal) == pytest.approx(focal_px, abs=0.001), channel
        assert (focal.place, focal.angle_deg) == ("filter_wheel", 45.0), channel
        for mesh in aia.meshes:
            assert mesh.pitch_um == pytest.approx(25_400 / 70, rel=0.01) and mesh.wire_um == 34.0, channel


def test_the_arms_of_trace_and_euvi_have_the_published_spacing_direction_and_light() -> None:
    """TRACE: orders of 70 lines an inch at 19.4 px, arms at +-45 degrees, about 20 % of the light (Lin et al. 2001).
    EUVI: the fine mesh of 0.36 mm with 82 % open, and the coarse grid of 5 mm with 98 % open."""
    published = {
        "trace_171": (19.4, 45.0, 20.0),
        "euvi_284": (10.1, 45.0, 18.0),
        "euvi_304": (10.9, 45.0, 18.0),
    }
    published |= {"euvi_171": (0.44, 0.0, 2.0), "euvi_195": (0.51, 0.0, 2.0)}
    for file in (name for name in instrument_names() if name.startswith(("trace_171", "euvi"))):
        instrument = load_instrument(file)
        (mesh,) = instrument.meshes
        spacing, angle, light_pct = published[file.removesuffix("_a").removesuffix("_b")]
        assert spacing_px(instrument, mesh) == pytest.approx(spacing, rel=0.03), file
        assert mesh.angle_deg == angle, file
        assert 100 * (1 - (1 - mesh.wire_um / mesh.pitch_um) ** 2) == pytest.approx(light_pct, abs=2), file
        assert mesh.basis == "assumed" and instrument.status == "draft", file
        scale = instrument.detector.pixel_pitch_um * 1e-3 / instrument.focal_length_mm * 206264.8
        assert scale == pytest.approx(instrument.detector.plate_scale_arcsec, rel=1e-4), file
