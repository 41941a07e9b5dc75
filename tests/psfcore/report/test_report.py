"""A report evaluates held-out images, contains the numbers of the fit, and lists what it does not show; and its
page."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from psfcore.drawing.numbers import with_error
from psfcore.errors import DataError
from psfcore.evaluation.evaluation import evaluate
from psfcore.evaluation.shapes import held_out_kernels
from psfcore.psf import Psf, crop_or_pad, cumulative_curve
from psfcore.report import report as report_module
from psfcore.report.page import report_page
from psfcore.report.plots import beyond_of
from psfcore.report.report import PsfReport, make_report, report_json
from psfcore.scatter.fit import TransitFit
from psfcore.scatter.reconstruction import Progress
from psfcore.scatter.total_psf import SCATTER
from psfcore.scatter.validation.cross_validation import bootstrap_samples
from psfcore.simulate.scatter_truth import total_kernel
from psfcore.tables.make import TOTAL, tables_of
from psfcore.transit.prepare import FrameCounts, Prepared
from psfcore.transit.transit import Transit
from tests.blank_figures import blank_figures
from tests.html_page import check_stands_alone, read_page
from tests.psfcore import small_transits
from tests.psfcore.conftest import make_psf
from tests.psfcore.small_transits import DIFFRACTION, fitted, observed, sky

PROVENANCE = {"software_version": "1.2.3", "libraries": {"numpy": "9.9"}, "algorithm_version": 1}


@contextmanager
def quick() -> Iterator[None]:
    """A cross-validation of 3 runs instead of 10, and tables of 512 px."""

    def small_tables(psf: Psf, **options: Any) -> dict[str, Any]:
        kernel, *parts = (crop_or_pad(part, 512) for part in (psf.kernel, *psf.components.values()))
        components = dict(zip(psf.components, parts, strict=True))
        return tables_of(dataclasses.replace(psf, kernel=kernel, components=components), **options)

    with (
        patch.object(report_module, "tables_of", small_tables),
        patch.object(report_module, "bootstrap_samples", partial(bootstrap_samples, runs=3)),
    ):
        yield


def untouched(transit: Transit) -> Prepared:
    return Prepared(tuple(FrameCounts(frame.file) for frame in transit.frames))


@cache
def progress_of_whole() -> tuple[PsfReport, list[tuple[str, int, int]]]:
    """The report on twelve small images with the fit that many tests use, and its progress."""
    steps: list[tuple[str, int, int]] = []
    transit = observed(sky()).transit

    def fit(*_: Any, progress: Progress, **__: Any) -> TransitFit:
        progress("fit", 0, 2)
        return fitted()

    with quick(), patch.object(report_module, "fit_transit", fit):
        made = make_report(transit, untouched(transit), seed=5, progress=lambda *step: steps.append(step))
    return made, steps


def whole() -> PsfReport:
    return progress_of_whole()[0]


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


def test_each_image_is_evaluated_with_the_psf_of_the_fold_that_holds_it_out() -> None:
    report = whole()
    assert report.fit is not None and report.held_out
    by_hand = evaluate(report.transit, held_out_kernels(report.fit.solution), seed=5)
    want, got = ({f.file: f.residual_pct for f in of.frames} for of in (by_hand, report.evaluation))
    assert got == pytest.approx(want, abs=1e-6)
    within = evaluate(report.transit, lambda _n: report.fit.kernel, seed=5)  # type: ignore[union-attr]
    assert any(abs(got[f.file] - f.residual_pct) > 1e-3 for f in within.frames), "not held out"


def test_the_json_holds_the_numbers_and_progress_covers_all_stages() -> None:
    found = whole_json()
    assert found["schema"] == "psf-report/1" and found["sentence"] == whole().sentence
    assert [o["offset_dn"] for o in found["evaluation"]["dark_offsets"]["offsets"]] == [-5.0, -3.0, 3.0, 5.0]
    assert found["evaluation"]["held_out"] is True and found["not_shown"] == []
    assert len(found["cross_validation"]["totals"]) == found["cross_validation"]["fits"] == 12
    assert {s["name"] for s in found["fit"]["shapes"]} >= {"stretched", "core"}
    assert found["inputs"]["noise"]["photon_gain_dn"] > 0 and found["seed"] == 5
    shares = [step / steps for _, step, steps in progress_of_whole()[1]]
    assert len(shares) > 50 and shares[0] < 0.1 and 0.8 < shares[-1] <= 1
    assert all(later >= earlier for earlier, later in itertools.pairwise(shares))


def test_a_given_psf_fitted_to_these_images_is_not_tested_independently() -> None:
    transit = dataclasses.replace(observed(sky()).transit, sha256={"000.fits": "ab" * 32})
    few = dataclasses.replace(transit, frames=transit.frames[:4])
    # Broken into lines, as in a FITS header.
    history = ["psf_id: 1", f"inputs_sha256: {{'000.fits': '{'ab' * 16}", f"{'ab' * 16}'}}"]
    kernel = total_kernel(small_transits.SCATTER, DIFFRACTION, 256)
    psf = make_psf(kernel, provenance={"history": history})
    report = make_report(few, untouched(few), psf=psf, seed=2)
    assert report.fitted_to_these and "not an independent test" in report.sentence


@pytest.mark.slow
def test_too_few_images_for_folds_are_evaluated_with_their_own_fit_and_the_page_says_so() -> None:
    transit = observed(sky()).transit
    few = dataclasses.replace(transit, frames=transit.frames[:4] + transit.frames[6:7])
    with quick():
        report = make_report(few, untouched(few), dark_offsets=False)
    assert not report.held_out and report.cross is None
    said = {missing.what: missing.why for missing in report.missing}
    assert "at least 6 images" in said["a test on held-out images"]
    assert said["the effect of wrong dark levels"] == "it was not requested"
    html = report_page(report, PROVENANCE).html
    check_stands_alone(html)
    assert "this is not an independent test" in html


def test_a_psf_of_another_scale_is_refused() -> None:
    transit = dataclasses.replace(observed(sky()).transit, plate_scale_arcsec=0.5)
    psf = make_psf(DIFFRACTION, plate_scale_arcsec=1.0)
    with pytest.raises(DataError, match=r"1 arcsec/px; got 0\.5") as caught:
        make_report(transit, untouched(transit), psf=psf)
    assert caught.value.code == "plate-scale-mismatch"


# --- the page ---------------------------------------------------------------------------------------------


def test_the_curve_on_the_page_is_that_of_the_psf() -> None:
    report = whole()
    for name, kernel in ((TOTAL, report.psf.kernel), (SCATTER, report.psf.components[SCATTER])):
        radii, beyond, _ = beyond_of(report.tables, name)
        some = np.searchsorted(radii, [0.5, 2.0, 10.0, 100.0])
        want = cumulative_curve(kernel, radii[some])
        assert beyond[some] == pytest.approx(want, abs=1e-4)
    assert report.fit is not None
    _, _, sigma = beyond_of(report.tables, TOTAL)
    at_half = report.fit.curve.sigma[list(report.fit.curve.radii_px).index(0.5)]
    assert sigma[0] == pytest.approx(at_half, rel=0.02)


def test_the_page_shows_every_part_and_every_image() -> None:
    html = report_page(whole(), PROVENANCE).html
    check_stands_alone(html)
    tags = read_page(html)
    text = next(t for t in tags if t.name == "body").text
    for frame in whole().evaluation.frames:
        assert any(t.name == "td" and t.text == frame.file for t in tags)
    assert len([t for t in tags if t.name == "img"]) == 9
    for name, parameter in whole_json()["fit"]["parameters"].items():
        shown = next(t for t in tags if t.name == "dt" and t.text.startswith(name))
        row = shown.within[-1].text.replace("\N{NO-BREAK SPACE}", " ")
        assert with_error(parameter["value"], parameter["sigma"]) in row
    assert "1.2.3" in text and "9.9" in text and "-5" in text
    assert all(limit[1:] in text for limit in whole_json()["fit"]["limits"])


def test_the_report_page_a_given_psf_lists_what_it_does_not_show_and_why() -> None:
    report = given()
    assert report.given and not report.held_out and not report.fitted_to_these
    residuals = np.array([f.residual_pct / f.noise_pct for f in report.evaluation.frames])
    assert abs(residuals.mean()) < 4 / np.sqrt(residuals.size)
    with blank_figures():
        html = report_page(report, PROVENANCE).html
    check_stands_alone(html)
    text = next(t for t in read_page(html) if t.name == "body").text
    assert "Not shown: other shapes of scatter" in text
    assert "Not shown: errors of the PSF's curve and profile" in text
    assert "fit" not in report_json(report, PROVENANCE)


def test_a_malicious_file_name_is_text() -> None:
    report, name = given(), "</td><script>alert(1)</script>.fits"
    first, *others = report.evaluation.frames
    evaluation = dataclasses.replace(
        report.evaluation, frames=(dataclasses.replace(first, file=name), *others), left_out={name: name}
    )
    frames = (dataclasses.replace(report.transit.frames[0], file=name), *report.transit.frames[1:])
    transit = dataclasses.replace(report.transit, frames=frames, sha256={name: "0" * 64})
    with blank_figures():
        html = report_page(
            dataclasses.replace(report, transit=transit, evaluation=evaluation), {"file": name}
        ).html
    check_stands_alone(html)
    assert [t.text for t in read_page(html) if t.name == "td"].count(name) == 4
