"""A small transit that a local service fitted and cross-validated once in a run; tests open copies of its data."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from psfcore.scatter.inversion import invert
from tests.in_process import InProcess
from tests.once_a_run import once_a_run
from tests.transit_files import write_simulated
from workers.settings import Settings
from workers.tasks import solutions


def fitted_transit(folders: pytest.TempPathFactory) -> Path:
    """The folder with the transit, the data of the service, and what the jobs returned.

    transit/, data/; psf.fits, psf.json, psf.png: the files of the fit. folds.json, folds.png: those of three folds.
    made.json: the rows `psf` and `folds`; the `steps` of the fit's progress; the images of each of the `inversions`.
    """
    return once_a_run(lambda: _made(folders.mktemp("fitted_transit")), "fitted_transit", folders)


def copied_data(fitted: Path, folder: Path) -> Settings:
    """The settings of a local service with a copy of the data. Stored files never change, so large ones are linked."""
    shutil.copytree(fitted / "data", folder, copy_function=_link_or_copy)
    return _settings(folder)


def _link_or_copy(source: str, target: str) -> None:
    if "catalogue" in Path(source).name:
        shutil.copy2(source, target)
    else:
        os.link(source, target)


def _settings(folder: Path) -> Settings:
    return Settings(data_dir=folder, database_url=None, broker_url="filesystem://")


@contextmanager
def counted_inversions(images: list[int]) -> Iterator[None]:
    """Add the number of images of each transit that a task inverts to this list."""

    def counted(transit: Any, shape: Any, **how: Any) -> Any:
        solution = invert(transit, shape, **how)
        images.append(len(transit.frames))
        return solution

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(solutions, "invert", counted)
        yield


def _made(out: Path) -> Path:
    transit = write_simulated(out / "transit")
    steps: list[tuple[str, int, int]] = []
    inversions: list[int] = []

    with counted_inversions(inversions):
        local = InProcess(_settings(out / "data"))
        psf = local.fit_psf(
            transit,
            out / "psf.fits",
            report=out / "psf.json",
            preview=out / "psf.png",
            progress=lambda *step: steps.append(step),
        )
        folds = local.cross_validate(
            transit, out / "folds.json", preview=out / "folds.png", scheme="shared", runs=1
        )
        local.close()
    made = {"psf": psf, "folds": folds, "steps": steps, "inversions": inversions}
    (out / "made.json").write_text(json.dumps(made))
    return out
