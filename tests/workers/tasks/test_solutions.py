"""Kept solutions: found again by their owner alone, only for the same inversion, and never needed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psfcore.noise import Noise
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.transit.transit import Transit
from tests.psfcore import small_transits
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, SolutionRow
from workers.contract.requests import PsfBuild, ResolvedCrossValidate, ResolvedPsfFit, ResolvedReport
from workers.files.store import Store, StoreAway
from workers.settings import Settings
from workers.tasks import solutions
from workers.tasks.catalogue_workspace import CatalogueWorkspace
from workers.tasks.solutions import solution_identity

REQUEST = ResolvedPsfFit(transit_id="1" * 64)


@pytest.fixture
def workspace(catalogue: Catalogue, tmp_path: Path) -> CatalogueWorkspace:
    settings = Settings(data_dir=tmp_path, database_url=None, broker_url="filesystem://")
    return CatalogueWorkspace(catalogue, Store(tmp_path), settings, "o", "j", report=lambda *_: None)


@pytest.fixture
def inverted(monkeypatch: pytest.MonkeyPatch) -> list[Transit]:
    """The transits that were inverted; the result was computed before."""
    seen: list[Transit] = []

    def invert(transit: Transit, *_: object, **__: object) -> Solution:
        seen.append(transit)
        return small_transits.solved()

    monkeypatch.setattr(solutions, "invert", invert)
    return seen


def solve(workspace: CatalogueWorkspace, **how: Any) -> Solution:
    request = how.pop("request", REQUEST)
    transit = how.pop("transit", small_transits.solved().transit)
    shape = how.pop("shape", SOFTENED_POWER_LAW)
    start = how.pop("start", None)
    solved = workspace.inverter(request)
    return solved(transit, shape, start=start, threads=1, progress=lambda *_: None)


def row(workspace: CatalogueWorkspace) -> SolutionRow:
    (found,) = workspace.catalogue.quotas.solutions_before(np.inf)
    return found


def test_later_jobs_of_the_same_owner_share_it(
    workspace: CatalogueWorkspace, inverted: list[Transit]
) -> None:
    first, second = solve(workspace), solve(dataclasses.replace(workspace, job_id="other"))
    assert len(inverted) == 1
    assert first.inversion.coordinates.tobytes() == second.inversion.coordinates.tobytes()
    assert [s.tobytes() for s in first.sky.scenes] == [s.tobytes() for s in second.sky.scenes]
    for request in (
        ResolvedPsfFit(transit_id="1" * 64, seed=9, as_published=True),
        ResolvedCrossValidate(transit_id="1" * 64, runs=2),
        ResolvedReport(transit_id="1" * 64, dark_offsets=False),
    ):
        solve(workspace, request=request)
    assert len(inverted) == 1
    solve(dataclasses.replace(workspace, owner="p"))
    assert len(inverted) == 2


def test_a_rerun_neither_uses_nor_keeps_one(workspace: CatalogueWorkspace, inverted: list[Transit]) -> None:
    for runs, kept in ((1, 0), (3, 1)):
        solve(dataclasses.replace(workspace, anew=True))
        assert len(inverted) == runs
        assert len(workspace.catalogue.quotas.solutions_before(np.inf)) == kept
        solve(workspace)


def test_everything_that_determines_a_solution_is_in_its_identity(monkeypatch: pytest.MonkeyPatch) -> None:
    transit, shape = small_transits.solved().transit, SOFTENED_POWER_LAW
    noisy = dataclasses.replace(transit, noise=Noise(1.0, 9.0))
    build = PsfBuild(instrument="hri_euv")
    made = [
        solution_identity(REQUEST, transit, shape, None),
        solution_identity(ResolvedPsfFit(transit_id="2" * 64), transit, shape, None),
        solution_identity(ResolvedPsfFit(transit_id="1" * 64, saturation_dn=9.0), transit, shape, None),
        solution_identity(
            ResolvedPsfFit(transit_id="1" * 64, diffraction_recipe=build), transit, shape, None
        ),
        solution_identity(REQUEST, noisy, shape, None),
        solution_identity(REQUEST, transit, SHAPES["stretched"], None),
        solution_identity(REQUEST, transit, shape, np.array([0.1, 0.2, 0.3])),
        solution_identity(REQUEST, transit, shape, np.array([0.1, 0.2, np.nextafter(0.3, 1)])),
    ]
    for name, other in (
        ("ALGORITHM_VERSION", 99),
        ("software_version", lambda: "99"),
        ("library_versions", dict),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(solutions, name, other)
            made.append(solution_identity(REQUEST, transit, shape, None))
    assert len(set(made)) == len(made) == 11
    assert solution_identity(REQUEST, transit, shape, None) == made[0]


def damage(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def test_one_that_cannot_be_read_is_made_and_kept_again(
    workspace: CatalogueWorkspace, inverted: list[Transit]
) -> None:
    solve(workspace)
    for runs, spoil in ((2, Path.unlink), (3, damage)):
        spoil(workspace.store.path(row(workspace).file_sha256))
        solve(workspace)
        solve(workspace)
        assert len(inverted) == runs
        assert workspace.catalogue.quotas.usage("o", 0).used_bytes == row(workspace).bytes


def test_storage_that_does_not_answer_costs_time_only(
    workspace: CatalogueWorkspace, inverted: list[Transit], monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object) -> Path:
        raise StoreAway("away")

    solve(workspace)
    for name in ("path", "keep"):
        monkeypatch.setattr(workspace.store, name, away)
    solve(workspace)
    monkeypatch.undo()
    assert row(workspace), "the row stays: the file may still be there"


def test_without_room_or_if_it_is_too_large_it_is_not_kept_and_the_job_goes_on(
    workspace: CatalogueWorkspace, inverted: list[Transit], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("psfcore.scatter.solution_file.MOST_BYTES", 1000)
        solve(workspace)
    assert workspace.catalogue.quotas.solutions_before(np.inf) == [] == list(workspace.store.blobs())
    image = ImageRow(owner="o", id="2" * 64, created_at=1.0, bytes=2**19, summary={})
    workspace.catalogue.quotas.set_quota("o", 1)
    workspace.catalogue.add(image)
    solve(workspace)
    assert workspace.catalogue.quotas.solutions_before(np.inf) == []
    assert workspace.catalogue.quotas.usage("o", 0).used_bytes == image.bytes
