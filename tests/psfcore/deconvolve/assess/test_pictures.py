"""Many images in one run: the most doubtful first, the failures apart, and a contact sheet."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.deconvolve import run as one_run
from psfcore.deconvolve.assess.pictures import (
    BLOCK_PX,
    TAIL_PCT,
    THUMBNAIL_PX,
    Failure,
    Treated,
    changes_in_product,
    contact_sheet_png,
    table,
    treat_many,
)
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named
from psfcore.deconvolve.run import Identities, UsedPsf
from psfcore.deconvolve.work import Options
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.scatter.power_law import scatter_kernel
from psfcore.simulate.scene import observe, solar_scene
from tests.psfcore.conftest import make_image, make_psf

SIZE = 288
STEP = -(-SIZE // THUMBNAIL_PX)
Run = tuple[list[Treated], list[Failure]]
DEAD = (slice(40, 80, 4), slice(40, 280, 8))  # [y, x] of dead pixels, which are not on the Sun


@pytest.fixture(scope="module")
def psf() -> Psf:
    return make_psf(scatter_kernel(3.0, 2.5, 0.4, 128), plate_scale_arcsec=0.5)


@pytest.fixture(scope="module")
def images(psf: Psf) -> dict[str, Image]:
    out = {}
    for seed, name in enumerate(("clean", "dead", "other")):
        scene = solar_scene((SIZE, SIZE), seed + 1)
        pixels = observe(scene, psf, exposure_s=1.4, photon_gain_dn=6.0, read_noise_dn=2.0, seed=seed)
        if name == "dead":
            pixels[DEAD] = -300.0
        out[name] = make_image(pixels)
    return out


def reader(images: dict[str, Image], psf: Psf, folder: Path) -> Callable[[str], Treated]:
    def one(name: str) -> Treated:
        if name == "gone":
            raise FileNotFoundError(2, "No such file or directory", name)
        if name == "empty":
            raise DataError("no-signal", "expected pixels above zero; the largest is 0")
        image, before, after = images[name], folder / f"{name}.fits", folder / f"{name}-after.fits"
        fits.PrimaryHDU(image.pixels, fits.Header({"BUNIT": "DN/s", "XPOSURE": 1.4})).writeto(before)
        product = one_run.deconvolve(image, psf, Options(parameters={"steps": 8}), warnings={})
        used = UsedPsf("0" * 64, psf.name, psf.version, psf.status)
        one_run.write(product, after, used, Identities("1" * 64, "2" * 64, 1, "after.fits"))
        return changes_in_product(name, before, after, product.details(), FitsLimits(max_pixels=SIZE**2))

    return one


@pytest.fixture(scope="module")
def run(images: dict[str, Image], psf: Psf, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("products")
    return treat_many(["gone", "clean", "dead", "empty", "other"], reader(images, psf, folder))


def test_the_most_doubtful_come_first_and_failures_do_not_stop_the_run(run: Run) -> None:
    treated, failures = run
    assert treated[0].name == "dead" and {row.name for row in treated} == {"clean", "dead", "other"}
    scores = [row.score for row in treated]
    assert scores == sorted(scores, reverse=True) and scores[0] > 1 > scores[1]
    assert failures == [
        Failure("gone", "unreadable-file", "No such file or directory"),
        Failure("empty", "no-signal", "expected pixels above zero; the largest is 0"),
    ]
    # Suspected pixels are marked where they are.
    rows, columns = treated[0].suspected.T * STEP
    within = (rows >= 36) & (rows <= 84) & (columns >= 36)
    assert rows.size > 50 and within.mean() > 0.9
    # An internal error is not a failure of the image.
    with pytest.raises(ZeroDivisionError):
        treat_many(["a"], lambda name: 1 / 0)  # type: ignore[arg-type,return-value]


def test_numbers_belong_to_the_deconvolution(run: Run, images: dict[str, Image], psf: Psf) -> None:
    row = next(row for row in run[0] if row.name == "clean")
    result = method_named("richardson-lucy")(images["clean"], psf, Conditions(), steps=8)
    assert row.steps_done == 8
    means = result.pixels.reshape(SIZE // STEP, STEP, SIZE // STEP, STEP).mean(axis=(1, 3))
    assert row.after == pytest.approx(means, rel=1e-4)
    chosen = {"kind": "bright", "block_px": BLOCK_PX, "tail_pct": TAIL_PCT}
    (structure,) = (one for one in row.changes["structures"] if one | chosen == one)
    assert row.structure("bright") == {key: structure[key] for key in ("sum_pct", "up_to_pct")}
    assert structure["sum_pct"] > 5


def test_the_table_is_json_with_a_summary(run: Run) -> None:
    content = json.loads(json.dumps(table(*run), allow_nan=False))
    rows, summary = content["images"], content["summary"]
    assert [row["file"] for row in rows] == [row.name for row in run[0]]
    assert [summary[key] for key in ("images", "failures", "to_look_at")] == [3, 2, 1]
    assert summary["bright"]["extreme_pct"] == max(row["bright"]["up_to_pct"] for row in rows)
    assert summary["dark"]["extreme_pct"] == min(row["dark"]["up_to_pct"] for row in rows)
    assert rows[0]["effects"]["artefacts"]["score"] == rows[0]["score"]
    assert content["failures"][0]["reason"] == "No such file or directory"


def drawn(path: Path) -> NDArray[np.float64]:
    return np.asarray(matplotlib.image.imread(path), dtype=np.float64)[..., :3]


def test_the_sheet_shows_every_image_and_every_failure(run: Run, tmp_path: Path) -> None:
    contact_sheet_png(*run, tmp_path / "all.png")
    contact_sheet_png(run[0], run[1], tmp_path / "one.png", most=1)
    contact_sheet_png(run[0], [], tmp_path / "well.png")
    whole, one, well = (drawn(tmp_path / f"{name}.png") for name in ("all", "one", "well"))
    assert whole.shape[0] > one.shape[0] + 400  # two more rows of thumbnails
    # The failures are listed in red at the foot of the sheet, if there are any.
    red = [np.mean((image[-70:] * [1, -1, -1]).sum(axis=-1) > 0.3) for image in (whole, well)]
    assert red[0] > 0.002 > red[1]
    dark = (whole < 0.3).all(axis=-1).mean()
    assert 0.05 < dark < 0.9  # thumbnails are dark, the page is white


def test_a_run_in_which_all_images_failed_has_a_sheet(tmp_path: Path) -> None:
    failures = [Failure(f"{n}.fits", "all-nan", "expected finite pixels") for n in range(30)]
    contact_sheet_png([], failures, tmp_path / "none.png")
    assert drawn(tmp_path / "none.png").std() > 0.02
    assert table([], failures)["summary"] == {"images": 0, "failures": 30, "to_look_at": 0}
