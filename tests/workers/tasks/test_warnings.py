"""What a deconvolution says about its inputs: saturation, the PSF's channel, the unit; and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.deconvolve.assess import pictures
from psfcore.deconvolve.assess.changes import QualityBit
from psfcore.drawing import plots
from psfcore.errors import DataError
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.in_process import InProcess

AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171}
FEW = {"steps": 2}


def psf_of(local: InProcess, path: Path, **cards: object) -> str:
    write_psf(path)
    fits.writeto(path, fits.getdata(path), fits.Header(cards), overwrite=True)
    return str(local.upload_psf(path)["id"])


def codes(product: dict[str, Any]) -> list[str]:
    return [warning["code"] for warning in product["details"]["warnings"]]


def clipped(path: Path, level: float, **cards: object) -> None:
    write_image(path, **cards)
    pixels, header = fits.getdata(path), fits.getheader(path)
    fits.writeto(path, np.minimum(pixels, level).astype("f4"), header, overwrite=True)


def test_saturation_seen_in_the_pixels_is_in_quality_header_and_details(
    local: InProcess, psf_file: Path, tmp_path: Path
) -> None:
    clipped(tmp_path / "i.fits", 120.0)
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


def test_an_unsure_saturation_is_a_warning_in_header_and_details(
    local: InProcess, psf_file: Path, tmp_path: Path
) -> None:
    write_image(tmp_path / "i.fits", **AIA, NSATPIX=7)
    product = local.deconvolve(
        tmp_path / "i.fits", tmp_path / "o.fits", psf_id=local.upload_psf(psf_file)["id"], **FEW
    )
    assert "saturation" in codes(product)
    history = "".join(str(line) for line in fits.getheader(tmp_path / "o.fits")["HISTORY"])
    assert "WARNING (saturation): NSATPIX counts 7 saturated pixels" in history


def test_a_psf_of_another_channel_is_refused_unless_told(local: InProcess, tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits", **{**AIA, "WAVELNTH": 193})
    psf_id = psf_of(local, tmp_path / "p.fits", **AIA)
    with pytest.raises(DataError) as caught:
        local.deconvolve(tmp_path / "i.fits", psf_id=psf_id, **FEW)
    assert caught.value.code == "channel-mismatch"
    product = local.deconvolve(
        tmp_path / "i.fits", tmp_path / "o.fits", psf_id=psf_id, other_channel=True, **FEW
    )
    assert codes(product) == ["channel"]
    history = "".join(str(line) for line in fits.getheader(tmp_path / "o.fits")["HISTORY"])
    assert "WARNING (channel)" in history and "193 angstrom" in history


def test_a_psf_that_does_not_say_its_channel_is_taken_with_a_warning_and_one_of_its_channel_without(
    local: InProcess, psf_file: Path, tmp_path: Path
) -> None:
    write_image(tmp_path / "i.fits", **AIA)
    product = local.deconvolve(tmp_path / "i.fits", psf_id=local.upload_psf(psf_file)["id"], **FEW)
    assert codes(product) == ["channel"]
    (tmp_path / "small.toml").write_text(SMALL_INSTRUMENT)
    psf_id = local.build_psf(tmp_path / "small.toml", size=64)["id"]
    write_image(tmp_path / "same.fits", WAVELNTH=171, CDELT1=2.0, CDELT2=2.0)
    assert codes(local.deconvolve(tmp_path / "same.fits", psf_id=psf_id, **FEW)) == []


def test_pictures_name_the_unit_of_the_image(
    local: InProcess, psf_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    units: list[str] = []
    for module, name in ((plots, "preview_png"), (pictures, "changes_png")):
        real = getattr(module, name)

        def noted(*arguments: Any, real: Any = real, **named: Any) -> None:
            units.append(named["unit"])
            real(*arguments, **named)

        monkeypatch.setattr(module, name, noted)
    psf_id = local.upload_psf(psf_file)["id"]
    for number, (unit, label) in enumerate((("DN", "DN in 2 s"), ("DN/s", "DN/s"), (None, "unit unknown"))):
        path = tmp_path / f"{number}.fits"
        write_image(path)
        pixels, header = fits.getdata(path), fits.getheader(path)
        header.remove("BUNIT") if unit is None else header.set("BUNIT", unit)
        fits.writeto(path, pixels, header, overwrite=True)
        local.deconvolve(path, psf_id=psf_id, changes=tmp_path / f"{number}.png", **FEW)
        assert units == [label, label]
        units.clear()
