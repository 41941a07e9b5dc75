"""A PSF that changes over the field: its checks, its file, and the place of an image on the detector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.deconvolve.conditions import PreparedPsfs, new_engine
from psfcore.deconvolve.edges import share_from_beyond
from psfcore.errors import DataError
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.fits.stored_psf import read_weights, write_cutout
from psfcore.psf import Psf, central_part, crop_centred, cumulative_curve, light_beyond_map
from psfcore.psf_field import FieldTerm, Place
from psfcore.psf_sampling import psf_for_image, rebinned, rebinned_kernel
from tests.psfcore.conftest import LIMITS, delta, gaussian, make_psf

Plane = NDArray[np.float64]


def wings(size: int = 33, share: float = 0.2) -> Plane:
    """Moves this share of the light from the core into a lopsided halo, of which an array of `size` holds a part."""
    halo = crop_centred(gaussian(33, 4.0), (size, size))
    halo[:, size // 2 + 1 :] *= 1.1
    return np.asarray(share * (halo - halo.sum() * delta(size)))


def changing(nx: int = 48, ny: int = 40, **attributes: object) -> Psf:
    terms = (FieldTerm(wings(), 1, 0), FieldTerm(wings(21, 0.1), 0, 1), FieldTerm(wings(29, 0.1), 2, 1))
    return make_psf(
        0.5 * gaussian(33, 4.0) + 0.5 * delta(33),
        field_terms=terms,
        place=Place.of_detector(nx, ny),
        **attributes,
    )


def code_of(call: Callable[[], object]) -> tuple[str, str]:
    with pytest.raises(DataError) as error:
        call()
    return error.value.code, error.value.message


def test_weights_sums_and_powers_are_checked_everywhere_on_the_detector() -> None:
    kernel, place = gaussian(33, 4.0) * 0.5 + 0.5 * delta(33), Place.of_detector(101, 51)
    lopsided = wings(33, 0.9)

    def refused(*terms: FieldTerm, where: Place | None = place) -> tuple[str, str]:
        return code_of(lambda: make_psf(kernel, field_terms=terms, place=where))

    code, message = refused(FieldTerm(lopsided, 1, 0), FieldTerm(0.1 * lopsided, 0, 1))
    assert code == "psf-negative" and "x, y = 100, 50 px" in message
    # Negative in the middle between centre and edge alone: u^2 - u^4 has its extreme at 0.71.
    code, message = refused(FieldTerm(3 * lopsided, 2, 0), FieldTerm(-3 * lopsided, 4, 0))
    assert code == "psf-negative" and ("x, y = 12," in message or "x, y = 88," in message)
    assert refused(FieldTerm(0.2 * delta(33), 0, 1))[0] == "psf-sum"
    assert refused(FieldTerm(wings(), 1, 0), where=None)[0] == "psf-field"
    make_psf(kernel, field_terms=[FieldTerm(wings(), 1, 0)], place=place)
    for powers in ((0, 0), (-1, 2), (3, 2)):
        assert code_of(lambda powers=powers: FieldTerm(wings(), *powers))[0] == "psf-field"
    assert code_of(lambda: FieldTerm(np.full((3, 3), np.nan), 1, 0))[0] == "psf-field"
    assert code_of(lambda: Place.of_detector(1, 4))[0] == "psf-field"


def test_the_kernel_at_a_place_and_the_map_of_its_light_are_the_sum_of_the_terms() -> None:
    psf = changing()
    first, second, third = (term.kernel for term in psf.field_terms)
    expected = psf.kernel + 0.5 * first
    expected[6:27, 6:27] -= 0.8 * second
    expected[2:31, 2:31] += 0.5**2 * -0.8 * third
    np.testing.assert_allclose(psf.at(0.5, -0.8), expected, atol=1e-15)
    beyond = light_beyond_map(psf, [2.0, 6.0])
    for row, column in product(range(3), range(3)):
        curve = cumulative_curve(psf.at(column - 1, row - 1), [2.0, 6.0])
        np.testing.assert_allclose(beyond[:, row, column], curve, atol=1e-10)
    shares = share_from_beyond(psf)
    assert shares[0] == pytest.approx(max(share_from_beyond(make_psf(psf.at(u, v)))[0]
                                          for u in (-1, 0, 1) for v in (-1, 0, 1)))  # fmt: skip


def test_a_file_keeps_the_terms_and_its_cutouts_and_binnings_too(tmp_path: Path) -> None:
    path, psf = tmp_path / "psf.fits", changing(name="changing", version="2")
    write_psf(path, psf)
    for parts in (True, False):
        back = read_psf(path, LIMITS, parts=parts)
        assert back.place == psf.place and back.components == {}
        assert [(term.x_power, term.y_power) for term in back.field_terms] == [(1, 0), (0, 1), (2, 1)]
        for term, again in zip(psf.field_terms, back.field_terms, strict=True):
            np.testing.assert_array_equal(term.kernel.astype("f4"), again.kernel)
    assert read_weights((tmp_path / "unused").open("w+b"), path=str(path), limits=vars(LIMITS)) == {}
    write_psf(tmp_path / "again.fits", back)
    with (tmp_path / "cut.fits").open("w+b") as target:
        write_cutout(path, 25, LIMITS, target)
    write_psf(tmp_path / "part.fits", central_part(psf, 25))
    cut, part = (read_psf(tmp_path / name, LIMITS) for name in ("cut.fits", "part.fits"))
    np.testing.assert_allclose(cut.at(1, -1), part.at(1, -1), atol=1e-7)
    write_psf(tmp_path / "binned.fits", rebinned(psf, 2))
    binned = read_psf(tmp_path / "binned.fits", LIMITS)
    assert binned.place is not None and binned.place.detector == (24, 20)
    # The first binned pixel is the mean of pixels 0 and 1.
    np.testing.assert_allclose(
        binned.at(-1, 1), rebinned_kernel(psf.at(-1 + 1 / 47, 1 - 1 / 39), 2), atol=1e-7
    )


def test_files_whose_terms_cannot_be_used_are_refused(tmp_path: Path) -> None:
    write_psf(tmp_path / "good.fits", changing())

    def refused(change: Callable[[fits.HDUList], object]) -> str:
        with fits.open(tmp_path / "good.fits") as hdus:
            change(hdus)
            hdus.writeto(tmp_path / "bad.fits", overwrite=True)
        return code_of(lambda: read_psf(tmp_path / "bad.fits", LIMITS, parts=False))[0]

    assert refused(lambda hdus: hdus.pop(1)) == "psf-field"
    assert refused(lambda hdus: hdus[1].header.update(XPOWER=0, YPOWER=1)) == "psf-field"
    assert refused(lambda hdus: hdus[1].header.update(XPOWER=5)) == "psf-field"
    assert refused(lambda hdus: hdus[1].header.update(FIELDNX=50)) == "psf-field"
    assert refused(lambda hdus: hdus[1].header.remove("YPOWER")) == "bad-card"
    assert refused(lambda hdus: hdus[1].header.update(XPOWER="x")) == "bad-card"


# --- the place of an image on the detector ---


def test_turned_images_have_the_same_light_as_the_image_of_the_detector() -> None:
    scene = np.random.default_rng(3).random((40, 48))
    built = changing(instrument="hri_euv", plate_scale_arcsec=0.5)
    expected = new_engine(built, (40, 48), (40, 48), 1).apply(scene)
    for (a, b), (c, d) in [
        ((1, 0), (0, 1)), ((-1, 0), (0, -1)), ((0, 1), (-1, 0)), ((0, -1), (1, 0)), ((-1, 0), (0, 1)),
    ]:  # fmt: skip
        # The image at the offset p shows the pixel of the detector at the offset T p.
        turned = scene
        turned = turned.T if a == 0 else turned
        x_sign, y_sign = (a or c), (b or d)
        turned = turned[:: int(y_sign), :: int(x_sign)]
        header = fits.Header({"CDELT1": 0.5, "CDELT2": 0.5, "CUNIT1": "arcsec", "CUNIT2": "arcsec"})
        header.update({"PC1_1": a, "PC1_2": b, "PC2_1": c, "PC2_2": d, "TELESCOP": "SOLO", "CROTA": 0.0})
        header.update(NAXIS1=turned.shape[1], NAXIS2=turned.shape[0])
        fitted = psf_for_image(built, header)
        found = new_engine(fitted, turned.shape, turned.shape, 1).apply(turned)
        again = expected.T if a == 0 else expected
        np.testing.assert_allclose(
            found, again[:: int(y_sign), :: int(x_sign)], atol=2e-6, err_msg=f"{a, b, c, d}"
        )


def test_parts_of_the_detector_say_where_they_are_or_are_refused() -> None:
    psf = changing()
    whole = {"NAXIS1": 48, "NAXIS2": 40}
    read_out = {"PXBEG1": 11, "PXEND1": 30, "PXBEG2": 5, "PXEND2": 34}
    xrt = {"INSTRUME": "XRT", "P1COL": 10, "P2COL": 29, "P1ROW": 4, "P2ROW": 33}
    aia = {"TELESCOP": "SDO/AIA", "X0_MP": 20.0, "Y0_MP": 22.5, "CRPIX1": 11.0, "CRPIX2": 19.5}
    part = {"NAXIS1": 20, "NAXIS2": 30}
    assert psf_for_image(psf, fits.Header(whole)) is psf
    u, v = psf.place.coordinates((40, 48))  # type: ignore[union-attr]
    for cards in (read_out, xrt, aia):
        fitted = psf_for_image(psf, fits.Header({**part, **cards}))
        found = fitted.place.coordinates((30, 20))  # type: ignore[union-attr]
        np.testing.assert_allclose(found[0], u[10:30], atol=1e-12, err_msg=str(cards))
        np.testing.assert_allclose(found[1], v[4:34], atol=1e-12)
    for cards in (
        {},
        {"PXBEG1": 11, "PXBEG2": 5},
        {**read_out, "PXEND1": 31},
        {**read_out, "PXBEG1": 40, "PXEND1": 59},
        {**read_out, "PXBEG1": 1, "PXEND1": 48},
    ):
        code, message = code_of(lambda cards=cards: psf_for_image(psf, fits.Header({**part, **cards})))
        assert code == "psf-place" and "PXBEG1" in message, cards
    assert code_of(lambda: psf_for_image(psf, fits.Header()))[0] == "psf-place"
    turned = fits.Header({**whole, "CDELT1": 0.5, "CDELT2": 0.5, "CROTA2": 30.0})
    assert code_of(lambda: psf_for_image(changing(instrument="hri_euv"), turned))[0] == "psf-place"
    binned = psf_for_image(
        replace(psf, plate_scale_arcsec=0.5),
        fits.Header({"NAXIS1": 24, "NAXIS2": 20, "CDELT1": 1.0, "CDELT2": 1.0}),
    )
    found = binned.place.coordinates((20, 24))  # type: ignore[union-attr]
    np.testing.assert_allclose(found[0], u.reshape(24, 2).mean(axis=1), atol=1e-12)
    prepared, header = PreparedPsfs(), fits.Header({**part, **read_out})
    fitted = prepared.on_pixels_of(header, "psf", lambda: psf, (30, 20))
    assert prepared.on_pixels_of(header, "psf", lambda: psf, (30, 20)) is fitted
    moved = fits.Header({**part, **read_out, "PXBEG1": 12, "PXEND1": 31})
    assert prepared.on_pixels_of(moved, "psf", lambda: psf, (30, 20)) is not fitted
