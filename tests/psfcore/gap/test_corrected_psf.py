"""The corrected PSF: its kernel contains effects of the optics but not of the detector, and its file its origin."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.gap.corrected_psf import corrected_psf
from psfcore.gap.diagnose import Diagnosis, start_of
from psfcore.gap.effect import Change, Effect
from psfcore.gap.evidence.search import displaced
from psfcore.gap.library.optics import DIRECTIONS, blur_as
from psfcore.gap.verdict.correction import Corrected
from psfcore.psf import Psf, cumulative_curve
from psfcore.scatter.shapes import SHAPES
from psfcore.scatter.total_psf import TotalPsf
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from tests.psfcore.gap.small_gaps import REACH_PX, effect, found, small_reach
from tests.transit_files import TRUTH, diffraction

MIDDLE = REACH_PX // 2
PARENTS = {"transit": "a" * 64, "report": "b" * 64}


@pytest.fixture(autouse=True)
def _with_small_reach() -> Iterator[None]:
    found()  # with the usual reach
    with small_reach():
        yield


def refit() -> Corrected:
    added = found().corrected
    assert added is not None
    return added


def corrected(*effects: Effect, values: tuple[float, ...]) -> Psf:
    """The corrected PSF as if these effects, with these values, had been added to the model."""
    names = [f"{one.name}.{p.name}" for one in effects for p in one.parameters]
    numbers = {name: (value, 0.1, "") for name, value in zip(names, values, strict=True)}
    added = refit()
    # The columns are used only for errors; effects that are not in the catalogue have none.
    columns = {one.name: () for one in effects} | added.model.evidence.columns
    model = replace(added.model, evidence=replace(added.model.evidence, columns=columns))
    added = replace(added, effects=effects, values=numbers, model=model)
    return psf_of(replace(found(), corrected=added))


def psf_of(diagnosis: Diagnosis) -> Psf:
    return corrected_psf(diagnosis, "corrected", "1", {"parents": PARENTS})


@cache
def of_the_answer() -> Psf:
    return psf_of(found())


@cache
def fitted_kernel() -> np.ndarray:
    """The PSF fitted together with the effect, computed without the effect."""
    inversion = refit().solution.inversion
    total = TotalPsf(diffraction(), inversion.shape, (REACH_PX, REACH_PX))
    return np.maximum(total.kernel(inversion.coordinates), 0.0)


def test_a_detector_effect_is_not_in_the_psf_and_the_psf_is_closer_to_the_truth() -> None:
    np.testing.assert_allclose(of_the_answer().kernel, fitted_kernel(), atol=1e-15)
    radii = np.array([5.0, 10.0, 20.0])
    truth = cumulative_curve(total_kernel(TRUTH, diffraction(), REACH_PX), radii)
    bent = found().solution.inversion
    before = TotalPsf(diffraction(), bent.shape, (REACH_PX, REACH_PX)).kernel(bent.coordinates)
    off_before, off_after = (
        np.abs(cumulative_curve(kernel, radii) - truth) for kernel in (before, of_the_answer().kernel)
    )
    assert (off_after < off_before).all()


def test_its_file_records_its_origin_and_the_gap_before_and_after(tmp_path: Path) -> None:
    psf, added = of_the_answer(), refit()
    write_psf(tmp_path / "psf.fits", psf)
    back = read_psf(tmp_path / "psf.fits", FitsLimits(max_pixels=2**23))
    history = "".join(back.provenance["history"]).replace(" ", "")
    for said in (*PARENTS.values(), "effects:['dark_offset']", "effect_in_kernel:[]", "'unit':'DN'"):
        assert said in history
    assert "gap_before_pct" in history and "gap_after_pct" in history
    assert set(back.components) == {"DIFFRACTION", "SCATTER"} and back.status == "draft"
    shape, start = start_of(back)
    assert shape is SHAPES["softened-power-law"]
    assert start == pytest.approx(added.solution.inversion.coordinates)
    told = psf.provenance
    assert (told["gap_before_pct"], told["gap_after_pct"]) == (found().rms.to_json(), found().after.to_json())
    value, sigma, unit = added.values["offset"]
    assert told["effect_parameters"] == {"offset": {"value": value, "sigma": sigma, "unit": unit}}
    assert told["inputs_sha256"]["000.fits"] == "ab" * 32
    # Its errors include those of the effect.
    assert psf.fitted is not None
    covariance, alone = np.array(psf.fitted.covariance), added.model.base.covariance
    assert (np.diag(covariance) > np.diag(alone)).all()
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_a_core_blur_is_in_the_kernel_with_its_own_value() -> None:
    """The change is half the Laplacian of the kernel per unit of variance; the dark offset is not in the kernel."""
    narrow = replace(effect("core_blur"), changes=lambda view: blur_as(view, 0.003, DIRECTIONS[0]), held=None)
    psf, plain = corrected(effect("dark_offset"), narrow, values=(5.0, 0.02)), fitted_kernel()
    window = (slice(MIDDLE - 30, MIDDLE + 31),) * 2
    around = sum(np.roll(plain, step, axis) for axis in (0, 1) for step in (-1, 1))
    blurred = plain + 0.02 * (around - 4 * plain) / 2
    np.testing.assert_allclose(psf.kernel[window], blurred[window], atol=2e-6 * plain.max())
    assert psf.provenance["effects"] == ["dark_offset", "core_blur"]
    assert psf.provenance["effect_in_kernel"] == ["core_blur"]
    assert psf.kernel.sum() == pytest.approx(plain.sum(), rel=1e-12)


def test_effects_of_the_optics_are_in_the_kernel_at_their_place() -> None:
    """To first order it is the true stretched PSF: p is ln(1 + stretch) along x."""
    stretch, plain = 0.02, fitted_kernel()
    psf = corrected(effect("anisotropic_scatter"), values=(float(np.log1p(stretch)), 0.0))
    values = refit().solution.inversion.values
    at = ScatterTruth(values["b_px"], values["c"], values["total"], stretch=stretch, angle_deg=0.0)
    window = (slice(MIDDLE - 40, MIDDLE + 41),) * 2
    change = (psf.kernel - plain)[window]
    true = (total_kernel(at, diffraction(), REACH_PX) - plain)[window]
    assert np.vdot(change, true) / np.vdot(true, true) == pytest.approx(1, abs=0.1)
    assert change[40, 60] > 0 > change[60, 40]  # more along x, less along y
    copy = Change(lambda n, images: displaced(gaussian_filter(images[n], 2.0), 60, -30), unocculted=False)
    ghost = effect("ghost")
    held = replace(ghost, parameters=ghost.parameters[:1], changes=lambda view: [copy], held=None)
    change = corrected(held, values=(0.03,)).kernel - fitted_kernel()
    row, column = np.unravel_index(int(np.argmax(change)), change.shape)
    assert (row, column) == (MIDDLE - 30, MIDDLE + 60)
    # The copy's light is taken from the rest of the kernel, whose sum stays the same.
    around = change[MIDDLE - 60 : MIDDLE, MIDDLE + 30 : MIDDLE + 90].sum()
    assert around == pytest.approx(0.03 * fitted_kernel().sum(), rel=0.4)
    kernel = corrected(effect("field_dependent_scatter"), values=(0.5, 0.5, 0.5)).kernel
    assert np.abs(kernel - fitted_kernel()).max() < 1e-3 * fitted_kernel().max()


def test_without_an_answer_there_is_no_corrected_psf() -> None:
    with pytest.raises(DataError, match="got the verdict unknown") as refusal:
        psf_of(replace(found(), corrected=None, answer=replace(found().answer, verdict="unknown")))
    assert refusal.value.code == "no-answer"
