"""Cross-validation: bootstrap samples, and both schemes compared with a fit from the start."""

from __future__ import annotations

import dataclasses
import json
from functools import cache

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.scatter.inversion import invert
from psfcore.scatter.optics import Lanes, Optics
from psfcore.scatter.validation.bands import Bands, bands
from psfcore.scatter.validation.cross_validation import (
    FoldFit,
    bootstrap_samples,
    exact_fit,
    shared_fits,
    shared_step,
)
from psfcore.transit.blocks import folds
from tests.psfcore.small_transits import IMAGES, observed, sky, solved


@cache
def shared() -> tuple[FoldFit, ...]:
    return shared_fits(solved(), bootstrap_samples(IMAGES, runs=5))


@cache
def in_bands() -> Bands:
    return bands(shared(), solved().inversion.radii_px)


def test_a_sample_excludes_its_block_and_guard_and_keeps_the_sizes_of_blocks() -> None:
    parts = folds(IMAGES)
    for draw in bootstrap_samples(IMAGES, runs=3):
        fitted = set(parts[draw.fold].fitted)
        assert draw.held_out == parts[draw.fold].held_out
        assert {n for n, k in enumerate(draw.counts) if k} <= fitted and sum(draw.counts) == len(fitted)
    with pytest.raises(DataError, match="too-few-images"):
        bootstrap_samples(5)


def test_an_exact_fold_agrees_with_a_fit_from_the_start() -> None:
    """Started at the shared step, it converges to the result of `invert` with the same counts."""
    draw = bootstrap_samples(IMAGES, runs=1)[1]
    slow = invert(observed(sky()).transit, counts=draw.counts)
    found = exact_fit(solved(), draw)
    sigma = solved().inversion.curve_sigma
    apart = np.abs(np.array(found.curve_pct) - slow.inversion.curve_pct)
    assert (apart < np.maximum(0.1 * sigma, 0.03)).all()
    assert set(found.held_out_pct) == set(draw.held_out)


def test_folds_do_not_change_the_solution() -> None:
    before = [scene.copy() for scene in solved().sky.scenes]
    places = list(solved().sky.found)
    exact_fit(solved(), bootstrap_samples(IMAGES, runs=1)[0])
    assert all((a == b).all() for a, b in zip(before, solved().sky.scenes, strict=True))
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


@pytest.mark.parametrize("stage", ["images held out", "settling"])
def test_a_progress_callback_can_stop_a_fold(stage: str) -> None:
    class Stop(Exception):
        pass

    def progress(now: str, _step: int, _steps: int) -> None:
        if now == stage:
            raise Stop

    with pytest.raises(Stop):
        exact_fit(solved(), bootstrap_samples(IMAGES, runs=1)[1], progress=progress)


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


def test_with_all_images_once_the_step_is_zero() -> None:
    everything = dataclasses.replace(bootstrap_samples(IMAGES, runs=1)[0], counts=(1,) * IMAGES)
    moved = np.abs(shared_step(solved(), everything))
    assert (moved < 0.05 * np.sqrt(np.diag(solved().inversion.covariance))).all()


def test_an_empty_sample_is_refused() -> None:
    nothing = dataclasses.replace(bootstrap_samples(IMAGES, runs=1)[0], counts=(0,) * IMAGES)
    with pytest.raises(DataError, match=r"transit-says-too-little.*run 0, fold 0"):
        shared_fits(solved(), (nothing,))
    with pytest.raises(DataError, match="transit-says-too-little"):
        exact_fit(solved(), nothing)


def test_folds_go_to_json_and_back() -> None:
    said = json.loads(json.dumps([fit.to_json() for fit in shared()], allow_nan=False))
    assert tuple(FoldFit.from_json(fold) for fold in said) == shared()
    json.dumps(in_bands().to_json(), allow_nan=False)
    without = dataclasses.replace(shared()[0], shells=None)
    assert FoldFit.from_json(json.loads(json.dumps(without.to_json()))) == without
