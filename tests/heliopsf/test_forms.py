"""Images as people have them: Maps, NDData, arrays, files and lists; the result has the form of the image."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import astropy.units as u
import dask.array
import numpy as np
import pytest
import sunpy.map
from astropy.io import fits
from astropy.nddata import CCDData, NDData, StdDevUncertainty, UnknownUncertainty, VarianceUncertainty
from astropy.utils.masked import Masked
from astropy.wcs import WCS
from astropy.wcs.wcsapi import HighLevelWCSWrapper, SlicedLowLevelWCS

import heliopsf
from heliopsf import DataError, DataWarning
from psfcore.deconvolve.assess.quality import QualityBit
from psfcore.psf_sampling import rebinned_kernel

SHAPE = (96, 128)
SCALE = 2.0


def pixels(seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    y, x = np.indices(SHAPE)
    return 20 + np.rint(300 * np.exp(-((x - 40) ** 2 + (y - 50) ** 2) / 18)) + rng.poisson(30, SHAPE)


def cards(**more: Any) -> dict[str, Any]:
    telescope = {"telescop": "SMALL", "instrume": "SMALL_1", "wavelnth": 171, "waveunit": "angstrom"}
    exposure = {"bunit": "DN", "exptime": 2.0, "date-obs": "2024-03-01T12:00:00"}
    axes = {"cdelt1": SCALE, "cdelt2": SCALE, "cunit1": "arcsec", "cunit2": "arcsec"}
    axes |= {"crpix1": 64.5, "crpix2": 48.5, "crval1": 0.0, "crval2": 0.0}
    axes |= {"ctype1": "HPLN-TAN", "ctype2": "HPLT-TAN"}
    place = {"hgln_obs": 0.0, "hglt_obs": 0.0, "dsun_obs": 1.496e11}
    return telescope | exposure | axes | place | more


def header(**more: Any) -> fits.Header:
    return fits.Header({key.upper(): value for key, value in cards(**more).items()})


def a_map(data: np.ndarray | None = None, **more: Any) -> Any:
    return sunpy.map.Map(pixels() if data is None else data, cards(**more))


def test_a_map_comes_back_as_a_map_that_is_a_product(psf: heliopsf.Psf, tmp_path: Path) -> None:
    image = a_map(history="calibrated\nflat-fielded", datamin=1.0, datarms=3.0)
    before = dict(image.meta)
    result = heliopsf.deconvolve(image, psf, iterations=5)
    assert type(result) is type(image) and dict(image.meta) == before
    kept = {key: value for key, value in before.items() if key not in ("history", "datamin", "datarms")}
    assert {key: result.meta[key] for key in kept} == kept
    assert "datarms" not in result.meta
    assert result.wcs.wcs.compare(image.wcs.wcs)
    assert result.meta["psfid"] == psf.provenance["psf_id"] and result.meta["psfvers"] == psf.version
    assert result.meta["dcnviter"] == 5 and result.meta["dcnvpass"] == 1
    lines = result.meta["history"].splitlines()
    assert lines[:2] == ["calibrated", "flat-fielded"]
    assert "richardson-lucy, 5 steps" in lines[2] and psf.version in lines[2]
    assert result.mask is None and result.uncertainty is None
    result = heliopsf.deconvolve(a_map(), psf)
    result.save(tmp_path / "product.fits")
    assert fits.getheader(tmp_path / "product.fits")["PSFID"] == psf.provenance["psf_id"]
    for again in (result, tmp_path / "product.fits", sunpy.map.Map(tmp_path / "product.fits")):
        with pytest.raises(DataError, match="already-deconvolved"):
            heliopsf.deconvolve(again, psf)
    assert heliopsf.deconvolve(result, psf, again=True).meta["dcnvpass"] == 2


def test_every_form_gives_the_same_pixels(psf: heliopsf.Psf, tmp_path: Path) -> None:
    data = pixels()
    a_map().save(tmp_path / "image.fits")
    wanted = heliopsf.deconvolve(tmp_path / "image.fits", psf)
    assert isinstance(wanted, heliopsf.Deconvolution)
    forms: list[Any] = [
        a_map(),
        NDData(data, unit="DN", meta=cards()),
        CCDData(data, unit="adu", meta=header(), wcs=WCS(header())),
        data,
        data.astype(">i4"),
    ]
    for image in forms:
        result = heliopsf.deconvolve(image, psf, other_channel=True)
        assert type(result) is type(image)
        found = result if isinstance(result, np.ndarray) else result.data
        np.testing.assert_array_equal(found, wanted.pixels)
    quantity = heliopsf.deconvolve(data * u.DN, psf)
    assert quantity.unit == u.DN
    np.testing.assert_array_equal(quantity.value, wanted.pixels)
    lazy = dask.array.from_array(data)
    with pytest.warns(DataWarning, match="dask") as warned:
        np.testing.assert_array_equal(heliopsf.deconvolve(lazy, psf), wanted.pixels)
    assert "dask-computed" in [one.message.code for one in warned]  # type: ignore[union-attr]
    with pytest.warns(DataWarning, match="dask"):
        np.testing.assert_array_equal(heliopsf.deconvolve(a_map(lazy), psf).data, wanted.pixels)


def test_ccd_data_keeps_unit_wcs_and_header(psf: heliopsf.Psf) -> None:
    image = CCDData(pixels(), unit="DN / s", meta=header(), wcs=WCS(header()))
    result = heliopsf.deconvolve(image, psf)
    assert result.unit == image.unit and result.wcs is image.wcs
    assert result.header["PSFVERS"] == psf.version and "PSFVERS" not in image.header
    assert "steps" in str(result.header["HISTORY"])
    # Without cards, the plate scale is that of the WCS.
    image = CCDData(pixels(), unit="DN", wcs=WCS(header(cdelt1=3.0, cdelt2=3.0)))
    with pytest.raises(DataError, match="plate-scale-mismatch"):
        heliopsf.deconvolve(image, psf)


class Cube(NDData):
    """The contract of an NDCube (package ndcube): coordinates are required, and may be those of a slice."""

    def __init__(self, data: Any, wcs: Any = None, **more: Any) -> None:
        if wcs is None:
            raise TypeError("The WCS argument can not be None.")
        super().__init__(data, wcs=wcs, **more)


def test_a_cube_of_two_axes_stays_a_cube_with_its_coordinates(psf: heliopsf.Psf) -> None:
    three = WCS(header(naxis=3, ctype3="UTC", cunit3="s", cdelt3=10.0, crpix3=1.0, crval3=0.0))
    hidden = np.zeros(SHAPE, bool)
    hidden[30, 40] = True
    for wcs in (WCS(header()), HighLevelWCSWrapper(SlicedLowLevelWCS(three, 0))):
        image = Cube(
            pixels(), wcs, unit=u.DN, meta=cards(), mask=hidden, uncertainty=StdDevUncertainty(1 + pixels())
        )
        result = heliopsf.deconvolve(image, psf, error_draws=2)
        assert type(result) is Cube and result.wcs is image.wcs and result.unit == u.DN
        assert result.meta["PSFVERS"] == psf.version and "PSFVERS" not in image.meta
        assert (result.uncertainty.array[~hidden] > 0).all()
        np.testing.assert_array_equal(result.mask, hidden)
        part = heliopsf.deconvolve(image, psf, region=np.s_[10:60, 20:90])
        assert type(part) is Cube and part.data.shape == (50, 70)
    with pytest.raises(DataError, match="not-2d"):
        heliopsf.deconvolve(Cube(np.ones((3, *SHAPE)), three, unit=u.DN), psf)


def test_pixels_without_a_value_and_masked_arrays_stay_masked(psf: heliopsf.Psf) -> None:
    data = pixels()
    data[10, 20] = np.nan
    mask = np.zeros(SHAPE, bool)
    mask[30, 40] = True
    image = sunpy.map.Map(data, cards(), mask=mask)
    result = heliopsf.deconvolve(image, psf)
    wanted = mask | np.isnan(data)
    np.testing.assert_array_equal(np.isnan(result.data), wanted)
    np.testing.assert_array_equal(result.mask, wanted)
    full = heliopsf.deconvolve(image, psf, full=True)
    np.testing.assert_array_equal((full.quality & QualityBit.NONFINITE) != 0, wanted)
    hidden = np.zeros(SHAPE, bool)
    hidden[30, 40] = True
    wanted = heliopsf.deconvolve(sunpy.map.Map(pixels(), cards(), mask=hidden), psf)
    for image in (
        np.ma.MaskedArray(pixels(), hidden),
        Masked(pixels() * u.DN, hidden),
        Masked(pixels(), hidden),
    ):
        result = heliopsf.deconvolve(image, psf)
        assert type(result) is type(image)
        np.testing.assert_array_equal(result.mask, hidden)
        found = np.asarray(getattr(result, "unmasked", result))
        np.testing.assert_array_equal(found[~hidden], wanted.data[~hidden])
    unhidden = sunpy.map.Map(pixels(), cards(), mask=np.zeros(SHAPE, bool))
    assert not heliopsf.deconvolve(unhidden, psf).mask.any()


def test_an_uncertainty_is_added_where_asked(psf: heliopsf.Psf) -> None:
    noise = (2.0, 1.0)
    result = heliopsf.deconvolve(a_map(), psf, noise=noise, error_draws=4)
    sigma = result.uncertainty.array
    # Deconvolution amplifies the photon noise of the background of 50 DN.
    assert 10.0 < np.median(sigma) < 40.0 and (sigma > 0).all()
    assert result.meta["dcnvampl"] == pytest.approx(np.median(sigma) / np.sqrt(2 * 50 + 1), rel=0.15)
    measured = heliopsf.deconvolve(a_map(), psf, error_draws=4)
    # The background has the noise of 30 photons.
    variance = 50 * measured.meta["dcnvgain"] + measured.meta["dcnvread"] ** 2
    assert measured.meta["dcnvnois"] == "measured" and variance == pytest.approx(30, rel=0.15)
    assert (measured.uncertainty.array > 0).all() and "dcnvnois" not in result.meta
    with pytest.raises(DataError, match="2 to 64; got 1"):
        heliopsf.deconvolve(a_map(), psf, noise=noise, error_draws=1)


def test_a_rebinned_map_gets_the_rebinned_psf(psf: heliopsf.Psf) -> None:
    anonymous = heliopsf.Psf.of(psf)
    binned = a_map().superpixel([2, 2] * u.pix, func=np.mean)
    unnamed = heliopsf.deconvolve(binned, psf.kernel)  # weights alone have no plate scale
    assert unnamed.data.shape == (48, 64)
    with pytest.raises(DataError, match="plate-scale-mismatch"):
        heliopsf.deconvolve(binned, anonymous)  # the image is not known to be of the instrument of the PSF
    rebinned = psf.rebinned(2)
    assert isinstance(rebinned, heliopsf.Psf) and rebinned.plate_scale_arcsec == 2 * SCALE
    np.testing.assert_array_equal(rebinned.kernel, rebinned_kernel(psf.kernel, 2))
    result = heliopsf.deconvolve(binned, rebinned)
    assert result.meta["psfvers"].endswith("+bin2")
    with pytest.raises(DataError, match=r"plate-scale-mismatch: .*2\.56"):
        heliopsf.deconvolve(a_map().resample([100, 75] * u.pix), psf)


@pytest.mark.filterwarnings("ignore:Missing metadata", "ignore:.*not found", "ignore::UserWarning:sunpy")
def test_a_map_without_coordinates_is_deconvolved_with_a_warning(psf: heliopsf.Psf) -> None:
    few = {"telescop": "SMALL", "wavelnth": 171, "waveunit": "angstrom", "cunit1": "deg", "cunit2": "deg"}
    image = sunpy.map.Map(pixels(), few)
    with pytest.warns(UserWarning, match="image without plate scale"):
        result = heliopsf.deconvolve(image, psf)
    np.testing.assert_array_equal(result.data, heliopsf.deconvolve(a_map(), psf).data)


def test_another_unit_keeps_the_unit_and_ignores_levels_in_dn(psf: heliopsf.Psf) -> None:
    result = heliopsf.deconvolve(a_map(bunit="ph"), psf)
    assert result.unit == u.ph
    np.testing.assert_array_equal(result.data, heliopsf.deconvolve(a_map(), psf).data)
    with pytest.raises(DataError, match="saturation-unit"):
        heliopsf.deconvolve(a_map(bunit="ph"), psf, saturation_dn=100.0)
    bright = heliopsf.deconvolve(a_map(), psf, saturation_dn=100.0)
    assert bright.mask.any() and np.isfinite(bright.data).all()
    with pytest.raises(DataError, match="bad-unit"):
        heliopsf.deconvolve(NDData(pixels(), unit=u.mag), psf)


def test_an_hdu_gives_an_hdu_and_a_list_of_hdus_the_planes_of_a_product(psf: heliopsf.Psf) -> None:
    wanted = heliopsf.deconvolve(pixels(), psf)
    for hdu in (fits.PrimaryHDU(pixels(), header()), fits.ImageHDU(pixels(), header())):
        result = heliopsf.deconvolve(hdu, psf)
        assert type(result) is type(hdu) and "PSFID" not in hdu.header
        np.testing.assert_array_equal(result.data, wanted)
        assert result.header["PSFID"] == psf.provenance["psf_id"] and result.header["CRPIX1"] == 64.5
    several = fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(pixels().astype("i4"), header())])
    product = heliopsf.deconvolve(several, psf, noise=(2.0, 1.0), error_draws=2)
    assert [one.name for one in product] == ["PRIMARY", "QUALITY", "ERROR"]
    np.testing.assert_array_equal(product[0].data, wanted)
    part = heliopsf.deconvolve(several, psf, region=REGION, region_error=0.9)
    assert part[0].data.shape == (32, 32) and part[0].header["CRPIX1"] == 64.5 - 32
    named = fits.HDUList([fits.PrimaryHDU(pixels(2), header()), fits.ImageHDU(pixels(), header())])
    np.testing.assert_array_equal(heliopsf.deconvolve(named, psf, hdu=1)[0].data, wanted)
    with pytest.raises(DataError, match="no-image"):
        heliopsf.deconvolve(fits.HDUList([fits.PrimaryHDU()]), psf)


def test_an_uncertainty_is_the_noise_and_comes_back(psf: heliopsf.Psf) -> None:
    sigma = np.sqrt(2.0 * pixels() + 1.0)
    given = heliopsf.deconvolve(
        NDData(pixels(), unit="DN", meta=cards()), psf, noise=(2.0, 1.0), error_draws=4
    )
    for uncertainty in (
        StdDevUncertainty(sigma),
        VarianceUncertainty(sigma**2),
        StdDevUncertainty(1000 * sigma, unit=u.Unit("0.001 DN")),
    ):
        image = NDData(pixels(), unit="DN", meta=cards(), uncertainty=uncertainty)
        result = heliopsf.deconvolve(image, psf, error_draws=4)
        assert result.meta["DCNVNOIS"] == "uncertainty"
        assert np.median(result.uncertainty.array / given.uncertainty.array) == pytest.approx(1, abs=0.03)
        with pytest.warns(DataWarning) as warned:
            assert heliopsf.deconvolve(image, psf).uncertainty is None
        assert [one.message.code for one in warned] == ["uncertainty-dropped"]  # type: ignore[union-attr]
    unknown = NDData(pixels(), unit="DN", meta=cards(), uncertainty=UnknownUncertainty(sigma))
    with pytest.warns(DataWarning, match="not used"):
        assert heliopsf.deconvolve(unknown, psf).uncertainty is None


def test_a_list_gives_a_list_a_sequence_a_sequence_and_an_error_names_the_image(psf: heliopsf.Psf) -> None:
    maps = [a_map(), a_map(pixels(2))]
    wanted = [heliopsf.deconvolve(image, psf).data for image in maps]
    sequence = sunpy.map.Map(maps, sequence=True)
    for images, kind in ((maps, list), (sequence, sunpy.map.MapSequence)):
        results = heliopsf.deconvolve(images, psf)
        assert isinstance(results, kind)
        for result, expected in zip(results, wanted, strict=True):
            np.testing.assert_array_equal(result.data, expected)
    with pytest.raises(DataError, match=r"channel-mismatch: image 2 of 2: .*304"):
        heliopsf.deconvolve([a_map(), a_map(wavelnth=304)], psf)


def test_what_is_no_image_or_region_is_refused(psf: heliopsf.Psf) -> None:
    for image, code in (
        (None, "bad-input"),
        ({"a": 1}, "bad-input"),
        (np.ones((4, 40, 40)), "not-2d"),
        (np.ones((40, 40), complex), "bad-input"),
        (np.full((40, 40), np.nan), "all-nan"),
        (np.zeros((40, 40)), "no-signal"),
        (np.ones((4, 4)), "too-small"),
    ):
        with pytest.raises(DataError, match=code):
            heliopsf.deconvolve(image, psf)
    regions: list[tuple[Any, str]] = [
        ("1:2", "bad-region"),
        ((1, 2), "bad-region"),
        (np.s_[0:40:2, 0:40], "bad-region"),
        (np.s_[0:40], "bad-region"),
        ("0:20,80:97", "region-outside"),
        (np.s_[0:10, 0:40], "region-too-small"),
    ]
    for region, code in regions:
        for image in (pixels(), a_map()):
            with pytest.raises(DataError, match=code):
                heliopsf.deconvolve(image, psf, region=region)
    with pytest.raises(DataError, match="region-errors"):
        heliopsf.deconvolve(pixels(), psf, region=REGION, error_draws=4, noise=(1.0, 1.0))


def test_a_psf_may_be_an_object_a_file_or_weights(psf: heliopsf.Psf, tmp_path: Path) -> None:
    wanted = heliopsf.deconvolve(a_map(), psf).data
    psf.write(tmp_path / "psf.fits")
    from_file = heliopsf.deconvolve(a_map(), tmp_path / "psf.fits")
    np.testing.assert_array_equal(from_file.data, wanted)
    assert len(from_file.meta["psfid"]) == 64
    weights = heliopsf.deconvolve(a_map(), psf.kernel)
    np.testing.assert_array_equal(weights.data, wanted)
    with pytest.raises(DataError, match="psf-not-centred"):
        heliopsf.deconvolve(a_map(), np.fft.ifftshift(psf.kernel))
    with pytest.raises(DataError, match=r"psf: expected a Psf.*got dict"):
        heliopsf.deconvolve(a_map(), {"psf": 1})  # type: ignore[call-overload]


def test_calls_of_aiapy_work_unchanged(psf: heliopsf.Psf, capsys: pytest.CaptureFixture[str]) -> None:
    """Names and order of ``aiapy.psf.deconvolve`` (0.10): smap, psf, iterations, clip_negative, use_gpu."""
    names = list(inspect.signature(heliopsf.deconvolve).parameters)
    assert names[:5] == ["smap", "psf", "iterations", "clip_negative", "use_gpu"]
    data = pixels()
    data[0, 0] = -5.0
    called = heliopsf.deconvolve(a_map(data), psf=psf.kernel, iterations=25, clip_negative=True, use_gpu=True)
    assert called.meta["dcnviter"] == 25
    np.testing.assert_array_equal(called.data, heliopsf.deconvolve(a_map(data), psf, steps=25).data)
    with pytest.raises(DataError, match="negative-pixels"):
        heliopsf.deconvolve(a_map(data), psf, clip_negative=False)
    kept = heliopsf.deconvolve(a_map(data), psf, clip_negative=False, method="linear")
    clipped = heliopsf.deconvolve(a_map(data), psf, clip_negative=True, method="linear")
    assert kept.data[0, 0] < clipped.data[0, 0]
    with pytest.raises(DataError, match="got both"):
        heliopsf.deconvolve(a_map(), psf, iterations=5, steps=5)
    heliopsf.deconvolve(a_map(), psf, iterations=3, progress=True)
    assert "deconvolving: step 3 of 3\n" in capsys.readouterr().err


REGION = "32:64,24:56"  # x and y differ


def test_a_region_is_its_submap_in_the_form_of_its_image(psf: heliopsf.Psf, tmp_path: Path) -> None:
    image = a_map(datarms=3.0)
    part = image.submap([32, 24] * u.pix, top_right=[63, 55] * u.pix)
    whole = heliopsf.deconvolve(image, psf)
    corners = (part.bottom_left_coord, part.top_right_coord)
    for region in (REGION, np.s_[24:56, 32:64], corners):
        result = heliopsf.deconvolve(image, psf, region=region, region_error=0.9)
        assert type(result) is type(image) and result.data.shape == (32, 32)
        assert result.wcs.wcs.compare(part.wcs.wcs)
        assert result.meta["dcnvbox"] == REGION and "datarms" not in result.meta
        assert result.meta["dcnvrim"] > 0
        assert 0 < result.meta["dcnvberr"] < 0.9 * part.data.mean()
        difference = np.abs(result.data - whole.data[24:56, 32:64])
        assert difference.max() <= result.meta["dcnvberr"]
    a_map().save(tmp_path / "image.fits")
    options: dict[str, Any] = {"region": REGION, "region_error": 0.9, "other_channel": True}
    wanted = heliopsf.deconvolve(tmp_path / "image.fits", psf, **options)
    assert wanted.pixels.shape == wanted.quality.shape == wanted.image.pixels.shape == (32, 32)
    assert [wanted.image.header[key] for key in ("CRPIX1", "CRPIX2")] == [64.5 - 32, 48.5 - 24]
    assert wanted.of_box.rim_px > 0
    np.testing.assert_array_equal(wanted.image.pixels, pixels()[24:56, 32:64])
    for image in (
        NDData(pixels(), unit="DN", meta=cards()),
        CCDData(pixels(), unit="adu", meta=header(), wcs=WCS(header())),
    ):
        result = heliopsf.deconvolve(image, psf, **options)
        np.testing.assert_array_equal(result.data, wanted.pixels)
        assert {key.lower(): value for key, value in result.meta.items()}["crpix2"] == 48.5 - 24
    several = heliopsf.deconvolve([pixels(1), pixels(2)], psf, **options)
    assert [one.shape for one in several] == [(32, 32), (32, 32)]


def test_an_image_that_does_not_fit_into_the_memory_is_refused_before_it_is_read(
    psf: heliopsf.Psf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a_map().save(tmp_path / "image.fits")
    monkeypatch.setattr("heliopsf.images.free_bytes", lambda: 2**17)
    monkeypatch.setattr("heliopsf.images.image_of", lambda *given, **more: pytest.fail("it was read"))
    for image in (a_map(), pixels(), tmp_path / "image.fits"):
        with pytest.raises(DataError, match=r"too-much-memory: .*128 x 96 px"):
            heliopsf.deconvolve(image, psf)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_an_image_of_a_known_telescope_needs_no_option(shared: Path) -> None:
    """The sum of all pixels changes little; a cut-out exchanges light with the Sun beyond its edges."""
    for name, instrument, changed in (
        ("eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits", "hri_euv", 0.01),
        ("aia/aia_171_cutout_20130310.fits", "aia_171", 0.03),
    ):
        image = sunpy.map.Map(shared / "data" / "real" / name)
        sharp = heliopsf.deconvolve(image)
        assert type(sharp) is type(image) and sharp.meta["psfname"] == instrument
        assert sharp.wcs.wcs.compare(image.wcs.wcs)
        assert sharp.data.sum() == pytest.approx(image.data.sum(), rel=changed)
        assert np.percentile(sharp.data, 99) > np.percentile(image.data, 99)
