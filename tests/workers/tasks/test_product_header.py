"""The header of a product's file is its own, and equal requests give equal bytes."""

from __future__ import annotations

import warnings
from pathlib import Path

from astropy.io import fits

from tests.conftest import write_image
from tests.in_process import InProcess
from workers.settings import Settings, software_version

OF_INPUT = {
    "FILENAME": "solo_L2_eui-hrieuv174-image_20220401T103005920_V01.fits",
    "DATE": "2022-04-19T17:47:09.475",
    "PARENT": "solo_L1_eui-hrieuv174-image_20220401T103005920_V01.fits",
    "CREATOR": "euiprep.py",
    "ORIGIN": "Royal Observatory of Belgium",
    "LEVEL": "L2",
    "VERSION": "01",
    "DATE-BEG": "2022-04-01T10:30:05.920",
}


def test_a_product_does_not_pass_for_its_input_and_equal_requests_give_equal_bytes(
    local: InProcess, psf_file: Path, tmp_path: Path
) -> None:
    write_image(tmp_path / "image.fits", **OF_INPUT)
    (tmp_path / "other name.fits").write_bytes((tmp_path / "image.fits").read_bytes())
    second = InProcess(Settings.apart(tmp_path / "second"))
    for name, service in (("image", local), ("other name", second)):
        psf_id = service.upload_psf(psf_file)["id"]
        output = tmp_path / f"{name}.out.fits"
        product = service.deconvolve(tmp_path / f"{name}.fits", output, psf_id=psf_id, steps=1)
    second.close()
    assert (tmp_path / "image.out.fits").read_bytes() == (tmp_path / "other name.out.fits").read_bytes()
    with warnings.catch_warnings(), fits.open(tmp_path / "image.out.fits", checksum=True) as hdus:
        warnings.simplefilter("error")
        for hdu in hdus:
            assert hdu.verify_checksum() == hdu.verify_datasum() == 1, hdu.name
        header = hdus[0].header
    assert header["FILENAME"] == product["details"]["filename"]
    assert header["FILENAME"] == f"{OF_INPUT['FILENAME'][:-5]}-{product['id'][:16]}.fits"
    assert header["PARENT"] == OF_INPUT["FILENAME"] and header["LEVEL"] == "L3"
    assert header["CREATOR"] == f"heliopsf {software_version()}"
    assert not {"DATE", "ORIGIN", "VERSION"} & set(header)
    assert header["DATE-BEG"] == OF_INPUT["DATE-BEG"]
    history = list(header["HISTORY"])
    assert product["image_id"] in history and f"input DATE: {OF_INPUT['DATE']}" in history
