"""The cache of prepared PSFs: made once, equal to uncached ones, bounded in size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.io.fits import Header

from psfcore.deconvolve.conditions import PreparedPsfs, new_engine
from psfcore.fits.header import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.psf import Psf
from psfcore.psf_sampling import psf_for_image

LIMITS = FitsLimits(max_pixels=512 * 512)
SHAPE = (96, 128)


def test_a_psf_is_read_once_and_a_binned_image_gets_the_psf_of_its_pixels_once(psf_file: Path) -> None:
    fits.setval(psf_file, "CDELT1", value=0.5)
    reads: list[Path] = []

    def read() -> Psf:
        reads.append(psf_file)
        return read_psf(psf_file, LIMITS, parts=False)

    prepared, binned = PreparedPsfs(2**30), Header({"CDELT1": 1.0, "CDELT2": 1.0})
    whole = prepared.on_pixels_of(Header({"CDELT1": 0.5}), "psf", read)
    assert prepared.on_pixels_of(Header(), "psf", read) is whole and whole.plate_scale_arcsec == 0.5
    fitted = prepared.on_pixels_of(binned, "psf", read)
    assert fitted is not whole and prepared.on_pixels_of(binned, "psf", read) is fitted and len(reads) == 1
    np.testing.assert_array_equal(fitted.kernel, psf_for_image(whole, binned).kernel)


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
