"""An image to be deconvolved is read with the saturation level of its gain mode."""

from __future__ import annotations

from pathlib import Path

import pytest

from psfcore.fits import observation
from psfcore.fits.header import FitsLimits
from psfcore.instruments.model import parse_instrument
from tests.conftest import SMALL_INSTRUMENT, write_image

MODES = '[detector.gain_modes.combined]\nsaturation_dn = 400.0\nbasis = "assumed"\n'


@pytest.mark.parametrize(
    ("cards", "saturation_dn", "level", "found"),
    [
        ({"DETECTOR": "HRI_EUV", "GAINCOMB": "combined"}, None, 200.0, "instrument file"),
        ({"DETECTOR": "HRI_EUV", "GAINCOMB": "low-only"}, None, None, None),
        ({"DETECTOR": "HRI_EUV"}, None, None, None),
        ({"DETECTOR": "FSI", "GAINCOMB": "combined"}, None, None, None),
        ({"DETECTOR": "HRI_EUV", "GAINCOMB": "combined"}, 500.0, 250.0, "request"),
    ],
)
def test_the_level_is_that_of_the_gain_mode_in_the_header(
    tmp_path: Path,
    limits: FitsLimits,
    monkeypatch: pytest.MonkeyPatch,
    cards: dict[str, str],
    saturation_dn: float | None,
    level: float | None,
    found: str | None,
) -> None:
    """The image is in DN/s, from an exposure of 2 s."""
    monkeypatch.setattr(
        observation, "load_instrument", lambda name: parse_instrument(SMALL_INSTRUMENT + MODES, name)
    )
    write_image(tmp_path / "i.fits", **cards)
    image = observation.read_observation(tmp_path / "i.fits", limits, saturation_dn=saturation_dn)
    assert image.saturation is not None
    assert (image.saturation.level, image.saturation.found) == (level, found)
    assert image.valid.all() == (level is None)
