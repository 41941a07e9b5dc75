"""The page of a report shows every number and image, and escapes every text."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from psfcore.drawing.page import with_error
from psfcore.psf import cumulative_curve
from psfcore.report.page import page_of
from psfcore.report.plot import beyond_of
from psfcore.report.report import report_json
from psfcore.scatter.samples import SCATTER
from psfcore.tables.make import TOTAL
from tests.html_page import check_stands_alone, read_page
from tests.psfcore.report.test_report import PROVENANCE, given, whole, whole_json


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
    html = page_of(whole(), PROVENANCE).html()
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


def test_the_page_of_a_given_psf_lists_what_it_does_not_show_and_why() -> None:
    report = given()
    assert report.given and not report.held_out and not report.fitted_to_these
    residuals = np.array([f.residual_pct / f.noise_pct for f in report.evaluation.frames])
    assert abs(residuals.mean()) < 4 / np.sqrt(residuals.size)
    html = page_of(report, PROVENANCE).html()
    check_stands_alone(html)
    text = next(t for t in read_page(html) if t.name == "body").text
    assert "Not shown: other shapes of scatter, because the PSF was given, and no fit was made." in text
    assert "Not shown: errors of the PSF's curve and profile" in text
    assert "fit" not in report_json(report, PROVENANCE)


def test_a_malicious_file_name_is_text() -> None:
    report = given()
    name = "</td><script>alert(1)</script>.fits"
    frames = tuple(
        dataclasses.replace(frame, file=name) if n == 0 else frame
        for n, frame in enumerate(report.transit.frames)
    )
    judged = tuple(dataclasses.replace(f, file=name) if f.index == 0 else f for f in report.evaluation.frames)
    changed = dataclasses.replace(
        report,
        transit=dataclasses.replace(report.transit, frames=frames, sha256={name: "0" * 64}),
        evaluation=dataclasses.replace(report.evaluation, frames=judged, left_out={name: name}),
    )
    html = page_of(changed, {"file": name}).html()
    check_stands_alone(html)
    assert [t.text for t in read_page(html) if t.name == "td"].count(name) == 4
