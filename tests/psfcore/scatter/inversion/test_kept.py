"""A kept solution is read back bit for bit, and a file that is not one of this transit is refused."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.scatter.inversion import Solution, kept, read_solution, solution_of, write_solution
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.validation.cross_validation import bootstrap_samples, exact_fit
from tests.psfcore.small_transits import observed, sky, solved, solved_noise_free

Members = dict[str, bytes]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("kept") / "solution"
    write_solution(path, solved())
    return path


def check_same(one: Any, other: Any) -> None:
    """Raise AssertionError unless two values, and all that they contain, are equal bit for bit."""
    if dataclasses.is_dataclass(one):
        assert type(one) is type(other)
        for field in dataclasses.fields(one):
            check_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        # The order in memory may change the last bits of a sum of floats.
        assert one.dtype.kind != "f" or one.flags.c_contiguous == other.flags.c_contiguous
        assert one.tobytes() == other.tobytes()
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            check_same(a, b)
    else:
        assert one == other


def test_a_solution_is_read_back_bit_for_bit(file: Path) -> None:
    first, again = solved(), read_solution(file, solved().transit)
    check_same(first.inversion, again.inversion)
    for name in ("observed", "scenes", "found", "dark"):
        check_same(getattr(first.sky, name), getattr(again.sky, name))
    assert again.transit is again.sky.transit is first.transit
    assert (again.part, again.threads) == (first.part, first.threads)
    assert again.optics.engine.transfer.tobytes() == first.optics.engine.transfer.tobytes()
    at = first.inversion.coordinates
    assert first.total.kernel(at).tobytes() == again.total.kernel(at).tobytes()


def test_a_fit_from_it_is_the_same_bit_for_bit(file: Path) -> None:
    again = read_solution(file, solved().transit, threads=2)
    sample = bootstrap_samples(len(solved().transit.frames), runs=1)[0]
    assert exact_fit(solved(), sample) == exact_fit(again, sample)


def test_the_same_solution_gives_the_same_file(file: Path, tmp_path: Path) -> None:
    write_solution(tmp_path / "again", read_solution(file, solved().transit))
    assert (tmp_path / "again").read_bytes() == file.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again"]


def test_numbers_that_are_not_finite_survive(tmp_path: Path) -> None:
    first = solved()
    frames = (dataclasses.replace(first.inversion.frames[0], chi2=float("inf")), *first.inversion.frames[1:])
    odd = dataclasses.replace(first, inversion=dataclasses.replace(first.inversion, frames=frames))
    write_solution(tmp_path / "odd", odd)
    assert read_solution(tmp_path / "odd", first.transit).inversion.frames[0].chi2 == float("inf")


def test_a_solution_of_other_images_is_refused(file: Path) -> None:
    transit = solved().transit
    fewer = dataclasses.replace(transit, frames=transit.frames[1:])
    with pytest.raises(DataError, match="this transit has 11 images") as refused:
        read_solution(file, fewer)
    assert refused.value.code == "bad-solution"


def test_a_solution_too_large_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "MOST_BYTES", 2**20)
    with pytest.raises(DataError) as refused:
        write_solution(tmp_path / "large", solved())
    assert refused.value.code == "solution-too-large" and list(tmp_path.iterdir()) == []


def test_a_file_too_large_is_not_opened(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "MOST_BYTES", 2**10)
    with pytest.raises(DataError, match="more than 1024 bytes"):
        read_solution(file, solved().transit)


def edited(**changes: Any) -> Callable[[Members], None]:
    def edit(members: Members) -> None:
        members["solution.json"] = json.dumps(json.loads(members["solution.json"]) | changes).encode()

    return edit


CHANGES = {
    "a later version": edited(version=2),
    "an unknown shape": edited(shape="cube"),
    "an image that the transit lacks": edited(part=[0, 1, 99]),
    "more images in the fit than results": edited(part=[0, 1]),
    "occulters missing": edited(found=[]),
    "no JSON": lambda members: members.update({"solution.json": b"{"}),
    "a missing array": lambda members: members.pop("covariance.npy"),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_changed_file_is_refused(file: Path, tmp_path: Path, change: Callable[[Members], object]) -> None:
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(tmp_path / "changed", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(DataError) as refused:
        read_solution(tmp_path / "changed", solved().transit)
    assert refused.value.code == "bad-solution"


def saved(tmp_path: Path, values: Any, **how: Any) -> bytes:
    with (tmp_path / "array").open("wb") as out:
        np.lib.format.write_array(out, values, **how)
    return (tmp_path / "array").read_bytes()


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("covariance", np.zeros((9, 9))),
        ("covariance", np.zeros((3, 3), np.float32)),
        ("covariance", np.zeros((3, 3), object)),
        ("dark-0000", np.full((2, 5), -1)),
        ("dark-0000", np.full((2, 5), 128)),
        ("dark-0000", np.zeros((3, 5), np.int64)),
        ("scene-0000", np.zeros(2**20, np.float32)),
    ],
    ids=str,
)
def test_another_array_is_refused(file: Path, tmp_path: Path, name: str, values: Any) -> None:
    changed = saved(tmp_path, values)
    test_a_changed_file_is_refused(file, tmp_path, lambda members: members.update({f"{name}.npy": changed}))


def test_compressed_and_damaged_files_are_refused(file: Path, tmp_path: Path) -> None:
    content = file.read_bytes()
    middle = len(content) // 2
    damaged = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    with (
        zipfile.ZipFile(file) as archive,
        zipfile.ZipFile(tmp_path / "z", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in archive.namelist():
            packed.writestr(name, archive.read(name))
    for bad in (damaged, content[:middle], b"", (tmp_path / "z").read_bytes()):
        (tmp_path / "bad").write_bytes(bad)
        with pytest.raises(DataError) as refused:
            read_solution(tmp_path / "bad", solved().transit)
        assert refused.value.code == "bad-solution"


def test_a_solution_is_handed_on_only_for_its_own_transit_and_shape() -> None:
    solution: Solution = solved()
    assert solution_of(solution.transit, SOFTENED_POWER_LAW, solution) is solution
    louder = dataclasses.replace(solution.transit.noise, read_noise_dn=9.0)
    others = (
        (dataclasses.replace(solution.transit, noise=louder), SOFTENED_POWER_LAW),
        (solved_noise_free().transit, SOFTENED_POWER_LAW),
        (observed(sky()).transit, SHAPES["stretched"]),
    )
    for transit, shape in others:
        with pytest.raises(DataError) as refused:
            solution_of(transit, shape, solution)
        assert refused.value.code == "other-solution"
