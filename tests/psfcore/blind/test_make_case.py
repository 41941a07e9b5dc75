"""Cases of the blind set: drawn in equal shares, readable as transits, their truth kept apart."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.blind.case_set import BlindSet, alone_in, make_set
from psfcore.blind.cases import (
    CLEAN,
    FOREIGN,
    MIXED,
    PAIR,
    SINGLE,
    Case,
    Plane,
    SetPlan,
    case_scenes,
    draw_case,
)
from psfcore.blind.effects.registry import EFFECTS, KNOWN, WITHHELD
from psfcore.blind.make_case import make
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.transit.folder import read_transit

SIZE_PX, IMAGES = 96, 9
LIMITS = FitsLimits(max_pixels=SIZE_PX**2)
TWO = SetPlan(2, 3, SIZE_PX, IMAGES, only=("intensity_gradient", "saturation_fill"), built_diffraction=False)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> BlindSet:
    return make_set(tmp_path_factory.mktemp("blind") / "set", TWO)[0]


def drawn(seed: int, number: int = 0, **changes: Any) -> Case:
    """A case of a small set. changes: further fields of its plan."""
    return draw_case(SetPlan(1, seed, SIZE_PX, IMAGES, **{"built_diffraction": False} | changes), number)


def test_kinds_have_their_shares_and_effects_occur_in_turn() -> None:
    cases = [drawn(1, n) for n in range(72)]
    assert Counter(case.kind for case in cases) == {CLEAN: 18, SINGLE: 24, PAIR: 9, FOREIGN: 12, MIXED: 9}
    names = Counter(case.effects[0].kind.name for case in cases if case.kind == SINGLE)
    assert set(names) == set(KNOWN)
    assert max(names.values()) - min(names.values()) <= 1
    assert all(len({effect.kind.name for effect in case.effects}) == 2 for case in cases if case.kind == PAIR)
    # A case is the same for its seed and number.
    assert drawn(1, 5) == cases[5] != drawn(2, 5)
    with pytest.raises(DataError, match="unknown-effect"):
        drawn(1, only=("gremlins",))
    # Each target is used in turn for every effect.
    only, left_pct = ("ghost", "wide_halo"), (2.0, 4.0, 8.0)
    cases = [drawn(1, n, only=only, left_pct=left_pct) for n in range(7)]
    targets = [(case.effects[0].kind.name, *case.target_pct) for case in cases]
    assert targets == [(name, pct) for pct in (*left_pct, 2.0) for name in only][:7]


def test_withheld_effects_of_the_tests_occur_in_three_strengths_and_others_in_the_calibration() -> None:
    blocks = range(11 * 24)
    cases = {group: [drawn(3, n, withheld=group) for n in blocks] for group in WITHHELD}
    seen: dict[str, set[int]] = {name: set() for name in WITHHELD["test"]}
    for case in cases["test"]:
        if case.kind == FOREIGN:
            (target_pct,) = case.target_pct
            assert target_pct is not None
            seen[case.effects[0].kind.name].add(round(math.log(target_pct, 3)))
    assert all(powers == {0, 1, 2} for powers in seen.values()), "about 1, 3 and 10 percent"
    for group, some in cases.items():
        withheld = [case.effects[-1].kind for case in some if case.kind in (FOREIGN, MIXED)]
        assert {kind.name for kind in withheld} == set(WITHHELD[group])
        mixed = [case for case in some if case.kind == MIXED]
        assert all([e.kind.name in KNOWN for e in case.effects] == [True, False] for case in mixed)
        assert all(3 <= pct <= 15 for case in mixed for pct in case.target_pct if pct is not None)


def test_strong_effects_occur_alone_in_pairs_and_beside_a_changing_sun() -> None:
    cases = [drawn(2, n) for n in range(17 * 24)]
    pairs = [case for case in cases if case.kind == PAIR]
    beside_sun = [case for case in pairs[1::3] if case.effects[1].kind.name == "scene_evolution"]
    assert len(beside_sun) == len(pairs[1::3]) == 17
    # Every other known effect stands beside the Sun once.
    assert {case.effects[0].kind.name for case in beside_sun} == set(KNOWN) - {"scene_evolution"}
    assert {case.target_pct[1] for case in beside_sun} == {None}
    assert all(0.02 <= case.effects[1].strength <= 0.3 for case in beside_sun)
    targets = np.array([[*case.target_pct, np.nan][:2] for case in pairs], dtype=float)
    assert (targets[1::3, 0] >= 10).all()
    assert ((targets[2::3] >= 10) & (targets[2::3] <= 30)).all()
    assert ((targets[0::3] >= 0.5) & (targets[0::3] <= 10)).all()
    single = np.array([case.target_pct[0] for case in cases if case.kind == SINGLE], dtype=float)
    np.testing.assert_array_equal(single >= 10, np.arange(single.size) % 4 == 3)


def test_the_sun_beside_a_strong_effect_keeps_the_strength_that_was_drawn(tmp_path: Path) -> None:
    case = next(case for case in (drawn(2, n) for n in range(96)) if case.target_pct[1:] == (None,))
    strengths = [effect["strength"] for effect in make(case, tmp_path / "t", tmp_path / "e")["effects"]]
    assert strengths[1] == case.effects[1].strength and strengths[0] != case.effects[0].strength
    clean, *alone = (
        [frame.pixels for frame in read_transit(tmp_path / "e" / name, LIMITS).frames]
        for name in ("without_effects", "effect_0", "effect_1")
    )
    for images in alone:
        assert np.abs(np.subtract(images, clean)).max() > 0.1


def test_the_transit_of_a_case_contains_nothing_of_the_truth(made: BlindSet) -> None:
    transit = read_transit(made.transit(0), LIMITS)
    assert (len(transit.frames), transit.shape) == (IMAGES, (SIZE_PX, SIZE_PX))
    places = np.array([[frame.place.x_px, frame.place.y_px] for frame in transit.frames])
    exact = np.array([[at["x"], at["y"]] for at in made.truth(0)["exact"]])
    assert 0.05 < np.abs(places - exact).max() < 3
    for frame, at in zip(transit.frames, exact, strict=True):
        row, column = np.rint(at[::-1]).astype(int)
        assert frame.pixels[row - 3 : row + 4, column - 3 : column + 4].mean() < frame.pixels.mean()
    level = made.truth(1)["plan"]["saturation_dn"]
    clipped = 0
    for file in sorted(made.transit(1).glob("0*.fits")):
        with fits.open(file) as hdus:
            pixels, header = hdus[0].data, hdus[0].header
        if header["GAINCOMB"] == "high-only":
            assert header["SATURATE"] == level and pixels.max() <= level
            clipped += int((pixels == level).sum())
    assert clipped > 0
    words = [*EFFECTS, "clean", "effect", "truth", "strength", "salt"]
    for number in (0, 1):
        folder = made.transit(number)
        names = sorted(path.name for path in folder.iterdir())
        assert names == [f"{n:03d}.fits" for n in range(IMAGES)] + ["diffraction.fits", "transit.json"]
        told = (folder / "transit.json").read_text()
        assert set(json.loads(told)["images"][0]) == {"file", "fov", "x", "y", "r"}
        for file in folder.glob("*.fits"):
            with fits.open(file) as hdus:
                assert len(hdus) == 1
                told += repr(hdus[0].header)
        assert [word for word in words if word in told.lower()] == []


def test_the_images_without_noise_are_kept_apart_from_the_transit(made: BlindSet) -> None:
    seen = read_transit(made.transit(0), LIMITS)
    alone, without = (
        read_transit(made.expected(0) / name, LIMITS) for name in ("effect_0", "without_effects")
    )
    assert alone.noise == without.noise == seen.noise
    noisy, mean, clean = (np.array([f.pixels for f in t.frames]) for t in (seen, alone, without))
    exposure_s = [frame.exposure_s for frame in seen.frames]
    variance = [seen.noise.variance(m, t) for m, t in zip(mean.astype(float), exposure_s, strict=True)]
    rounded = 1 / 12 / np.array(exposure_s)[:, None, None] ** 2  # the transit is in whole DN
    chi2 = float(np.mean((noisy - mean) ** 2 / (np.array(variance) + rounded)))
    assert chi2 == pytest.approx(1.0, abs=0.02)
    change = mean - clean  # a plane, the same in all images
    np.testing.assert_allclose(change, np.broadcast_to(change[0], change.shape), atol=3e-3)
    assert np.abs(change).max() > 0.01
    cause = {"name": "intensity_gradient", "families": ["light_place"], "stage": "detector"}
    listed = json.loads((made.expected(0) / "causes.json").read_text())
    assert listed == {"schema": "gap-causes/1", "causes": [{"folder": "effect_0", **cause}]}


def test_the_truth_contains_what_an_effect_leaves_and_a_map_of_the_light_that_it_adds(made: BlindSet) -> None:
    truth, (filled,) = made.truth(0), made.truth(1)["effects"]
    (target_pct,), (effect,) = truth["target_pct"], truth["effects"]
    assert (effect["name"], effect["families"], effect["stage"]) == (
        "intensity_gradient",
        ["light_place"],
        "detector",
    )
    assert truth["left_after_refit_pct"] == pytest.approx(target_pct, rel=0.6)
    assert effect["left_alone_pct"] == pytest.approx(target_pct, rel=0.45)
    assert len(truth["residuals"]) == IMAGES
    assert 0 < np.abs([image["clean_pct"] for image in truth["residuals"]]).max() < 2
    light = np.array(effect["light_map"]["values"])
    assert light.mean() == pytest.approx(effect["strength"], rel=0.02)
    angle = np.deg2rad(effect["parameters"]["angle_deg"])
    row, column = np.unravel_index(light.argmax(), light.shape)
    assert (column > 32, row > 32) == (np.cos(angle) > 0, np.sin(angle) > 0)
    assert "light_map" not in filled and filled["also"] == ["scene_evolution"]


def test_a_clean_case_has_a_transit_alone_also_of_a_given_scene(tmp_path: Path) -> None:
    case = drawn(4, clean_only=True)
    truth = make(case, tmp_path / "transit", tmp_path / "expected")
    assert (truth["effects"], truth["left_after_refit_pct"]) == ([], 0.0)
    assert not (tmp_path / "expected").exists(), "the bound of clean data needs no images"
    assert len(read_transit(tmp_path / "transit", LIMITS).frames) == IMAGES
    image = 100 + 20 * np.random.default_rng(1).standard_normal((300, 300))
    image[5, 5] = np.nan
    scenes = case_scenes(case, [image])
    assert all(scene.shape == (2 * SIZE_PX, 2 * SIZE_PX) and scene.min() >= 0 for scene in scenes.values())
    np.testing.assert_array_equal(scenes[1][:, ::-1], scenes[3])
    with pytest.raises(DataError, match="bad-scene"):
        case_scenes(case, [np.zeros((300, 300))])


def test_a_set_keeps_its_truth_its_plan_and_one_run(made: BlindSet, tmp_path: Path) -> None:
    copy = BlindSet(tmp_path)
    (tmp_path / "truth").mkdir()
    copy.seals_file.write_text(made.seals_file.read_text())
    kept = json.loads(made.truth_file(0).read_text())
    copy.truth_file(0).write_text(json.dumps(kept))
    assert copy.truth(0) == made.truth(0)
    kept["truth"]["effects"][0]["name"] = "dark_offset"
    copy.truth_file(0).write_text(json.dumps(kept))
    for number in (0, 1):  # of case 1 there is none
        with pytest.raises(DataError, match="broken-seal"):
            copy.truth(number)
    copy.seals_file.write_text(made.seals_file.read_text() + '{"case": 0, "sha256": "00"}\n')
    with pytest.raises(DataError, match="bad-seals"):
        copy.seals()
    before = made.truth_file(0).read_bytes(), made.seals_file.read_bytes()
    about = made.folder / "set.json"
    about.write_text(
        json.dumps(json.loads(about.read_text()) | {"first": 0})
    )  # as an earlier version wrote it
    make_set(made.folder, TWO)
    assert (made.truth_file(0).read_bytes(), made.seals_file.read_bytes()) == before
    older = dataclasses.asdict(TWO) | {"scenes": []}  # written before sets stated their draw
    (tmp_path / "older").mkdir()
    (tmp_path / "older" / "set.json").write_text(json.dumps(older))
    other_seed = SetPlan(2, 4, SIZE_PX, IMAGES)
    for folder, plan in ((tmp_path / "older", TWO), (made.folder, other_seed)):
        with pytest.raises(DataError, match="other-set"):
            make_set(folder, plan)
    for _ in range(2):  # free again after the first run
        with (
            alone_in(tmp_path / "set"),
            pytest.raises(DataError, match="set-in-use"),
            alone_in(tmp_path / "set"),
        ):
            pass


def test_a_case_that_fails_is_named_and_the_others_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = SetPlan(3, 3, SIZE_PX, IMAGES, clean_only=True)
    failing = {1}

    def make_but_one(case: Case, *folders: Path | Sequence[Plane]) -> dict[str, Any]:
        if case.number in failing:
            raise DataError("bad-scene", "expected light in the scene")
        return {"kind": CLEAN, "effects": []}

    monkeypatch.setattr("psfcore.blind.case_set.make", make_but_one)
    said: list[str] = []
    made, not_made = make_set(tmp_path, plan, progress=said.append)
    assert not_made == {1: "bad-scene: expected light in the scene"}
    assert [made.is_made(number) for number in range(3)] == [True, False, True]
    assert sum("could not make case 0001" in line for line in said) == 1
    failing.clear()
    before = made.seals_file.read_text()
    assert make_set(tmp_path, plan)[1] == {} and made.is_made(1)  # the next run tries again
    assert made.seals_file.read_text().startswith(before) and set(made.seals()) == {0, 1, 2}
