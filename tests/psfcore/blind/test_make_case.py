"""Cases of the blind set: drawn in equal shares, readable as transits, their truth kept apart."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.blind.case_set import BlindSet, Plane, SetPlan, _end_cut_line, alone_in, make_set
from psfcore.blind.cases import CLEAN, FOREIGN, PAIR, SINGLE, Case, case_scenes, draw_case
from psfcore.blind.effects.registry import EFFECTS, KNOWN
from psfcore.blind.make_case import Made, make
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.transit.folder import read_transit

SIZE_PX, IMAGES = 128, 9


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> BlindSet:
    plan = SetPlan(
        2, 3, SIZE_PX, IMAGES, only=("intensity_gradient", "saturation_fill"), built_diffraction=False
    )
    return make_set(tmp_path_factory.mktemp("blind") / "set", plan)[0]


def test_kinds_have_their_shares_and_effects_occur_in_turn() -> None:
    cases = [draw_case(1, n, SIZE_PX, IMAGES) for n in range(72)]
    assert Counter(case.kind for case in cases) == {CLEAN: 24, SINGLE: 27, PAIR: 9, FOREIGN: 12}
    names = Counter(case.effects[0].name for case in cases if case.kind == SINGLE)
    assert set(names) == set(KNOWN)
    assert max(names.values()) - min(names.values()) <= 1
    assert all(len({effect.name for effect in case.effects}) == 2 for case in cases if case.kind == PAIR)


def test_strong_effects_occur_alone_in_pairs_and_beside_a_changing_sun() -> None:
    cases = [draw_case(2, n, SIZE_PX, IMAGES) for n in range(17 * 24)]
    pairs = [case for case in cases if case.kind == PAIR]
    beside_sun = [case for case in pairs[1::3] if case.effects[1].name == "scene_evolution"]
    assert len(beside_sun) == len(pairs[1::3]) == 17
    # Every other known effect stands beside the Sun once.
    assert {case.effects[0].name for case in beside_sun} == set(KNOWN) - {"scene_evolution"}
    assert {case.target_pct[1] for case in beside_sun} == {None}
    assert all(0.02 <= case.effects[1].strength <= 0.3 for case in beside_sun)
    targets = np.array([[*case.target_pct, np.nan][:2] for case in pairs], dtype=float)
    assert (targets[1::3, 0] >= 10).all()
    assert ((targets[2::3] >= 10) & (targets[2::3] <= 30)).all()
    assert ((targets[0::3] >= 0.5) & (targets[0::3] <= 10)).all()
    single = np.array([case.target_pct[0] for case in cases if case.kind == SINGLE], dtype=float)
    np.testing.assert_array_equal(single >= 10, np.arange(single.size) % 4 == 3)


def test_the_sun_beside_a_strong_effect_keeps_the_strength_that_was_drawn() -> None:
    cases = (draw_case(2, n, SIZE_PX, IMAGES, built_diffraction=False) for n in range(96))
    case = next(case for case in cases if case.target_pct[1:] == (None,))
    truth = make(case).truth
    assert truth["effects"][1]["strength"] == case.effects[1].strength
    assert truth["effects"][0]["strength"] != case.effects[0].strength
    assert truth["target_pct"][1] is None


def test_a_set_of_an_earlier_draw_is_not_continued(tmp_path: Path) -> None:
    plan = SetPlan(1, 3, SIZE_PX, IMAGES)
    older = dataclasses.asdict(plan) | {"scenes": []}  # written before sets stated their draw
    (tmp_path / "set.json").write_text(json.dumps(older))
    with pytest.raises(DataError, match="other-set"):
        make_set(tmp_path, plan)


def test_a_case_is_the_same_for_its_seed_and_number() -> None:
    assert draw_case(1, 5, SIZE_PX, IMAGES) == draw_case(1, 5, SIZE_PX, IMAGES)
    assert draw_case(1, 5, SIZE_PX, IMAGES) != draw_case(2, 5, SIZE_PX, IMAGES)
    with pytest.raises(DataError, match="unknown-effect"):
        draw_case(1, 0, SIZE_PX, IMAGES, only=("gremlins",))


def test_each_target_is_used_in_turn_for_every_effect() -> None:
    names, left_pct = ("ghost", "wide_halo"), (2.0, 4.0, 8.0)
    cases = [draw_case(1, n, SIZE_PX, IMAGES, only=names, left_pct=left_pct) for n in range(7)]
    found = [(case.effects[0].name, *case.target_pct) for case in cases]
    assert found == [(name, pct) for pct in (*left_pct, 2.0) for name in names][:7]


def test_the_transit_of_a_case_can_be_read(made: BlindSet) -> None:
    transit = read_transit(made.transit(0), FitsLimits(max_pixels=SIZE_PX**2))
    assert (len(transit.frames), transit.shape) == (IMAGES, (SIZE_PX, SIZE_PX))
    truth = made.truth(0)
    places = np.array([[frame.place.x_px, frame.place.y_px] for frame in transit.frames])
    exact = np.array([[at["x"], at["y"]] for at in truth["exact"]])
    assert 0.05 < np.abs(places - exact).max() < 3
    for frame, at in zip(transit.frames, exact, strict=True):
        row, column = np.rint(at[::-1]).astype(int)
        assert frame.pixels[row - 3 : row + 4, column - 3 : column + 4].mean() < frame.pixels.mean()


def test_saturated_images_give_their_level_in_the_header(made: BlindSet) -> None:
    level = made.truth(1)["plan"]["saturation_dn"]
    clipped = 0
    for file in sorted(made.transit(1).glob("0*.fits")):
        with fits.open(file) as hdus:
            pixels, header = hdus[0].data, hdus[0].header
        if header["GAINCOMB"] == "high-only":
            assert header["SATURATE"] == level
            assert pixels.max() <= level
            clipped += int((pixels == level).sum())
    assert clipped > 0


def test_the_transit_contains_nothing_of_the_truth(made: BlindSet) -> None:
    words = [*EFFECTS, "clean", "effect", "truth", "strength", "salt"]
    for number in (0, 1):
        folder = made.transit(number)
        names = sorted(path.name for path in folder.iterdir())
        assert names == [f"{n:03d}.fits" for n in range(IMAGES)] + ["diffraction.fits", "transit.json"]
        told = (folder / "transit.json").read_text()
        for file in folder.glob("*.fits"):
            with fits.open(file) as hdus:
                assert len(hdus) == 1
                told += repr(hdus[0].header)
        assert [word for word in words if word in told.lower()] == []
        assert set(json.loads((folder / "transit.json").read_text())["images"][0]) == {
            "file",
            "fov",
            "x",
            "y",
            "r",
        }


def test_the_images_without_noise_are_kept_apart_from_the_transit(made: BlindSet) -> None:
    limits = FitsLimits(max_pixels=SIZE_PX**2)
    seen = read_transit(made.transit(0), limits)
    with_effects, without = (
        read_transit(made.expected(0) / name, limits) for name in ("with_effects", "without_effects")
    )
    assert with_effects.noise == seen.noise
    noisy, mean, clean = (np.array([f.pixels for f in t.frames]) for t in (seen, with_effects, without))
    exposure = np.array([frame.exposure_s for frame in seen.frames])[:, None, None]
    variance = np.array(
        [seen.noise.variance(m, t) for m, t in zip(mean.astype(float), exposure.ravel(), strict=True)]
    )
    rounded = 1 / 12 / exposure**2  # the transit is in whole DN
    chi2 = float(np.mean((noisy - mean) ** 2 / (variance + rounded)))
    assert chi2 == pytest.approx(1.0, abs=0.02)
    change = mean - clean  # a plane, the same in all images
    np.testing.assert_allclose(change, np.broadcast_to(change[0], change.shape), atol=2e-3)
    assert np.abs(change).max() > 0.01


def test_the_truth_contains_what_an_effect_leaves(made: BlindSet) -> None:
    truth = made.truth(0)
    assert truth["effects"][0]["name"] == "intensity_gradient"
    assert truth["left_after_refit_pct"] == pytest.approx(truth["target_pct"][0], rel=0.6)
    assert truth["effects"][0]["left_alone_pct"] == pytest.approx(truth["target_pct"][0], rel=0.45)
    assert 0 < truth["clean_left_pct"] < 0.8
    assert len(truth["refitted"]["residual_pct"]) == IMAGES


def test_a_clean_case_has_no_effect() -> None:
    case = draw_case(4, 0, SIZE_PX, IMAGES, clean_only=True, built_diffraction=False)
    result = make(case)
    assert result.truth["effects"] == []
    assert result.truth["left_after_refit_pct"] == 0.0
    assert result.truth["clean_left_pct"] < 0.8
    assert result.expected == {}, "an ideal observer of clean data needs no images"
    assert all(np.array_equal(dn, np.rint(dn)) for dn in result.exposures)


def test_scenes_can_be_taken_from_images() -> None:
    case = draw_case(4, 0, SIZE_PX, IMAGES, clean_only=True, built_diffraction=False)
    rng = np.random.default_rng(1)
    image = 100 + 20 * rng.standard_normal((300, 300))
    image[5, 5] = np.nan
    scenes = case_scenes(case, [image])
    assert all(scene.shape == (2 * SIZE_PX, 2 * SIZE_PX) and scene.min() >= 0 for scene in scenes.values())
    np.testing.assert_array_equal(scenes[1][:, ::-1], scenes[3])
    with pytest.raises(DataError, match="bad-scene"):
        case_scenes(case, [np.zeros((300, 300))])


def test_a_folder_of_another_set_is_refused(made: BlindSet) -> None:
    with pytest.raises(DataError, match="other-set"):
        make_set(made.folder, SetPlan(2, 4, SIZE_PX, IMAGES))


def test_seals_catch_a_changed_truth(made: BlindSet, tmp_path: Path) -> None:
    copy = BlindSet(tmp_path)
    (tmp_path / "truth").mkdir()
    copy.seals_file.write_text(made.seals_file.read_text())
    kept = json.loads(made.truth_file(0).read_text())
    copy.truth_file(0).write_text(json.dumps(kept))
    assert copy.truth(0) == made.truth(0)
    kept["truth"]["effects"][0]["name"] = "dark_offset"
    copy.truth_file(0).write_text(json.dumps(kept))
    with pytest.raises(DataError, match="broken-seal"):
        copy.truth(0)
    with pytest.raises(DataError, match="broken-seal"):
        copy.truth(1)  # none there
    copy.seals_file.write_text(made.seals_file.read_text() + '{"case": 0, "sha256": "00"}\n')
    with pytest.raises(DataError, match="bad-seals"):
        copy.seals()


def test_an_incomplete_last_seal_is_ignored_and_removed(tmp_path: Path) -> None:
    made = BlindSet(tmp_path)
    whole = json.dumps({"case": 0, "sha256": "ab"}) + "\n"
    for cut in ("", '{"case": 1, "sha', '{"case": 1, "sha256": "cd"}'):
        made.seals_file.write_text(whole + cut)
        assert made.seals() == {0: "ab"}
        _end_cut_line(made.seals_file)
        assert made.seals_file.read_text() == whole
    made.seals_file.write_text('{"case"')
    _end_cut_line(made.seals_file)
    assert made.seals_file.read_text() == ""


def test_only_one_run_at_a_time_uses_a_set(tmp_path: Path) -> None:
    with (
        alone_in(tmp_path / "set"),
        pytest.raises(DataError, match="set-in-use: expected a folder that no other run uses"),
        alone_in(tmp_path / "set"),
    ):
        pass
    with alone_in(tmp_path / "set"):
        pass


def test_made_cases_are_not_made_again(made: BlindSet) -> None:
    before = made.truth_file(0).read_bytes(), made.seals_file.read_bytes()
    plan = SetPlan(
        2, 3, SIZE_PX, IMAGES, only=("intensity_gradient", "saturation_fill"), built_diffraction=False
    )
    make_set(made.folder, plan)
    assert (made.truth_file(0).read_bytes(), made.seals_file.read_bytes()) == before


def test_a_case_that_fails_is_named_and_the_others_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = SetPlan(3, 3, SIZE_PX, IMAGES, clean_only=True, built_diffraction=False)

    def make_but_one(case: Case, scenes: Sequence[Plane]) -> Made:
        if case.number == 1:
            raise DataError("bad-scene", "expected light in the scene")
        return make(case, scenes)

    monkeypatch.setattr("psfcore.blind.case_set.make", make_but_one)
    said: list[str] = []
    made, not_made = make_set(tmp_path, plan, progress=said.append)
    assert not_made == {1: "bad-scene: expected light in the scene"}
    assert [made.is_made(number) for number in plan.numbers] == [True, False, True]
    assert sum("could not make case 0001" in line for line in said) == 1
    monkeypatch.undo()
    assert make_set(tmp_path, plan)[1] == {}, "the next run tries again"
    assert made.is_made(1)
