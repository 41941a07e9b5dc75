"""``heliopsf.interpolate_psf``: two files or PSFs of fits, and times as texts or datetimes."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import heliopsf
from tests.fitted_psfs import EARLY, LATE, fitted_psf, write_fitted

TIMES = {"before_time": "2022-03-01", "after_time": "2023-03-01T00:00:00Z"}


def test_files_and_psfs_give_the_same_psf(tmp_path: Path) -> None:
    files = [write_fitted(tmp_path / f"{name}.fits", values) for name, values in (("a", EARLY), ("b", LATE))]
    psf = heliopsf.interpolate_psf(*files, **TIMES, time="2022-08-30T12:00:00")
    assert psf.fitted is not None and psf.name == "hri_euv-interpolated"
    middle = np.log(EARLY["b_px"] * LATE["b_px"]) / 2
    assert psf.fitted.coordinates[0] == pytest.approx(middle)
    at = datetime(2022, 8, 30, 12, tzinfo=UTC)
    same = heliopsf.interpolate_psf(heliopsf.read_psf(files[0]), files[1], **TIMES, time=at)
    np.testing.assert_array_equal(psf.kernel, same.kernel)
    psf.write(tmp_path / "between.fits")
    assert heliopsf.read_psf(tmp_path / "between.fits").fitted == psf.fitted


def test_wrong_arguments_are_refused() -> None:
    given = {"before": fitted_psf(EARLY), "after": fitted_psf(LATE), **TIMES, "time": "2022-06-01"}
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"time": "soon"}, "bad-time"),
        ({"time": 2022}, "bad-time"),
        ({"time": "2024-01-01"}, "time-outside-epochs"),
        ({"after_time": "2021-01-01"}, "epochs-not-in-order"),
        ({"after": fitted_psf(LATE | {"bend": 0.0}, shape="knee")}, "shapes-differ"),
    ]
    for changes, code in wrong:
        with pytest.raises(heliopsf.DataError, match=code):
            heliopsf.interpolate_psf(**(given | changes))
