"""The values of an instrument file: what is accepted, what is converted, and what the error says."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import pytest
from pydantic import ValidationError

from psfcore.errors import DataError
from psfcore.instruments.model import Aperture, Instrument, Mesh, parse_instrument
from tests.conftest import SMALL_INSTRUMENT

MESH = '[[meshes]]\nname = "m"\nplace = "entrance"\npitch_um = 40\nwire_um = 4\nwindows = 3\n'
MOUNT = '[mount]\nbasis = "drawing"\n'
MODE = '[detector.gain_modes.HIGH]\nbasis = "measured"\n'
MASK = 'mask_image = {file = "a.png\\n", width_mm = 1}\n'


def read(*changes: tuple[str, str]) -> Instrument:
    """The small instrument with texts of its file replaced; an empty old text adds the new text at the end."""
    text = SMALL_INSTRUMENT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1) if old else text + new
    return parse_instrument(text, "mine")


def test_values_are_converted_to_their_types() -> None:
    instrument = read(
        ("171.0", "171"),
        ("pixels = 512", "pixels = 512.0"),
        ("", MESH + MODE + '[match]\nDETECTOR = "D"\nCDELT1 = 2\n'),
    )
    assert type(instrument.wavelength_angstrom) is float and type(instrument.detector.pixels) is int
    assert instrument.meshes == (
        Mesh(name="m", place="entrance", pitch_um=40.0, wire_um=4.0, windows=3, angle_deg=0.0, share=1.0),
    )
    assert instrument.match == {"DETECTOR": "D", "CDELT1": 2.0} and type(instrument.match["CDELT1"]) is float
    assert list(instrument.detector.gain_modes) == ["HIGH"]
    assert read().match == {} and read().mount is None and read().detector.gain_modes == {}
    assert parse_instrument("\ufeff" + SMALL_INSTRUMENT.replace("\n", "\r\n"), "of Windows") == read()


FAULTS = [
    (("1.0.0", "1.0.0\\n"), "version: expected a text of the form"),
    (('"small"', "3"), "name: expected a text; got 3"),
    (("", MESH.replace('"m"', f'"{"m" * 81}"')), "meshes.0.name: expected at most 80 characters"),
    (("pixels = 512", "pixels = 0"), "detector.pixels: expected a number of at least 1; got 0"),
    (
        ("pixels = 512", "pixels = 100001"),
        "detector.pixels: expected a number of at most 100000; got 100001",
    ),
    (("pixels = 512", "pixels = true"), "detector.pixels: expected a whole number; got True"),
    (("pixels = 512", "pixels = 1.5"), "detector.pixels: expected a whole number; got 1.5"),
    (("draft", "flat"), "status: expected one of 'draft' or 'released'; got 'flat'"),
    (("4.0", '"4.0"'), "aperture.diameter_mm: expected a finite number; got '4.0'"),
    (("4.0", "1e300"), "aperture.diameter_mm: expected a number of at most 1000000000; got 1e+300"),
    (("4.0", f"1{'0' * 400}"), "aperture.diameter_mm: expected a "),
    (("diameter_mm = 4.0", ""), "aperture.diameter_mm: expected this key; got none"),
    (("[aperture]\ndiameter_mm = 4.0", "aperture = 4.0"), "aperture: expected a table; got 4.0"),
    (("[aperture]", "meshes = 1\n[aperture]"), "meshes: expected a list; got 1"),
    (("", MESH * 17), "meshes: expected at most 16 entries"),
    (
        ("", MESH.replace("wire_um = 4\n", "wire_um = 40\n")),
        "meshes.0: expected wire_um less than pitch_um (40.0); got 40.0",
    ),
    (
        ("", MESH + "share = 0"),
        "meshes.0.share: expected a number above 0; got 0",
    ),
    (
        ("", MOUNT + "polygons = [{corners_mm = [[0, 1], [1], [1, 1], [2, 2]]}]"),
        "mount.polygons.0.corners_mm.1.1: expected this entry; got none",
    ),
    (("", MOUNT + MASK.replace("a.png\\n", "../secret.png")), "mount.mask_image.file: expected a text of the form"),
    (("", '[scatter]\nb_px = 6.0\ntotal = 0.5\nbasis = "fitted"\n'), "scatter: expected one shape: b_px and c, or "
                                                                     "laws, or table; got b_px"),
    (("", '[scatter]\ntotal = 0.5\nbasis = "fitted"\n'), "scatter: expected one shape: b_px and c, or laws, or table; "
                                                         "got none of them"),
    (("", '[scatter]\ntable = [[2, 1], [1, 1]]\ntotal = 0.5\nbasis = "fitted"\n'), "scatter: table: expected at least "
                                                                                   "two rows [radius_px, weight]"),
    (("4.0", "4.0\nsector = { first_angle_deg = 0, opening_deg = 360 }"), "aperture.sector.opening_deg: expected a "
                                                                          "number of at most 359; got 360"),
    (("4.0", "4.0\ncorners_mm = [[0, 0], [1, 0], [1, 2]]"), "aperture: expected corners_mm within 2.0 mm of the axis; "
                                                            "got a corner at 2.23607 mm"),
    (("4.0", "4.0\ncorners_mm = [[0, 0], [1, 1]]"), "aperture: expected corners_mm that enclose an area"),
    (("4.0", "4.0\nobscuration_diameter_mm = 1.0\ncorners_mm = [[0, 0], [1, 0], [0, 1]]"), "aperture: expected "
                                                                                           "corners_mm alone"),
    (("", MESH + 'openings = "round"'), "meshes.0.openings: expected one of 'square' or 'hexagonal'; got 'round'"),
    (("4.0", "4.0\nobscuration_diameter_mm = 5.0"), "aperture: expected obscuration_diameter_mm less than diameter_mm"),
    (("", "[match]\nDETECTOR = 174"), "match.DETECTOR: expected a text; got 174"),
    (("1.0.0\"", "1.0.0"), "expected TOML; "),
    (
        ("", MODE + "depth = 1"),
        "detector.gain_modes.HIGH.depth: expected one of the keys saturation_dn, photon_gain_dn, read_noise_dn, basis",
    ),
    (("", '[match]\nCOLOUR = "red"'), "match.COLOUR: expected one of the keys TELESCOP, "),
    (("", "[match]\nWAVELNTH = 0"), "match.WAVELNTH: expected a number of at least"),
    (
        ("[aperture]", f"turn_deg = 3\n{MOUNT}{MASK}[aperture]".replace("a.png\\n", "a.png")),
        "turn_deg: expected 0, because a mask image is not turned; got 3.0",
    ),
]  # fmt: skip


def test_the_fault_names_the_key_what_was_expected_and_what_was_given() -> None:
    for change, expected in FAULTS:
        with pytest.raises(DataError) as caught:
            read(change)
        assert caught.value.code == "bad-instrument-file"
        assert caught.value.message.startswith(f"mine: {expected}"), (change, caught.value.message)
        assert "\n" not in caught.value.message and "more)" not in caught.value.message, change


def test_all_faults_are_told_and_a_misspelt_key_with_the_one_that_is_meant() -> None:
    misspelt = ("", MESH.replace("pitch_um", "pitch_mm"))
    with pytest.raises(DataError) as caught:
        read(("diameter_mm", "diametre_mm"), ("pixels = 512", "pixels = 0"), misspelt)
    told = [line.strip().split(": ")[0] for line in caught.value.message.splitlines()[1:]]
    assert told == ["aperture.diametre_mm", "meshes.0.pitch_mm", "detector.pixels"], "and none as missing"
    assert "'diameter_mm'" in caught.value.message and "'pitch_um'" in caught.value.message
    many = "".join(f"[[meshes]]\nzzz = {number}\n" for number in range(12))
    with pytest.raises(DataError, match=r"and \d+ more$"):
        read(("", many))


def test_instruments_do_not_change_and_a_changed_copy_is_checked() -> None:
    aperture = Aperture(diameter_mm=4.0)
    with pytest.raises(FrozenInstanceError):
        aperture.diameter_mm = 3.0  # type: ignore[misc]
    assert replace(aperture, obscuration_diameter_mm=1.5).obscuration_diameter_mm == 1.5
    with pytest.raises(ValidationError, match="less than diameter_mm"):
        replace(aperture, obscuration_diameter_mm=5.0)
