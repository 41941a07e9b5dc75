"""PSF files: a written PSF is read back unchanged, and files of other programs are read."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from itertools import cycle, product
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import read_summary
from psfcore.fits.psfs import read_psf, stated_id, write_psf
from psfcore.fits.stored_psf import check_is_psf, write_cutout
from psfcore.instruments.files import instrument_path
from psfcore.psf import REACH_GRID_PX, Psf
from psfcore.scatter.power_law import scatter_kernel
from tests.conftest import write_image
from tests.conftest import write_psf as write_example
from tests.fuzz.fits_inputs import plain_image
from tests.psfcore.conftest import LIMITS, delta, gaussian, make_psf

Find = Callable[[str], Path]


def save(path: Path, data: NDArray[np.generic]) -> Path:
    fits.PrimaryHDU(data).writeto(path)
    return path


def full_psf() -> Psf:
    return make_psf(
        0.9 * gaussian(64, 2.0),
        name="mine",
        version="3",
        status="draft",
        instrument="hri_euv",
        plate_scale_arcsec=0.492,
        wavelength_angstrom=174.0,
        components={"DIFFRACTION": gaussian(64, 1.0), "SCATTER": delta(64)},
        provenance={"why": "test"},
    )


def test_a_psf_is_read_back_complete(tmp_path: Path) -> None:
    toml = instrument_path("hri_euv").read_bytes()
    psf = full_psf()
    for name in ("a.fits", "b.fits"):
        write_psf(tmp_path / name, psf, instrument_file=toml)
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()
    back = read_psf(tmp_path / "a.fits", LIMITS)
    wide = make_psf(scatter_kernel(6.15, 2.53, 0.411, 2048))
    write_psf(tmp_path / "wide.fits", wide)
    single = read_psf(tmp_path / "wide.fits", LIMITS)
    assert single.total == pytest.approx(wide.total, abs=1e-7), "single precision keeps the sum"
    assert (back.name, back.version, back.status, back.instrument) == ("mine", "3", "draft", "hri_euv")
    assert (back.plate_scale_arcsec, back.wavelength_angstrom) == (0.492, 174.0)
    np.testing.assert_array_equal(back.kernel, psf.kernel.astype(np.float32))
    assert list(back.components) == ["DIFFRACTION", "SCATTER"]
    assert back.provenance["instrument_toml"].encode() == toml
    assert "why: test" in back.provenance["history"]
    assert read_summary(tmp_path / "a.fits", LIMITS).shape == (64, 64)
    with fits.open(tmp_path / "a.fits", checksum=True) as hdus:
        assert all(hdu.verify_checksum() == 1 for hdu in hdus)
        assert hdus["PROFILE"].data["cumulative_pct"][-1] == pytest.approx(10.0, abs=1e-3)
        assert hdus["PROFILE"].data["encircled"][-1] == pytest.approx(0.9)
        assert hdus["PROFILE"].data["scatter_encircled"][0] == pytest.approx(1.0)
        weight = hdus["PROFILE"].data["diffraction_mean_weight"]
        assert weight[0] == pytest.approx(gaussian(64, 1.0)[32, 32])
        assert hdus[0].header["PSFSUM"] == pytest.approx(0.9)
        # The first pixel has the number 1, so the centre [32, 32] has the number 33.
        assert (hdus[0].header["CRPIX1"], hdus[0].header["CRPIX2"]) == (33.0, 33.0)


def test_a_psf_of_another_program_is_named_after_its_file(tmp_path: Path) -> None:
    for shape in ((31, 31), (32, 32), (33, 48)):
        kernel = np.full(shape, 1e-6)
        kernel[shape[0] // 2, shape[1] // 2] = 0.9
        (tmp_path / f"{shape}").mkdir()
        psf = read_psf(save(tmp_path / f"{shape}" / "other_psf.v2.fits", kernel), LIMITS)
        assert (psf.name, psf.status) == ("other_psf", "user")
        assert (psf.instrument, psf.plate_scale_arcsec) == (None, None)


def test_a_damaged_size_does_not_let_astropy_read_without_an_end(tmp_path: Path) -> None:
    """The declared data of this PSF end before the next header, and the bytes there are no header."""
    (tmp_path / "damaged.fits").write_bytes(plain_image(17066))
    with pytest.raises(DataError, match="psf-sum"):
        read_psf(tmp_path / "damaged.fits", LIMITS)
    assert stated_id(tmp_path / "damaged.fits", LIMITS) is None


def test_a_real_psf_of_another_program(real: Find) -> None:
    psf = read_psf(real("psf/derived_aia171_psf_aiapy0.10.2.fits"), LIMITS)
    assert psf.kernel.shape == (4096, 4096)
    assert psf.total == pytest.approx(1, abs=1e-6)
    assert psf.wavelength_angstrom == 171


# --- cut-outs: the pixels of the centre, whatever the file stores ---


def test_the_pixels_are_those_of_the_centre(tmp_path: Path) -> None:
    for (ny, nx), kind, size in product(
        [(64, 64), (63, 65), (7, 5)], ["f4", "f8", "i2", "tiles", "gz"], [1, 5]
    ):
        path = tmp_path / ("psf.fits.gz" if kind == "gz" else "psf.fits")
        weights = (
            np.random.default_rng(1).integers(1, 99, (ny, nx)).astype(kind if kind in ("f4", "f8") else "i2")
        )
        packed = fits.CompImageHDU(weights) if kind == "tiles" else fits.PrimaryHDU(weights)
        fits.HDUList([fits.PrimaryHDU(), packed] if kind == "tiles" else [packed]).writeto(
            path, overwrite=True
        )
        with (tmp_path / "part.fits").open("w+b") as target:
            write_cutout(path, size, LIMITS, target)
        top, left = ny // 2 - size // 2, nx // 2 - size // 2
        expected = weights[top : top + size, left : left + size]
        with fits.open(tmp_path / "part.fits") as hdus:
            hdus.verify("exception")
            np.testing.assert_array_equal(hdus[0].data, expected)
            assert hdus[0].data.dtype == (">f8" if kind == "f8" else ">f4")
            assert hdus[0].header["PSFSUM"] == pytest.approx(float(expected.astype("f8").sum()), rel=1e-12)
        with pytest.raises(DataError, match="cutout-too-large"):
            write_cutout(path, min(ny, nx) + 1, LIMITS, target)


# --- files that are plainly no PSF are known before any job ---


def code_of(read: Callable[[], object]) -> str | None:
    """The code with which a file is refused; None if it is read."""
    try:
        read()
    except DataError as error:
        return error.code
    return None


def verdict(path: Path) -> str | None:
    """The code with which the check refuses a file; None if the file can be a PSF."""
    return code_of(lambda: check_is_psf(path, read_summary(path, LIMITS), LIMITS))


def kernel(ny: int = 33, nx: int = 40, **first: float) -> NDArray[np.float64]:
    """A Gaussian of sum 1; ``first`` may give another value of its first pixel."""
    y, x = np.indices((ny, nx))
    weights = np.exp(-((y - ny // 2) ** 2 + (x - nx // 2) ** 2) / 8.0)
    weights /= weights.sum()
    weights[0, 0] = first.get("value", weights[0, 0])
    return weights


WEIGHTS = [
    (kernel(), None),
    (3 * kernel(), "psf-sum"),
    (0.01 * kernel(), "psf-sum"),
    (np.roll(kernel(), 1, axis=1), "psf-not-centred"),
    (kernel(value=np.nan), "psf-nonfinite"),
    (kernel(value=-0.01), "psf-negative"),
]


def test_weights_are_judged_as_the_jobs_judge_them(tmp_path: Path) -> None:
    places = [(">f4", "first"), (">f8", "second"), (">f4", "gzip"), (">f8", "first")]
    for number, ((weights, code), (stored, place)) in enumerate(zip(WEIGHTS, cycle(places), strict=False)):
        data = weights.astype(stored)
        hdus = [fits.PrimaryHDU(data)] if place != "second" else [fits.PrimaryHDU(), fits.ImageHDU(data)]
        path = tmp_path / f"{number}.fits"
        fits.HDUList(hdus).writeto(path)
        if place == "gzip":
            path.write_bytes(gzip.compress(path.read_bytes()))
        judged = verdict(path), code_of(lambda path=path: read_psf(path, LIMITS))
        assert judged == (code, code), (code, stored, place)


def test_the_sum_is_that_within_the_reach(tmp_path: Path) -> None:
    wide = np.zeros((3, REACH_GRID_PX + 20), "f4")
    wide[1, wide.shape[1] // 2] = 0.9
    wide[:, :10] = 0.5  # beyond the reach
    fits.PrimaryHDU(wide).writeto(tmp_path / "wide.fits")
    assert verdict(tmp_path / "wide.fits") is None
    wide[1, 10] = 0.5  # the first pixel of the reach
    fits.PrimaryHDU(wide).writeto(tmp_path / "more.fits")
    assert verdict(tmp_path / "more.fits") == "psf-sum"


def test_images_and_products_are_no_psfs(tmp_path: Path) -> None:
    write_example(tmp_path / "psf.fits")
    assert verdict(tmp_path / "psf.fits") is None
    write_image(tmp_path / "image.fits")
    assert verdict(tmp_path / "image.fits") == "psf-sum"
    integers = fits.PrimaryHDU(kernel(32, 32))
    integers.scale("int16", bscale=2**-20, bzero=10485 * 2**-20)
    integers.writeto(tmp_path / "integers.fits")
    assert verdict(tmp_path / "integers.fits") is None
    weights = fits.getdata(tmp_path / "psf.fits")
    fits.PrimaryHDU(weights, fits.Header({"PSFID": "a"})).writeto(tmp_path / "product.fits")
    assert verdict(tmp_path / "product.fits") == "image-as-psf"
    packed = fits.CompImageHDU(fits.getdata(tmp_path / "image.fits"))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "packed.fits")
    assert verdict(tmp_path / "packed.fits") == "psf-sum"
