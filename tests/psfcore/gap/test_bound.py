"""The bound of simulated causes: strong ones are named, weak ones not detected, withheld ones told by family."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from psfcore.gap import bound
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate, write_observation
from tests.psfcore.gap.linear_models import FEW
from tests.transit_files import TRUTH, diffraction


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Noise-free images without and with causes: an offset of each readout, and a band of light."""
    made = simulate(default_plan(9, 96, oversampling=1, brightness=4.0), TRUTH, diffraction(), seed=5)
    plan, rates, out = (
        made.plan,
        [made.sky.expected(n) for n in range(len(made.plan.shots))],
        tmp_path_factory.mktemp("expected"),
    )
    places = [plan.place(n) for n in range(len(plan.shots))]
    band = 20 * np.exp(-0.5 * ((np.arange(96) - 50) / 8) ** 2) * np.ones((96, 1))
    listed = []
    for name, cause, families, offset_dn, light in (
        ("without_effects", None, [], 0.0, 0.0),
        ("effect_0", "dark_offset", ["offset_place"], 4.0, 0.0),
        ("effect_1", "dark_offset", ["offset_place"], 0.02, 0.0),
        ("effect_2", None, ["light_place", "light_pointing"], 0.0, band),
    ):
        shots = zip(rates, plan.shots, strict=True)
        write_observation(
            out / name,
            plan,
            [(rate + light) * shot.exposure_s + offset_dn for rate, shot in shots],
            places,
            diffraction(),
        )
        listed.append({"folder": name, "name": cause, "families": families, "stage": "detector"})
    (out / "causes.json").write_text(json.dumps({"schema": "gap-causes/1", "causes": listed[1:]}))
    return out


def test_what_an_observer_knows_of_strong_weak_and_withheld_causes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bound, "LIBRARY", FEW)
    assert bound.main([str(folder), str(tmp_path / "bound.json")]) == 0
    found = json.loads((tmp_path / "bound.json").read_text())
    assert found["schema"] == "gap-bound/1"
    strong, weak, withheld = found["causes"]
    assert strong["noncentrality"] > 100 and strong["detected"] == 1.0 and strong["name"] > 0.9
    assert weak["noncentrality"] == pytest.approx((0.02 / 4.0) ** 2 * strong["noncentrality"], rel=0.1)
    assert weak["detected"] <= 0.05
    assert withheld["detected"] > 0.9 and withheld["family"] > 0.8
    for one in (strong, weak, withheld):
        assert one["name"] <= one["family"] <= one["stage"] <= one["detected"]


def test_what_is_wrong_is_said_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bound.main([str(tmp_path)]) == 2
    (tmp_path / "causes.json").write_text('{"causes": []}')
    assert bound.main([str(tmp_path), str(tmp_path / "b.json")]) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and "transit.json" in said[1]
    assert not (tmp_path / "b.json").exists()
