"""The memory of a deconvolution: the sizes that it is estimated from, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.memory import MIB, Demand, check_memory, deconvolution_bytes
from psfcore.deconvolve.methods.registry import method_named, method_names
from psfcore.errors import DataError
from psfcore.psf import Psf
from tests.psfcore.conftest import make_image, make_psf


def test_the_transforms_are_those_of_the_engine() -> None:
    weights = np.zeros((80, 80))
    weights[40, 40] = 1.0
    weights[0, :] = weights[:, 0] = 1e-6  # so that the whole array is needed
    psf = make_psf(weights / weights.sum())
    engines: list[Engine] = []

    def engine_for(psf: Psf, plane: tuple[int, int], span: tuple[int, int], threads: int) -> Engine:
        engines.append(Engine(psf.kernel, plane, span=span, threads=threads))
        return engines[-1]

    for method in method_names():
        for edges, shape in (("zero", (96, 130)), ("symmetric", (96, 96)), (None, (64, 200))):
            conditions = Conditions(edges=edges, margin_px=16, engine_for=engine_for)  # type: ignore[arg-type]
            method_named(method)(make_image(np.full(shape, 5.0)), psf, conditions, steps=1)
            sizes = Demand(method, shape, (80, 80), edges=edges, margin_px=16)
            engine = engines.pop()
            assert not engines and sizes.plane == engine.field_shape, (method, edges)
            assert sizes.transform == (engine.column_plan.length, engine.row_plan.length), (method, edges)


def test_more_pixels_need_more_memory() -> None:
    base = deconvolution_bytes(Demand("richardson-lucy", (1024, 1024), (2048, 2048)))
    assert deconvolution_bytes(Demand("richardson-lucy", (2048, 1024), (2048, 2048))) > base + 20e6
    assert deconvolution_bytes(Demand("richardson-lucy", (1024, 1024), (2048, 2048), draws=4)) > base + 20e6
    assert deconvolution_bytes(Demand("richardson-lucy", (1024, 1024), (2048, 2048), edges="zero")) < base
    assert deconvolution_bytes(Demand("richardson-lucy", (1024, 1024), (64, 64))) < base - 32e6


def test_what_does_not_fit_is_refused_with_both_figures() -> None:
    check_memory((4096, 2048), 100 * MIB, 100 * MIB)
    with pytest.raises(DataError) as refused:
        check_memory((4096, 2048), 101 * MIB, 100 * MIB)
    assert refused.value.code == "too-much-memory"
    for text in ("2048 x 4096 px", "101 MiB", "100 MiB", "region"):
        assert text in refused.value.message
    assert refused.value.fields == {"needed_mib": 101, "free_mib": 100}
