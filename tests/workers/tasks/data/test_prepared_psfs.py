"""The cache of prepared PSFs: made once, equal to uncached ones, bounded in size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.io.fits import Header

from psfcore.deconvolve.conditions import new_engine
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.psf_sampling import psf_for_image
from service.local import LocalService
from tests.conftest import write_image, write_psf
from workers.tasks.data import prepared_psfs
from workers.tasks.data.prepared_psfs import PreparedPsfs

LIMITS = FitsLimits(max_pixels=512 * 512)
SHAPE = (96, 128)


def test_a_psf_is_read_once_and_equals_the_file(psf_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = PreparedPsfs(2**30)
    first = prepared.on_pixels_of(Header(), psf_file, lambda: psf_file, LIMITS)
    monkeypatch.delattr(prepared_psfs, "read_psf")
    assert prepared.on_pixels_of(Header({"CDELT1": 7.0}), psf_file, lambda: psf_file, LIMITS) is first
    np.testing.assert_array_equal(first.kernel, read_psf(psf_file, LIMITS, parts=False).kernel)


def test_a_binned_image_gets_the_psf_of_its_pixels_once(tmp_path: Path) -> None:
    write_psf(tmp_path / "psf.fits")
    fits.setval(tmp_path / "psf.fits", "CDELT1", value=0.5)
    prepared, binned = PreparedPsfs(2**30), Header({"CDELT1": 1.0, "CDELT2": 1.0})
    whole = prepared.on_pixels_of(Header({"CDELT1": 0.5}), "psf", lambda: tmp_path / "psf.fits", LIMITS)
    assert whole.plate_scale_arcsec == 0.5
    found = prepared.on_pixels_of(binned, "psf", lambda: tmp_path / "psf.fits", LIMITS)
    assert (
        found is not whole
        and prepared.on_pixels_of(binned, "psf", lambda: tmp_path / "psf.fits", LIMITS) is found
    )
    np.testing.assert_array_equal(found.kernel, psf_for_image(whole, binned).kernel)


def test_an_engine_is_made_once_for_a_psf_and_a_shape(psf_file: Path) -> None:
    prepared = PreparedPsfs(2**30)
    psf, other = (read_psf(psf_file, LIMITS, parts=False) for _ in range(2))
    engine = prepared.engine_for(psf, SHAPE, SHAPE, 1)
    assert prepared.engine_for(psf, SHAPE, SHAPE, 1) is engine
    others = [
        prepared.engine_for(other, SHAPE, SHAPE, 1),
        prepared.engine_for(psf, (64, 64), (64, 64), 1),
        prepared.engine_for(psf, SHAPE, SHAPE, 2),
    ]
    assert len({id(one) for one in (engine, *others)}) == 4


def test_the_least_recently_used_are_removed_but_never_the_last(psf_file: Path) -> None:
    psf = read_psf(psf_file, LIMITS, parts=False)
    size = new_engine(psf, SHAPE, SHAPE, 1).nbytes
    assert size > 2 * 4 * SHAPE[0] * SHAPE[1]
    prepared = PreparedPsfs(int(2.5 * size))
    shapes = [SHAPE, (97, 128), (98, 128)]
    first, second, third = (prepared.engine_for(psf, shape, shape, 1) for shape in shapes)
    assert prepared.engine_for(psf, shapes[1], shapes[1], 1) is second
    assert prepared.engine_for(psf, shapes[0], shapes[0], 1) is not first
    assert prepared.engine_for(psf, shapes[2], shapes[2], 1) is not third, "it was used longest ago by then"
    tiny = PreparedPsfs(0)
    only = tiny.engine_for(psf, SHAPE, SHAPE, 1)
    assert tiny.engine_for(psf, SHAPE, SHAPE, 1) is only


def test_jobs_share_prepared_psfs(
    local: LocalService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engines: list[object] = []
    real = prepared_psfs.new_engine
    monkeypatch.setattr(prepared_psfs, "new_engine", lambda *given: engines.append(given) or real(*given))
    write_psf(tmp_path / "psf.fits", size=62)  # of a size that no other test uses: a process shares them
    psf_id = local.upload_psf(tmp_path / "psf.fits")["id"]
    for seed in range(2):
        write_image(tmp_path / f"{seed}.fits", seed=seed)
        local.deconvolve(tmp_path / f"{seed}.fits", psf_id=psf_id, steps=2)
    assert len(engines) == 1
