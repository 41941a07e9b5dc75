"""The program of the ideal observer: it reads the images that a case of the blind set keeps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from psfcore.blind.cases import draw_case
from psfcore.blind.make_case import make, write_expected
from psfcore.gap.ideal_observer import main


def test_it_measures_what_the_maker_of_a_case_measured(tmp_path: Path) -> None:
    case = draw_case(3, 0, 128, 9, only=("intensity_gradient",), left_pct=(5.0,), built_diffraction=False)
    made = make(case)
    write_expected(made, case.plan, tmp_path / "expected")
    assert main([str(tmp_path / "expected"), str(tmp_path / "ideal.json")]) == 0
    found = json.loads((tmp_path / "ideal.json").read_text())
    assert found["left_after_refit_pct"] == pytest.approx(made.truth["left_after_refit_pct"], rel=0.15)
    left = {tuple(one["effects"]): one["chi2"] for one in found["hypotheses"]}
    assert left[()] == found["noncentrality"] > 1
    assert left[("intensity_gradient",)] < 0.2 * left[()]


def test_bad_arguments_and_folders_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 2
    assert "expected two arguments" in capsys.readouterr().err
    assert main([str(tmp_path), str(tmp_path / "ideal.json")]) == 1
    assert "no-manifest" in capsys.readouterr().err
    assert not (tmp_path / "ideal.json").exists()
