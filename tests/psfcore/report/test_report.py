"""A report evaluates held-out images, contains the numbers of the fit, and lists what it does not show."""

from __future__ import annotations

import dataclasses
import itertools
import json
from functools import cache, partial
from typing import Any
from unittest.mock import patch

import pytest

from psfcore.errors import DataError
from psfcore.report.page import page_of
from psfcore.report.report import PsfReport, make_report, report_json
from psfcore.scatter import fit
from psfcore.scatter.as_published.equations import free_fit
from psfcore.scatter.validation.cross_validation import FoldSample, shared_step
from psfcore.simulate.scatter_truth import total_kernel
from psfcore.transit.blocks import folds
from psfcore.transit.prepare import FrameCounts, Prepared
from psfcore.transit.transit import Transit
from tests.html_page import check_stands_alone
from tests.psfcore import small_transits
from tests.psfcore.conftest import make_psf
from tests.psfcore.small_transits import DIFFRACTION, TRUE_VALUES, observed, sky

PROVENANCE = {"software_version": "1.2.3", "libraries": {"numpy": "9.9"}, "algorithm_version": 1}


QUICK = patch.object(fit, "free_fit", partial(free_fit, subsets=20))  # quicker than 100


def untouched(transit: Transit) -> Prepared:
    return Prepared(tuple(FrameCounts(frame.file) for frame in transit.frames))


@cache
def told() -> list[tuple[str, int, int]]:
    return []


@cache
def whole() -> PsfReport:
    """The report on twelve small images. Its progress is in told()."""
    transit = observed(sky()).transit
    with QUICK:
        return make_report(transit, untouched(transit), seed=5, progress=lambda *step: told().append(step))


@cache
def whole_json() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(report_json(whole(), PROVENANCE), allow_nan=False))
    return found


@cache
def given() -> PsfReport:
    """The report on the true PSF, as if it came from a file."""
    transit = dataclasses.replace(observed(sky()).transit, sha256={"000.fits": "ab" * 32})
    psf = make_psf(total_kernel(small_transits.SCATTER, DIFFRACTION, 256), name="true")
    return make_report(transit, untouched(transit), psf=psf)


@pytest.mark.slow
def test_the_parameters_are_the_truth_within_their_errors() -> None:
    for name, parameter in whole_json()["fit"]["parameters"].items():
        assert abs(parameter["value"] - TRUE_VALUES[name]) < 4 * parameter["sigma"], name


def test_each_image_is_evaluated_with_the_psf_of_the_fold_that_holds_it_out() -> None:
    """By hand for one fold: the step of its fitted images, and the light that its PSF scatters into the discs."""
    from psfcore.evaluation.evaluation import evaluate

    report = whole()
    assert report.held_out and report.fit is not None
    solution, images = report.fit.solution, len(report.transit.frames)
    fold = folds(images)[1]
    counts = tuple(int(n in fold.fitted) for n in range(images))
    step = shared_step(solution, FoldSample(0, 1, counts, fold.held_out))
    kernel = solution.total.kernel(solution.inversion.coordinates + step)
    by_hand = evaluate(report.transit, lambda _n: kernel, seed=5)
    want = {f.file: f.residual_pct for f in by_hand.frames if f.index in fold.held_out}
    got = {f.file: f.residual_pct for f in report.evaluation.frames}
    assert want and all(got[file] == pytest.approx(residual, abs=1e-6) for file, residual in want.items())
    within = evaluate(report.transit, lambda _n: report.fit.kernel, seed=5)  # type: ignore[union-attr]
    assert any(abs(got[f.file] - f.residual_pct) > 1e-3 for f in within.frames), "not held out"


def test_progress_covers_all_stages_and_never_decreases() -> None:
    whole()
    shares = [step / steps for _, step, steps in told()]
    assert len(shares) > 50 and shares[0] < 0.1 and 0.8 < shares[-1] <= 1
    assert all(later >= earlier for earlier, later in itertools.pairwise(shares))


def test_the_json_holds_the_numbers_of_the_page() -> None:
    found = whole_json()
    assert found["schema"] == "psf-report/1" and found["sentence"] == whole().sentence
    assert [o["offset_dn"] for o in found["evaluation"]["dark_offsets"]["offsets"]] == [-5.0, -3.0, 3.0, 5.0]
    assert found["evaluation"]["held_out"] is True and found["not_shown"] == []
    assert len(found["cross_validation"]["totals"]) == found["cross_validation"]["fits"] == 40
    assert {s["name"] for s in found["fit"]["shapes"]} >= {"stretched", "core"}
    assert found["inputs"]["noise"]["photon_gain_dn"] > 0 and found["seed"] == 5


def test_a_given_psf_fitted_to_these_images_is_not_tested_independently() -> None:
    transit = dataclasses.replace(observed(sky()).transit, sha256={"000.fits": "ab" * 32})
    kernel = total_kernel(small_transits.SCATTER, DIFFRACTION, 256)
    history = [
        "psf_id: 1",
        f"inputs_sha256: {{'000.fits': '{'ab' * 16}",
        f"{'ab' * 16}'}}",
    ]  # broken into lines, as in a FITS header
    report = make_report(
        transit, untouched(transit), psf=make_psf(kernel, provenance={"history": history}), seed=2
    )
    assert report.fitted_to_these and "not an independent test" in report.sentence


@pytest.mark.slow
def test_too_few_images_for_folds_are_evaluated_with_their_own_fit_and_the_page_says_so() -> None:
    transit = observed(sky()).transit
    few = dataclasses.replace(transit, frames=transit.frames[:4] + transit.frames[6:7])
    with QUICK:
        report = make_report(few, untouched(few), dark_offsets=False)
    assert not report.held_out and report.cross is None
    said = {missing.what: missing.why for missing in report.missing}
    assert "at least 6 images" in said["a test on held-out images"]
    assert said["the effect of wrong dark levels"] == "it was not requested"
    html = page_of(report, PROVENANCE).html()
    check_stands_alone(html)
    assert "this is not an independent test" in html


def test_a_psf_of_another_scale_is_refused() -> None:
    transit = dataclasses.replace(observed(sky()).transit, plate_scale_arcsec=0.5)
    psf = make_psf(DIFFRACTION, plate_scale_arcsec=1.0)
    with pytest.raises(
        DataError, match=r"expected images with the plate scale of PSF .* 1 arcsec/px; got 0.5"
    ) as caught:
        make_report(transit, untouched(transit), psf=psf)
    assert caught.value.code == "plate-scale-mismatch"
