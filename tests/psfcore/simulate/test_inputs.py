"""Plans read from files: plans, truth files, transits with images, and transits whose images do not exist yet."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.simulate.inputs import read_plan
from psfcore.simulate.plan import DISC, VIEWS, default_plan
from tests.psfcore.conftest import LIMITS
from tests.transit_files import write_transit

PLAN = default_plan(6, 96, saturation_dn=900.0, beyond="on", beyond_px=10)


def written(folder: Path, content: Any, name: str = "plan.json") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def entries(count: int = 4, **more: Any) -> list[dict[str, Any]]:
    return [
        {"file": f"{n}.fits", "fov": 7 if n < 2 else 3, "x": 30.0 + n, "y": 40.0, "r": 5.0} | more
        for n in range(count)
    ]


def transit(**more: Any) -> dict[str, Any]:
    return {"schema": "transit/1", "size_px": 96, "images": entries(exposure_s=2.0)} | more


def test_a_plan_and_the_truth_of_a_simulated_transit(tmp_path: Path) -> None:
    assert read_plan(written(tmp_path, PLAN.as_json()), LIMITS).plan == PLAN
    assert read_plan(written(tmp_path, {"seed": 1, "plan": PLAN.as_json()}), LIMITS).plan == PLAN


def test_a_transit_whose_images_do_not_exist_yet(tmp_path: Path) -> None:
    images = entries(exposure_s=2.0)
    images[1] |= {"gain_mode": "Combined", "time_s": 500.0}
    folder = written(tmp_path, transit(images=images, instrument="hri_euv"), "transit.json").parent
    found = read_plan(folder, LIMITS)
    plan = found.plan
    assert found.instrument == "hri_euv" and found.known_psf is None
    assert [shot.time_s for shot in plan.shots] == [0.0, 120.0, 180.0, 500.0]
    assert [shot.pointing for shot in plan.shots] == [2, 1, 1, 2]  # numbered in the order of their numbers
    assert plan.shots[-1].gain_mode == "combined" and plan.shots[-1].x_px == 31.0
    assert plan.radius_px == 5.0 and plan.views == (DISC, DISC)
    stated = read_plan(written(tmp_path, transit(views=["west_limb", "disc"])), LIMITS).plan
    assert stated.views == ("west_limb", "disc")
    three = entries(exposure_s=2.0)
    three[3]["fov"] = 9
    assert read_plan(written(tmp_path, transit(images=three)), LIMITS).plan.views == VIEWS


def test_the_images_of_a_transit_state_their_exposures(tmp_path: Path) -> None:
    folder = write_transit(tmp_path / "real")
    with pytest.raises(DataError, match="expected square images of equal size; got 80 x 64 px"):
        read_plan(folder, LIMITS)
    for number in range(6):
        path = folder / f"{number:03d}.fits"
        with fits.open(path, mode="update") as hdus:
            image = next(hdu for hdu in hdus if hdu.data is not None)
            image.data = np.pad(image.data, ((0, 16), (0, 0)))
    found = read_plan(folder, LIMITS)
    assert found.plan.size_px == 80
    assert [shot.exposure_s for shot in found.plan.shots] == [2.0, 1.0] * 3
    assert found.known_psf == folder / "diffraction.fits"
    (folder / "003.fits").unlink()
    with pytest.raises(DataError, match=r"or none of them; missing: 003\.fits"):
        read_plan(folder, LIMITS)


ENDLESS = json.dumps(PLAN.as_json()).replace('"exposure_s": 1.8', '"exposure_s": Infinity')
NO_PLANS: list[tuple[Any, str]] = [
    ("no json", "JSON in UTF-8"),
    ("[1, 2]", "got list"),
    ({"a": 1, "b": 2}, "`shots`, or .* `images`; got the keys a, b"),
    (PLAN.as_json() | {"shots": []}, "at least one image"),
    (PLAN.as_json() | {"shots": [1, 2]}, "a plan written by"),
    (PLAN.as_json() | {"size_px": 10**9}, "at most 4096 px"),
    (PLAN.as_json() | {"shots": 1001 * PLAN.as_json()["shots"][:1]}, "at most 1000 images"),
    (ENDLESS, "a finite exposure and time"),
    (transit(size_px=None), "`size_px`"),
    (transit(images=entries()), r"images\[0\]: .* `expos"),
    (transit(images=entries(exposure_s=1.0, time_s="now")), "a number as `time_s`"),
    (transit(views=["disc", "moon"]), "`views` with one of"),
    (transit(size_px=32), "64 px or more"),
]


def test_what_is_no_plan_is_refused(tmp_path: Path) -> None:
    for content, words in NO_PLANS:
        with pytest.raises(DataError, match=words) as caught:
            read_plan(written(tmp_path, content), LIMITS)
        assert caught.value.code in ("bad-plan", "bad-manifest")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"has no transit\.json"):
        read_plan(tmp_path / "empty", LIMITS)
