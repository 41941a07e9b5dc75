"""Cross-validation: bootstrap samples, both schemes compared with a fit from the start, and bands over the fits."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.scatter.inversion import invert
from psfcore.scatter.plots import cross_validation_png
from psfcore.scatter.total_psf import Lanes, Optics
from psfcore.scatter.validation.cross_validation import (
    Bands,
    Excess,
    FoldFit,
    FoldShells,
    bands,
    bootstrap_samples,
    exact_fit,
    shared_fits,
    shared_step,
    shell_bands,
)
from psfcore.scatter.validation.free_shells import shells
from psfcore.transit.transit import folds
from tests.psfcore.small_transits import IMAGES, observed, sky, solved


@cache
def shared() -> tuple[FoldFit, ...]:
    return shared_fits(solved(), bootstrap_samples(IMAGES, runs=5))


@cache
def in_bands() -> Bands:
    return bands(shared(), solved().inversion.radii_px)


def test_a_sample_excludes_its_block_and_guard_and_an_empty_one_is_refused() -> None:
    parts = folds(IMAGES)
    for draw in bootstrap_samples(IMAGES, runs=3):
        fitted = set(parts[draw.fold].fitted)
        assert draw.held_out == parts[draw.fold].held_out
        assert {n for n, k in enumerate(draw.counts) if k} <= fitted and sum(draw.counts) == len(fitted)
    with pytest.raises(DataError, match="too-few-images"):
        bootstrap_samples(5)
    everything = dataclasses.replace(bootstrap_samples(IMAGES, runs=1)[0], counts=(1,) * IMAGES)
    moved = np.abs(shared_step(solved(), everything))
    assert (moved < 0.05 * np.sqrt(np.diag(solved().inversion.covariance))).all()
    nothing = dataclasses.replace(bootstrap_samples(IMAGES, runs=1)[0], counts=(0,) * IMAGES)
    with pytest.raises(DataError, match=r"transit-says-too-little.*run 0, fold 0"):
        shared_fits(solved(), (nothing,))
    with pytest.raises(DataError, match="transit-says-too-little"):
        exact_fit(solved(), nothing)


def test_an_exact_fold_agrees_with_a_fit_from_the_start() -> None:
    """Started at the shared step, it converges to the result of `invert` with the same counts, and keeps the
    solution."""
    draw = bootstrap_samples(IMAGES, runs=1)[1]
    scenes, places = [scene.copy() for scene in solved().sky.scenes], list(solved().sky.found)
    slow = invert(observed(sky()).transit, counts=draw.counts)
    found = exact_fit(solved(), draw)
    sigma = solved().inversion.curve_sigma
    apart = np.abs(np.array(found.curve_pct) - slow.inversion.curve_pct)
    assert (apart < np.maximum(0.1 * sigma, 0.03)).all()
    assert set(found.held_out_pct) == set(draw.held_out)
    assert all((a == b).all() for a, b in zip(scenes, solved().sky.scenes, strict=True))
    assert places == solved().sky.found


def test_a_fold_reports_progress_before_every_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """So a worker can renew its lease between images, and notices a cancellation."""
    since_report, most = 0, 0
    invert = Optics.invert

    def counted(optics: Optics, observed: Lanes, start: Lanes | None = None, **options: int) -> Lanes:
        nonlocal since_report, most
        since_report += 1
        most = max(most, since_report)
        return invert(optics, observed, start, **options)

    stages: dict[str, list[int]] = {}

    def progress(stage: str, step: int, steps: int) -> None:
        nonlocal since_report
        since_report = 0
        stages.setdefault(stage, []).append(step)
        assert 0 <= step < steps

    solution = solved()  # before the patch: it inverts every image too
    monkeypatch.setattr(Optics, "invert", counted)
    draw = bootstrap_samples(IMAGES, runs=1)[1]
    exact_fit(solution, draw, progress=progress)
    assert most == 1
    assert stages["images held out"] == list(range(len(draw.held_out)))
    assert stages["settling"] == stages["free shells"] != []


def test_both_schemes_agree() -> None:
    wanted = bootstrap_samples(IMAGES, runs=1)
    quick = shared_fits(solved(), wanted)
    assert quick == shared()[: len(wanted)]
    exactly = tuple(exact_fit(solved(), draw) for draw in wanted)
    half_width = (in_bands().curve_pct[3] - in_bands().curve_pct[1]) / 2
    apart = np.subtract([f.curve_pct for f in exactly], [f.curve_pct for f in quick]) / half_width
    assert np.sqrt((apart**2).mean()) < 0.35
    one, other = (bands(fits, solved().inversion.radii_px).shells for fits in (exactly, quick))
    assert one is not None and other is not None
    assert one.near_centre.points == pytest.approx(
        other.near_centre.points, abs=0.5 * other.near_centre.sigma
    )


def test_folds_go_to_json_and_back() -> None:
    said = json.loads(json.dumps([fit.to_json() for fit in shared()], allow_nan=False))
    assert tuple(FoldFit.from_json(fold) for fold in said) == shared()
    json.dumps(in_bands().to_json(), allow_nan=False)
    without = dataclasses.replace(shared()[0], shells=None)
    assert FoldFit.from_json(json.loads(json.dumps(without.to_json()))) == without


# --- bands ------------------------------------------------------------------------------------------------


def test_free_fit_and_formula_agree_if_the_formula_is_true() -> None:
    found = in_bands().shells
    assert found is not None
    assert not found.largest.parts
    assert abs(found.near_centre.points) < 3 * found.near_centre.sigma
    assert found.near_centre.within_px == pytest.approx(3.1)
    assert (found.free_weight >= 0).all() and (np.diff(found.free_weight, axis=0) >= 0).all()
    total = found.law_beyond_pct[2, 0] / 100
    assert total == pytest.approx(np.median([f.values["total"] for f in shared()]), rel=1e-6)


def made(extra: float, sigma: float, seed: int) -> FoldShells:
    """A sample whose free fit has `extra` more light in its fourth shell, with a small random difference."""
    law = np.full(shells().size, 0.4 / shells().size)
    free = law.copy()
    free[3] += extra + 1e-4 * np.random.default_rng(seed).standard_normal()
    return FoldShells(tuple(free), tuple(law), (sigma,) * shells().size)


def test_an_excess_has_the_larger_of_its_two_errors() -> None:
    found = shell_bands([made(0.05, 0.01, seed) for seed in range(200)])
    near = found.near_centre
    assert near.points == pytest.approx(5.0, abs=0.01) and near.sigma == pytest.approx(1.0)
    assert near.of_formula_pct == pytest.approx(100 * 0.05 / (6 * 0.4 / shells().size), rel=0.01)
    assert found.largest.parts and near.parts
    assert not Excess(3.1, points=2.9, sigma=1.0, of_formula_pct=10.0).parts
    by_draws = shell_bands([made(0.05, 1e-9, seed) for seed in range(200)])
    assert by_draws.near_centre.sigma == pytest.approx(0.01, rel=0.2)
    beyond = by_draws.free_beyond_pct[2] - by_draws.law_beyond_pct[2]
    np.testing.assert_allclose(beyond[:4], 5.0, atol=0.02)
    np.testing.assert_allclose(beyond[4:], 0.0, atol=1e-9)


def test_a_shape_that_is_not_isotropic_has_no_shells() -> None:
    """The parameters of the stretch are those of the power law here: only the kind of the shape matters."""
    shape = dataclasses.replace(solved().inversion.shape, radial=None)
    stretched = dataclasses.replace(solved(), inversion=dataclasses.replace(solved().inversion, shape=shape))
    fits = shared_fits(stretched, bootstrap_samples(IMAGES, runs=1))
    assert {fit.shells for fit in fits} == {None}
    found = bands(fits, solved().inversion.radii_px)
    assert found.shells is None and found.to_json()["shells"] is None


def test_the_plot_has_a_second_row_with_a_free_fit(tmp_path: Path) -> None:
    heights = []
    for fits in (shared(), tuple(dataclasses.replace(fit, shells=None) for fit in shared())):
        path = tmp_path / "p.png"
        cross_validation_png(bands(fits, solved().inversion.radii_px), fits, [1] * IMAGES, path)
        heights.append(int.from_bytes(path.read_bytes()[20:24], "big"))
    assert heights[0] == 2 * heights[1]
