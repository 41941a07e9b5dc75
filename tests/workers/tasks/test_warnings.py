"""What a deconvolution says about its inputs: saturation, the channel of the PSF, and the unit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.deconvolve.assess import pictures
from psfcore.deconvolve.assess.changes import QualityBit
from psfcore.drawing import plots
from tests.conftest import write_image, write_psf
from tests.in_process import InProcess

AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171}
FEW = {"steps": 2}


def test_saturation_seen_in_the_pixels(local: InProcess, psf_file: Path, tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits")
    pixels, cards = fits.getdata(tmp_path / "i.fits"), fits.getheader(tmp_path / "i.fits")
    fits.writeto(tmp_path / "i.fits", np.minimum(pixels, 120.0).astype("f4"), cards, overwrite=True)
    product = local.deconvolve(
        tmp_path / "i.fits", tmp_path / "o.fits", psf_id=local.upload_psf(psf_file)["id"], **FEW
    )
    full = fits.getdata(tmp_path / "i.fits") == 120.0
    with fits.open(tmp_path / "o.fits") as hdus:
        header, quality = hdus[0].header, hdus["QUALITY"].data
    np.testing.assert_array_equal((quality & QualityBit.SATURATED) > 0, full)
    band = product["details"]["edge_band_px"]
    inner = quality[band:-band, band:-band] if band else quality
    assert np.count_nonzero(inner == 0) > 0.8 * inner.size, "a good pixel has quality 0"
    assert (header["DCNVSATL"], header["DCNVSATF"]) == (120.0, "pixels")
    assert product["details"]["saturation"] == {"level": 120.0, "unit": "DN/s", "found": "pixels"}
    assert product["details"]["masked_pixels"]["saturated"] == np.count_nonzero(full) > 10


def test_warnings_about_the_inputs_are_in_header_and_details(local: InProcess, tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits", **{**AIA, "WAVELNTH": 193}, NSATPIX=7)
    write_psf(tmp_path / "p.fits")
    fits.writeto(tmp_path / "p.fits", fits.getdata(tmp_path / "p.fits"), fits.Header(AIA), overwrite=True)
    psf_id = local.upload_psf(tmp_path / "p.fits")["id"]
    product = local.deconvolve(
        tmp_path / "i.fits", tmp_path / "o.fits", psf_id=psf_id, other_channel=True, **FEW
    )
    assert {warning["code"] for warning in product["details"]["warnings"]} == {"saturation", "channel"}
    history = "".join(str(line) for line in fits.getheader(tmp_path / "o.fits")["HISTORY"])
    assert "WARNING (saturation): NSATPIX counts 7 saturated pixels" in history
    assert "WARNING (channel)" in history and "193 angstrom" in history


def test_pictures_name_the_unit_of_the_image(
    local: InProcess, image_file: Path, psf_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    units: list[str] = []
    for module, name in ((plots, "preview_png"), (pictures, "changes_png")):
        real = getattr(module, name)

        def noted(*arguments: Any, real: Any = real, **named: Any) -> None:
            units.append(named["unit"])
            real(*arguments, **named)

        monkeypatch.setattr(module, name, noted)
    fits.setval(image_file, "BUNIT", value="DN")
    psf_id = local.upload_psf(psf_file)["id"]
    local.deconvolve(image_file, psf_id=psf_id, changes=tmp_path / "changes.png", **FEW)
    assert units == ["DN in 2 s"] * 2
