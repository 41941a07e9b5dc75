"""A transit so small that it is written and read in milliseconds; all its pixels are known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.fits.blocks import FitsLimits
from psfcore.simulate.inputs import diffraction_kernel
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.transit import simulate, write

SHAPE = (64, 80)
RADIUS_PX = 4.0
READ_NOISE = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}
SPOT = (slice(40, 46), slice(60, 68))  # far brighter than the rest


def true_rate(pointing: int) -> NDArray[np.float64]:
    """The scene of a pointing, DN/s [y, x]: a slope, stripes and a bright spot."""
    y, x = np.indices(SHAPE)
    scene = 100.0 + 20 * pointing + 0.5 * x + 10 * np.sin(y / 3.0)
    scene[SPOT] = 1000.0
    return scene


def place_of(index: int) -> tuple[float, float]:
    """The place of the occulter in an image, x and y in px."""
    return 10.0 + 4.0 * index, 20.0


def write_transit(
    folder: Path,
    *,
    images: int = 6,
    cards: dict[str, object] | None = None,
    **manifest: Any,
) -> Path:
    """Write images in DN, with exposures of 2 s and 1 s in turn and two pointings; with their PSF and transit.json.

    cards: further keywords of every image. manifest: keys of transit.json to replace. None removes an entry.
    """
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for index in range(images):
        name, pointing = f"{index:03d}.fits", 1 + index // 3
        x, y = place_of(index)
        entries.append({"file": name, "fov": pointing, "x": x, "y": y, "r": RADIUS_PX})
        write_frame(folder / name, index, pointing, cards or {})
    write_kernel(folder / "diffraction.fits")
    content = {
        "schema": "transit/1",
        "instrument": "hri_euv",
        "known_psf": "diffraction.fits",
        "noise": READ_NOISE,
        "images": entries,
    } | manifest
    save_manifest(folder, {key: value for key, value in content.items() if value is not None})
    return folder


def write_frame(path: Path, index: int, pointing: int, cards: dict[str, object]) -> None:
    """One image of the transit."""
    exposure_s = 2.0 if index % 2 == 0 else 1.0
    rate = true_rate(pointing)
    y, x = np.indices(SHAPE)
    cx, cy = place_of(index)
    rate[np.hypot(x - cx, y - cy) <= RADIUS_PX] = 10.0
    rate[SPOT] += np.arange(48).reshape(6, 8) % 8  # so many equal pixels would count as saturated
    header = fits.Header(
        {
            "INSTRUME": "EUI",
            "DETECTOR": "HRI_EUV",
            "BUNIT": "DN",
            "XPOSURE": exposure_s,
            "GAINCOMB": "high-only",
            "DATE-BEG": f"2023-01-03T04:{index:02d}:00",
            "CDELT1": 0.492,
        }
    )
    for key, value in cards.items():
        if value is None:
            del header[key]
        else:
            header[key] = value
    pixels = np.rint(rate * exposure_s)
    level = cards.get("SATURATE")
    if isinstance(level, (int, float)):
        pixels = np.minimum(pixels, level)
    fits.PrimaryHDU(pixels.astype("i4"), header).writeto(path, overwrite=True)


def write_kernel(path: Path, kernel: NDArray[np.float64] | None = None) -> None:
    """Write the known part of a PSF; by default one of 32 px with sum 1."""
    if kernel is None:
        y, x = np.indices((32, 32)) - 16
        kernel = np.exp(-0.5 * (x * x + y * y) / 1.5**2)
        kernel /= kernel.sum()
    fits.PrimaryHDU(np.asarray(kernel, dtype=np.float64)).writeto(path, overwrite=True)


def load_manifest(folder: Path) -> dict[str, Any]:
    """The content of transit.json."""
    content: dict[str, Any] = json.loads((folder / "transit.json").read_text())
    return content


def save_manifest(folder: Path, content: object) -> None:
    """Write transit.json again."""
    (folder / "transit.json").write_text(json.dumps(content))


TRUTH = ScatterTruth(b_px=6.0, c=2.5, total=0.41)


def diffraction(size: int = 64) -> NDArray[np.float64]:
    """An extended core with arms, sum 1."""
    y, x = np.indices((size, size)) - size // 2
    r = np.hypot(x, y)
    kernel = np.exp(-r / 0.8) + 1e-4 * ((x == 0) | (y == 0)) * np.exp(-r / 12)
    return np.asarray(kernel / kernel.sum())


def write_simulated(folder: Path) -> Path:
    """Write nine bright images of 128 px, with the PSF of TRUTH and diffraction()."""
    plan = default_plan(9, 128, oversampling=1, brightness=30.0)
    write(simulate(plan, TRUTH, diffraction(), seed=4), folder)
    return folder


def drawn_truth(seed: int) -> ScatterTruth:
    """A random power law similar to that of the paper."""
    rng = np.random.default_rng([seed, 77])
    return ScatterTruth(b_px=rng.uniform(5.0, 7.5), c=rng.uniform(2.40, 2.65), total=rng.uniform(0.38, 0.45))


def hri_diffraction(size: int) -> NDArray[np.float64]:
    """The diffraction of HRI_EUV on (size, size), sum 1."""
    return diffraction_kernel("hri_euv", None, size, FitsLimits(max_pixels=size**2))
