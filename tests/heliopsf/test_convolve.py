"""``heliopsf.convolve`` and the command: a direct sum, the forms of images, and the way back by a deconvolution."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData
from click.testing import CliRunner

import heliopsf
from psfcore.errors import DataError
from service.cli.main import main
from tests.conftest import SMALL_INSTRUMENT

SCENE = np.random.default_rng(5).random((48, 40))
SCENE[20, 30] = 500.0


def direct_sum(scene: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Each pixel of the scene spread with the kernel, without a Fourier transform; dark beyond the scene."""
    (ny, nx), (cy, cx) = scene.shape, (size // 2 for size in kernel.shape)
    wide = np.zeros((ny + kernel.shape[0], nx + kernel.shape[1]))
    for y in range(ny):
        for x in range(nx):
            wide[y : y + kernel.shape[0], x : x + kernel.shape[1]] += scene[y, x] * kernel
    return wide[cy : cy + ny, cx : cx + nx]


def test_the_result_is_the_direct_sum(psf: heliopsf.Psf) -> None:
    lopsided = psf.kernel.copy()
    lopsided[30:34, 36] += 0.01  # no symmetry, so that a mirrored kernel would be found
    lopsided /= lopsided.sum()
    recorded = heliopsf.convolve(SCENE, lopsided)
    assert np.allclose(recorded, direct_sum(SCENE, lopsided), rtol=0, atol=1e-6 * SCENE.max())


def test_mirrored_edges_keep_a_uniform_scene_uniform(psf: heliopsf.Psf) -> None:
    uniform = np.full((64, 64), 3.0)
    assert np.allclose(heliopsf.convolve(uniform, psf, edges="symmetric"), 3.0 * psf.kernel.sum(), rtol=1e-4)
    dark_beyond = heliopsf.convolve(uniform, psf)
    assert np.allclose(dark_beyond, direct_sum(uniform, psf.kernel), rtol=1e-5)
    assert dark_beyond[0, 0] < 0.95 * dark_beyond[32, 32]
    with pytest.raises(DataError, match="zero or symmetric") as caught:
        heliopsf.convolve(uniform, psf, edges="extended")
    assert caught.value.code == "bad-edges"


def test_the_form_is_kept_and_pixels_without_a_value_send_no_light(psf: heliopsf.Psf) -> None:
    holed = SCENE.copy()
    holed[3, 4] = np.nan
    recorded = heliopsf.convolve(CCDData(holed, unit="adu", meta={"WAVELNTH": 171}), psf)
    assert isinstance(recorded, CCDData)
    assert np.isnan(recorded.data[3, 4]) and np.isfinite(recorded.data).sum() == SCENE.size - 1
    assert recorded.meta["CNVPSFN"] == psf.name and "PSFID" not in recorded.meta
    dark = np.nan_to_num(holed)
    assert np.allclose(
        recorded.data[np.isfinite(holed)], heliopsf.convolve(dark, psf)[np.isfinite(holed)], rtol=0, atol=1e-4
    )


def test_a_deconvolution_brings_the_scene_back(psf: heliopsf.Psf) -> None:
    smooth = np.exp(-((np.indices((64, 64)) - 32) ** 2).sum(0) / 50) + 0.2
    recorded = heliopsf.convolve(smooth, psf, edges="symmetric")
    sharp = heliopsf.deconvolve(recorded, psf, steps=40, edges="symmetric")
    assert np.abs(sharp - smooth).max() < 0.2 * np.abs(recorded - smooth).max()


def test_the_command_writes_what_the_function_returns(tmp_path: Path) -> None:
    instrument, model, output = tmp_path / "small.toml", tmp_path / "model.fits", tmp_path / "recorded.fits"
    instrument.write_text(SMALL_INSTRUMENT)
    fits.PrimaryHDU(SCENE.astype(np.float32)).writeto(model)
    command = ["convolve", str(model), "--psf", str(instrument), "--other-channel", "-o", str(output)]
    told = CliRunner().invoke(main, command, catch_exceptions=False)
    assert told.exit_code == 0, told.output
    assert "of the light stays in the field" in told.output
    with pytest.warns(heliopsf.DataWarning):
        expected = heliopsf.convolve(model, instrument, other_channel=True)
    assert np.array_equal(fits.getdata(output), expected.pixels.astype(np.float32))
    assert fits.getheader(output)["CNVPSFV"] == expected.psf.version
    again = CliRunner().invoke(main, command)
    assert again.exit_code != 0 and "recorded.fits" in again.output


def test_a_psf_of_another_channel_is_refused_before_it_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("heliopsf.psfs.built_psf", lambda *_, **__: pytest.fail("the PSF was built"))
    header = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_1", "WAVELNTH": 193, "WAVEUNIT": "angstrom"}
    with pytest.raises(DataError) as caught:
        heliopsf.convolve((SCENE, header), "aia_171")
    assert caught.value.code == "channel-mismatch"
