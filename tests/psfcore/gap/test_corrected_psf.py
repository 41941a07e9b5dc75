"""The corrected PSF: its kernel contains effects of the optics but not of the detector, and its file records its origin."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.gap.corrected_psf import corrected_psf
from psfcore.gap.diagnose import Diagnosis, start_of
from psfcore.gap.effect import Effect
from psfcore.gap.library.optics import DIRECTIONS, EFFECTS, blur_as
from psfcore.gap.library.registry import LIBRARY
from psfcore.psf import REACH_GRID_PX, Psf, cumulative_curve
from psfcore.scatter.shapes import SHAPES
from psfcore.scatter.total_psf import TotalPsf
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from tests.psfcore.gap.small_gaps import found
from tests.transit_files import TRUTH, diffraction

MIDDLE = REACH_GRID_PX // 2
PARENTS = {"transit": "a" * 64, "report": "b" * 64}


def effect(name: str) -> Effect:
    return next(one for one in LIBRARY if one.name == name)


def answered(*effects: Effect, values: tuple[float, ...]) -> Diagnosis:
    """The diagnosis as if these effects, with these values, had been added to the model."""
    names = [f"{one.name}.{p.name}" for one in effects for p in one.parameters]
    numbers = {name: (value, 0.1, "") for name, value in zip(names, values, strict=True)}
    added = found().corrected[0]
    evidence = replace(added.evidence, columns={one.name: () for one in effects})  # used only for errors
    added = replace(added, effects=effects, values=numbers, evidence=evidence)
    return replace(found(), corrected=(added,))


def made(diagnosis: Diagnosis) -> Psf:
    return corrected_psf(diagnosis, "corrected", "1", {"parents": PARENTS})


@cache
def of_the_answer() -> Psf:
    return made(found())


@cache
def fitted_kernel() -> np.ndarray:
    """The PSF fitted together with the effect, computed without the effect."""
    solution = found().corrected[0].solution
    size = (REACH_GRID_PX, REACH_GRID_PX)
    total = TotalPsf(diffraction(), solution.inversion.shape, size)
    return np.maximum(total.kernel(solution.inversion.coordinates), 0.0)


def test_a_detector_effect_is_not_in_the_psf_and_the_psf_is_closer_to_the_truth() -> None:
    np.testing.assert_allclose(of_the_answer().kernel, fitted_kernel(), atol=1e-15)
    radii = np.array([5.0, 10.0, 20.0])
    truth = cumulative_curve(total_kernel(TRUTH, diffraction(), REACH_GRID_PX), radii)
    bent = found().solution.inversion
    size = (REACH_GRID_PX, REACH_GRID_PX)
    before = TotalPsf(diffraction(), bent.shape, size).kernel(bent.coordinates)
    off_before = np.abs(cumulative_curve(before, radii) - truth)
    off_after = np.abs(cumulative_curve(of_the_answer().kernel, radii) - truth)
    assert (off_after < off_before).all()


def test_its_file_records_its_origin_and_the_gap_before_and_after(tmp_path: Path) -> None:
    write_psf(tmp_path / "psf.fits", of_the_answer())
    back = read_psf(tmp_path / "psf.fits", FitsLimits(max_pixels=2**23))
    history = "".join(back.provenance["history"]).replace(" ", "")
    assert PARENTS["transit"] in history and PARENTS["report"] in history
    assert "effects:['dark_offset']" in history and "effect_in_kernel:[]" in history
    assert "gap_before_pct" in history and "gap_after_pct" in history and "'unit':'DN'" in history
    assert set(back.components) == {"DIFFRACTION", "SCATTER"} and back.status == "draft"
    shape, start = start_of(back)
    inversion = found().corrected[0].solution.inversion
    assert shape is SHAPES["softened-power-law"]
    assert start == pytest.approx(inversion.coordinates)
    said = of_the_answer().provenance
    assert (
        said["gap_before_pct"] == found().rms.to_json() and said["gap_after_pct"] == found().after.to_json()
    )
    (value, sigma, unit) = found().corrected[0].values["offset"]
    assert said["effect_parameters"] == {"offset": {"value": value, "sigma": sigma, "unit": unit}}
    assert said["inputs_sha256"]["000.fits"] == "ab" * 32


def test_its_errors_include_those_of_the_effect() -> None:
    assert of_the_answer().fitted is not None
    covariance = np.array(of_the_answer().fitted.covariance)  # type: ignore[union-attr]
    alone = found().corrected[0].model.base.covariance
    assert (np.diag(covariance) > np.diag(alone)).all()
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_a_core_blur_is_in_the_kernel_with_its_own_value() -> None:
    """The change is half the Laplacian of the kernel per unit of variance; the dark offset is not in the kernel."""
    narrow = replace(effect("core_blur"), changes=lambda view: blur_as(view, 0.003, DIRECTIONS[0]), held=None)
    diagnosis = answered(effect("dark_offset"), narrow, values=(5.0, 0.02))
    psf, plain = made(diagnosis), fitted_kernel()
    window = (slice(MIDDLE - 30, MIDDLE + 31),) * 2
    around = sum(np.roll(plain, step, axis) for axis in (0, 1) for step in (-1, 1))
    wanted = plain + 0.02 * (around - 4 * plain) / 2
    np.testing.assert_allclose(psf.kernel[window], wanted[window], atol=2e-6 * plain.max())
    assert psf.provenance["effects"] == ["dark_offset", "core_blur"]
    assert psf.provenance["effect_in_kernel"] == ["core_blur"]
    assert psf.kernel.sum() == pytest.approx(plain.sum(), rel=1e-12)


def test_stretched_scatter_is_in_the_kernel_along_its_direction() -> None:
    """To first order it is the true stretched PSF: p is ln(1 + stretch) along x."""
    stretch = 0.02
    psf = made(answered(effect("anisotropic_scatter"), values=(float(np.log1p(stretch)), 0.0)))
    values = found().corrected[0].solution.inversion.values
    at = ScatterTruth(values["b_px"], values["c"], values["total"], stretch=stretch, angle_deg=0.0)
    true = total_kernel(at, diffraction(), REACH_GRID_PX)
    plain = fitted_kernel()
    window = (slice(MIDDLE - 40, MIDDLE + 41),) * 2
    change, wanted = (psf.kernel - plain)[window], (true - plain)[window]
    assert np.vdot(change, wanted) / np.vdot(wanted, wanted) == pytest.approx(1, abs=0.1)
    assert change[40, 60] > 0 > change[60, 40]  # more along x, less along y


def test_a_ghost_is_in_the_kernel_at_its_place() -> None:
    ghost = next(one for one in EFFECTS if one.name == "ghost")
    assert ghost.held is not None
    from psfcore.gap.library.optics import _copy

    held = replace(ghost, changes=lambda view: _copy(2.0, 60, -30), held=None)
    kernel = made(answered(held, values=(0.03,))).kernel
    change = kernel - fitted_kernel()
    peak = np.unravel_index(int(np.argmax(change)), change.shape)
    assert (int(peak[0]), int(peak[1])) == (MIDDLE - 30, MIDDLE + 60)
    # The copy's light is taken from the rest of the kernel, whose sum stays the same.
    around = change[MIDDLE - 60 : MIDDLE, MIDDLE + 30 : MIDDLE + 90].sum()
    assert around == pytest.approx(0.03 * fitted_kernel().sum(), rel=0.4)


def test_an_effect_that_varies_over_the_field_is_taken_at_its_centre() -> None:
    kernel = made(answered(effect("field_dependent_scatter"), values=(0.5, 0.5, 0.5))).kernel
    assert np.abs(kernel - fitted_kernel()).max() < 1e-3 * fitted_kernel().max()


def test_without_an_answer_there_is_no_corrected_psf() -> None:
    with pytest.raises(DataError, match="got the verdict unknown") as caught:
        made(replace(found(), corrected=(), judgement=replace(found().judgement, verdict="unknown")))
    assert caught.value.code == "no-answer"
