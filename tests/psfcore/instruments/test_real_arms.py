"""The arms of the TRACE file are where a real image without a flare has them, found from its cepstrum."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.instruments.model import load_instrument

ORDERS = np.arange(1, 6)


def cepstrum(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transform of the logarithm of the power spectrum, without its smooth part: echoes of the image become
    peaks."""
    size = len(image)
    calm = np.maximum(ndimage.median_filter(image, 5), 1.0)
    root = np.sqrt(np.where(image > calm + 6 * np.sqrt(calm) + 30, calm, np.maximum(image, 1.0)))
    window = np.hanning(size)
    power = np.log(np.abs(np.fft.fft2((root - ndimage.gaussian_filter(root, 10)) * np.outer(window, window))))
    x = np.abs(np.fft.fftfreq(size))
    used = (np.hypot(x[:, None], x) < 0.3) & (np.minimum(x[:, None], x) > 0.003)
    smooth = [ndimage.gaussian_filter(one, 15, mode="wrap") for one in (np.where(used, power, 0), 1.0 * used)]
    rest = np.where(used, power - smooth[0] / np.maximum(smooth[1], 1e-6), 0)
    return np.asarray(ndimage.gaussian_filter(np.fft.fftshift(np.fft.ifft2(rest).real), 0.8))


def test_a_real_image_of_trace_has_the_arms_of_the_file(real: Callable[[str], Path]) -> None:
    """Of all spacings from 8 to 32 px and all directions, those of the file stand out. Between the two lines of the
    channel, at 171.1 and 174.5 angstrom, the spacing is 1 % above that of the file."""
    path = real("other/trace_19980519_222143_171.fits.gz")
    trace = load_instrument("trace_171")
    (mesh,) = trace.meshes
    reach_mm = trace.wavelength_angstrom * 1e-7 * trace.focal_length_mm
    predicted_px = reach_mm / (mesh.pitch_um * 1e-3) / (trace.detector.pixel_pitch_um * 1e-3)
    dark_dn = 85.0
    echoes = cepstrum(fits.getdata(path).astype(np.float64) - dark_dn)
    middle = len(echoes) // 2
    light = np.sinc((1 - mesh.wire_um / mesh.pitch_um) * ORDERS) ** 2
    angles, spacings = np.arange(0.0, 90.0), np.arange(8.0, 32.0, 0.1)
    turned, along = np.radians(angles)[:, None, None], spacings[:, None] * ORDERS
    arms = [
        (
            ndimage.map_coordinates(echoes, [middle + along * np.sin(a), middle + along * np.cos(a)], order=1)
            * light
        ).sum(axis=2)
        for a in (turned, turned + np.pi / 2)
    ]
    score = arms[0] + arms[1]
    best, spacing = np.unravel_index(score.argmax(), score.shape)
    assert score.max() > score.mean() + 5 * score.std()
    assert spacings[spacing] == pytest.approx(predicted_px, rel=0.03)
    assert angles[best] == pytest.approx(mesh.angle_deg, abs=1.5)
