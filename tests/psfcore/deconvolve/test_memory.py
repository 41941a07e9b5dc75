"""The memory of a deconvolution: the sizes that it is estimated from, what is refused, and the cache of prepared
PSFs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.io.fits import Header

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs, new_engine
from psfcore.deconvolve.forward import convolve_image
from psfcore.deconvolve.memory import MIB, Demand, check_memory, convolution_bytes, deconvolution_bytes
from psfcore.deconvolve.methods.registry import method_named, method_names
from psfcore.deconvolve.run import PsfSource
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.psf import Psf
from psfcore.psf_sampling import psf_for_image
from tests.psfcore.conftest import make_image, make_psf

LIMITS = FitsLimits(max_pixels=512 * 512)
SHAPE = (96, 128)


def test_the_transforms_are_those_of_the_engine() -> None:
    weights = np.zeros((80, 80))
    weights[40, 40] = 1.0
    weights[0, :] = weights[:, 0] = 1e-6  # so that the whole array is needed
    psf = make_psf(weights / weights.sum())
    engines: list[Engine] = []

    def engine_for(
        psf: Psf, plane: tuple[int, int], span: tuple[int, int], threads: int, margin_px: int
    ) -> Engine:
        engines.append(Engine(psf.kernel, plane, span=span, threads=threads))
        return engines[-1]

    for method in method_names():
        for edges, shape in (
            ("zero", (96, 130)),
            ("symmetric", (96, 96)),
            ("periodic", (96, 80)),
            (None, (64, 200)),
        ):
            conditions = Conditions(edges=edges, margin_px=16, engine_for=engine_for)  # type: ignore[arg-type]
            method_named(method)(make_image(np.full(shape, 5.0)), psf, conditions, steps=1)
            sizes = Demand(method, shape, (80, 80), edges=edges, margin_px=16)
            engine = engines.pop()
            assert not engines and sizes.plane == engine.field_shape, (method, edges)
            assert sizes.transform == (engine.column_plan.length, engine.row_plan.length), (method, edges)


def test_more_pixels_need_more_memory_and_what_does_not_fit_is_refused() -> None:
    base = deconvolution_bytes(Demand("richardson-lucy", (1024, 1024), (2048, 2048)))
    assert deconvolution_bytes(Demand("richardson-lucy", (2048, 1024), (2048, 2048))) > base + 20e6
    assert deconvolution_bytes(Demand("richardson-lucy", (1024, 1024), (2048, 2048), draws=4)) > base + 20e6
    assert deconvolution_bytes(Demand("richardson-lucy", (1024, 1024), (2048, 2048), edges="zero")) < base
    assert deconvolution_bytes(Demand("richardson-lucy", (1024, 1024), (64, 64))) < base - 32e6
    check_memory((4096, 2048), 100 * MIB, 100 * MIB)
    with pytest.raises(DataError) as refused:
        check_memory((4096, 2048), 101 * MIB, 100 * MIB)
    assert refused.value.code == "too-much-memory"
    for text in ("2048 x 4096 px", "101 MiB", "100 MiB", "region"):
        assert text in refused.value.message
    assert refused.value.fields == {"needed_mib": 101, "free_mib": 100}
    small = convolution_bytes((1024, 1024), (2048, 2048), "zero")
    assert convolution_bytes((1024, 1024), (64, 64), "zero") < small - 32e6
    assert small < convolution_bytes((1024, 1024), (2048, 2048), "symmetric") - 20e6


def test_a_convolution_that_does_not_fit_is_refused_before_its_psf_is_built() -> None:
    source = PsfSource(lambda *_: pytest.fail("the PSF is built"), lambda *_: ())
    with pytest.raises(DataError) as refused:
        convolve_image(make_image(np.full((64, 64), 5.0)), source, free_bytes=MIB)
    assert refused.value.code == "too-much-memory" and refused.value.fields["free_mib"] == 1
    assert "convolution" in refused.value.message and "region" not in refused.value.message


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


def test_engines_are_made_once_and_the_oldest_are_removed(
    psf_file: Path,
) -> None:
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
