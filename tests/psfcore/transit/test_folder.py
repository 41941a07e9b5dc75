"""A transit is read as it was written; the error for an unusable folder gives the reason."""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.errors import DataError, HeaderError
from psfcore.fits.blocks import FitsLimits
from psfcore.noise import Noise
from psfcore.transit.folder import checked_kernel, read_prepared, read_transit
from tests.psfcore.conftest import gaussian as smooth
from tests.transit_files import (
    SHAPE,
    SPOT,
    load_manifest,
    place_of,
    save_manifest,
    true_rate,
    write_frame,
    write_kernel,
    write_transit,
)

LIMITS = FitsLimits(max_pixels=512 * 512)
Flat = NDArray[np.float64]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_transit(tmp_path / "transit")


def refusal(folder: Path, code: str, **options: Any) -> str:
    with pytest.raises(DataError) as caught:
        read_transit(folder, LIMITS, **options)
    assert caught.value.code == code, caught.value
    return caught.value.message


def change_image(folder: Path, index: int, **values: object) -> None:
    content = load_manifest(folder)
    content["images"][index].update(values)
    save_manifest(folder, content)


gaussian = partial(smooth, sigma_px=1.5)


# --- what is read -----------------------------------------------------------------------------------------


def test_a_transit_is_read_in_dn_per_second(folder: Path) -> None:
    told: list[tuple[int, int]] = []
    transit = read_transit(folder, LIMITS, progress=lambda done, of: told.append((done, of)))
    assert told == [(done, 6) for done in range(1, 7)]
    assert [frame.file for frame in transit.frames] == [f"{i:03d}.fits" for i in range(6)]
    assert [frame.time_s for frame in transit.frames] == [60.0 * i for i in range(6)]
    assert [frame.pointing for frame in transit.frames] == [1, 1, 1, 2, 2, 2]
    assert [frame.exposure_s for frame in transit.frames] == [2, 1, 2, 1, 2, 1]
    assert {frame.gain_mode for frame in transit.frames} == {"high-only"}
    assert transit.shape == SHAPE and transit.noise == Noise(6.0, 2.0)
    assert (transit.instrument, transit.plate_scale_arcsec) == ("hri_euv", 0.492)
    for index, frame in enumerate(transit.frames):
        assert frame.pixels.dtype == np.float32 and frame.filled is None
        assert (frame.place.x_px, frame.place.y_px) == place_of(index)
        y, x = np.indices(SHAPE)
        far = np.hypot(x - frame.place.x_px, y - frame.place.y_px) > 8
        far[SPOT] = False  # its pixels differ by up to 7 DN/s
        assert np.allclose(
            frame.pixels[far], true_rate(frame.pointing)[far], atol=0.51
        )  # whole DN are stored
        assert np.allclose(frame.pixels[20, round(frame.place.x_px)], 10, atol=0.51)
    dn = transit.frames[0].pixels
    names = {path.name for path in folder.iterdir()}
    assert transit.sha256 == {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names
    }
    write_transit(folder, cards={"BUNIT": "DN / s"})
    assert np.array_equal(read_transit(folder, LIMITS).frames[0].pixels, 2 * dn), "DN/s stay"


def test_frames_are_sorted_by_time_or_without_dates_by_the_manifest(folder: Path) -> None:
    dates = {0: "2023-01-03T05:00:00Z", 4: "2023-01-03T04:01:00.000", 5: "2023-01-03T03:59:30"}
    for index, date in dates.items():
        write_frame(folder / f"{index:03d}.fits", index, 1 + index // 3, {"DATE-BEG": date})
    frames = read_transit(folder, LIMITS).frames
    assert [frame.file[:3] for frame in frames] == ["005", "001", "004", "002", "003", "000"]
    assert [frame.time_s for frame in frames] == [0, 90, 90, 150, 210, 3630]
    assert [frame.place.x_px for frame in frames] == [place_of(i)[0] for i in (5, 1, 4, 2, 3, 0)]
    for date in (None, "yesterday", "2023-01-03T25:00:00"):
        write_frame(folder / "003.fits", 3, 2, {"DATE-BEG": date})
        frames = read_transit(folder, LIMITS).frames
        assert [frame.time_s for frame in frames] == [0, 1, 2, 3, 4, 5]
        assert [frame.file for frame in frames] == [f"{i:03d}.fits" for i in range(6)]
    write_transit(folder, cards={"DATE-BEG": None, "DATE-OBS": "2023-01-03T04:00:00"})
    assert [frame.time_s for frame in read_transit(folder, LIMITS).frames] == [0.0] * 6


def test_noise_and_instrument_come_from_call_manifest_or_headers(folder: Path) -> None:
    assert read_transit(folder, LIMITS, noise=Noise(1.0, 0.5)).noise == Noise(1.0, 0.5)
    write_transit(folder, noise=None)
    assert read_transit(folder, LIMITS, noise=Noise(1.0, 0.5)).noise == Noise(1.0, 0.5)
    message = refusal(folder, "no-noise-figures")
    assert "photon_gain_dn" in message and "read_noise_dn" in message
    write_transit(folder, instrument=None)
    assert read_transit(folder, LIMITS).instrument == "hri_euv"
    write_transit(folder, instrument=None, cards={"DETECTOR": "other"})
    assert read_transit(folder, LIMITS).instrument is None


def test_saturated_pixels_are_filled_and_counted(folder: Path) -> None:
    write_transit(folder, cards={"SATURATE": 1500.0})
    transit, prepared = read_prepared(folder, LIMITS)
    first = transit.frames[0]
    assert first.filled is not None and np.count_nonzero(first.filled) == 48
    assert np.allclose(first.pixels[first.filled], 1003.5, rtol=5e-3)  # 1000 to 1007, scaled
    assert transit.frames[1].filled is None
    assert [count.from_frames for count in prepared.frames] == [48, 0, 48, 0, 48, 0]
    assert prepared.to_json()["unfilled"] == 0
    write_transit(folder)
    _, prepared = read_prepared(folder, LIMITS, saturation_dn=1500.0)  # the level can be given
    assert [count.saturated for count in prepared.frames] == [48, 0, 48, 0, 48, 0]


# --- the known part of the PSF ----------------------------------------------------------------------------


def test_a_known_psf_sums_to_one_exactly(folder: Path) -> None:
    write_kernel(folder / "diffraction.fits", gaussian(32)[:, 4:28] * 1.0009)
    kernel = read_transit(folder, LIMITS).diffraction
    assert kernel.shape == (32, 24) and kernel.dtype == np.float64
    assert kernel.sum() == pytest.approx(1, abs=1e-14)
    assert np.unravel_index(kernel.argmax(), kernel.shape) == (16, 12)
    rounded = checked_kernel(dirty((3, 3), -1e-9), "k")
    assert rounded.min() == 0 and rounded.sum() == pytest.approx(1, abs=1e-14)


def dirty(at: tuple[int, int], value: float) -> Flat:
    kernel = gaussian(32)
    kernel[at] = value
    return kernel


def test_a_wrong_known_psf_is_refused(folder: Path) -> None:
    for kernel, code, word in (
        (gaussian(32) * 1.002, "known-psf-sum", "1.002"),
        (gaussian(32) * 0.9, "known-psf-sum", "0.9"),
        (np.zeros((32, 32)), "known-psf-sum", "0"),
        (gaussian(15), "known-psf-small", "(15, 15)"),
        (gaussian(32)[:, 10:25], "known-psf-small", "(32, 15)"),
        (np.roll(gaussian(32), 1, axis=0), "known-psf-not-centred", "(17, 16)"),
        (np.fft.ifftshift(gaussian(32)), "known-psf-not-centred", "(0, 0)"),
        (dirty((3, 3), np.nan), "known-psf-nonfinite", "1"),
        (dirty((3, 3), -0.01), "known-psf-negative", "-0.01"),
    ):
        write_kernel(folder / "diffraction.fits", kernel)
        message = refusal(folder, code)
        assert "diffraction.fits" in message and "expected" in message and word in message


def test_the_given_diffraction_is_used_only_if_no_known_psf_is_named(folder: Path) -> None:
    assert read_transit(folder, LIMITS, diffraction=gaussian(20)).diffraction.shape == (32, 32)
    write_transit(folder, known_psf=None)
    assert "known_psf" in refusal(folder, "no-known-psf")
    assert read_transit(folder, LIMITS, diffraction=gaussian(20)).diffraction.shape == (20, 20)
    requests: list[tuple[str | None, tuple[int, int]]] = []

    def built(instrument: str | None, shape: tuple[int, int]) -> Flat:
        requests.append((instrument, shape))
        return gaussian(24)

    transit = read_transit(folder, LIMITS, diffraction=built)
    assert requests == [("hri_euv", SHAPE)] and transit.diffraction.shape == (24, 24)
    assert "diffraction.fits" not in transit.sha256
    refusal(folder, "known-psf-sum", diffraction=2 * gaussian(20))


# --- what cannot be used ----------------------------------------------------------------------------------


def test_missing_files_are_named(folder: Path) -> None:
    for name in ("002.fits", "diffraction.fits"):
        (folder / name).unlink()
    message = refusal(folder, "missing-file")
    assert "002.fits" in message and "diffraction.fits" in message and "001.fits" not in message
    (folder / "transit.json").unlink()
    refusal(folder, "no-manifest")


def rewrite(folder: Path, index: int, pixels: Flat) -> None:
    """Replace the pixels of an image; the header stays."""
    path = folder / f"{index:03d}.fits"
    fits.PrimaryHDU(pixels, fits.getheader(path)).writeto(path, overwrite=True)


def test_an_occulter_must_be_partly_inside_the_frame_and_fit_into_it(folder: Path) -> None:
    inside = ((-4.4, 20), (83.4, 20), (10, -4.4), (10, 67.4))
    outside = ((-4.6, 20), (83.6, 20), (10, -4.6), (10, 67.6), (1e5, 20))
    for x, y in inside:
        change_image(folder, 2, x=x, y=y)
        assert read_transit(folder, LIMITS).frames[2].place.x_px == x
    for x, y in outside:
        change_image(folder, 2, x=x, y=y)
        assert "images[2] (002.fits)" in refusal(folder, "occulter-outside")
    change_image(folder, 2, x=18.0, y=20.0)
    change_image(folder, 1, r=16.0)
    read_transit(folder, LIMITS)
    change_image(folder, 1, r=16.5)
    assert "images[1] (001.fits)" in refusal(folder, "occulter-too-large")


def test_all_images_with_faults_are_named_in_one_error(folder: Path) -> None:
    rewrite(folder, 4, np.ones((64, 64), "i4"))
    message = refusal(folder, "transit-shapes")
    assert "images[4] (004.fits)" in message and "64 x 64" in message and "80 x 64" in message
    rewrite(folder, 1, np.ones((64, 64), "i4"))
    change_image(folder, 2, x=1e5)
    message = refusal(folder, "transit-shapes")
    assert all(name in message for name in ("3 files cannot be used", "001.fits", "002.fits", "004.fits"))
    for index in (1, 4):
        (folder / f"00{index}.fits").write_bytes(b"SIMPLE  = letter" + bytes(3000))
    with pytest.raises(HeaderError) as headers:
        read_transit(folder, LIMITS)
    assert "001.fits: " in headers.value.message and "004.fits: " in headers.value.message
    write_transit(folder)
    for index in (0, 5):
        rewrite(folder, index, np.full(SHAPE, np.nan, "f4"))
    message = refusal(folder, "all-nan")
    assert "000.fits: " in message and "005.fits: " in message


def test_unusable_frames_are_refused(folder: Path) -> None:
    cases: list[tuple[dict[str, object], str]] = [
        ({"BUNIT": "photon"}, "unknown-unit"),
        ({"BUNIT": None}, "unknown-unit"),
        ({"XPOSURE": None}, "no-exposure"),
        ({"XPOSURE": 0.0}, "no-exposure"),
        ({"SATURATE": 1.0}, "all-saturated"),
    ]
    for cards, code in cases:
        write_frame(folder / "005.fits", 5, 2, cards)
        assert "005.fits" in refusal(folder, code), cards


def test_unusable_files_are_refused(folder: Path) -> None:
    whole = (folder / "001.fits").read_bytes()
    (folder / "001.fits").write_bytes(whole[:6000])
    with pytest.raises(HeaderError, match=r"001\.fits"):
        read_transit(folder, LIMITS)
    (folder / "001.fits").write_bytes(whole)
    with pytest.raises(HeaderError, match=r"000\.fits") as caught:
        read_transit(folder, FitsLimits(max_pixels=1000))
    assert caught.value.code == "too-many-pixels"
    (folder / "diffraction.fits").write_text("hello")
    assert "diffraction.fits" in refusal(folder, "not-fits")
