"""A kept solution is read back bit for bit, and a file that is not one of this transit is refused."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.scatter import solution_file
from psfcore.scatter.inversion import solution_of
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.solution_file import read_solution, write_solution
from psfcore.transit.transit import Transit
from tests.psfcore.small_transits import observed, sky, solved, solved_noise_free


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


def test_a_solution_is_read_back_bit_for_bit_and_gives_the_same_file(file: Path, tmp_path: Path) -> None:
    first, again = solved(), read_solution(file, solved().transit)
    check_same(first.inversion, again.inversion)
    check_same(list(first.sky.scenes), list(again.sky.scenes))
    for name in ("found", "dark"):
        check_same(getattr(first.sky, name), getattr(again.sky, name))
    assert again.transit is again.sky.transit is first.transit
    assert (again.part, again.threads) == (first.part, first.threads)
    assert read_solution(file, first.transit, threads=2).threads == 2
    assert again.optics.engine.transfer.tobytes() == first.optics.engine.transfer.tobytes()
    at = first.inversion.coordinates
    assert first.total.kernel(at).tobytes() == again.total.kernel(at).tobytes()
    # A number that is not finite survives too.
    again = read_solution(file, solved().transit)
    write_solution(tmp_path / "again", again)
    assert (tmp_path / "again").read_bytes() == file.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again"]
    frames = (dataclasses.replace(again.inversion.frames[0], chi2=math.inf), *again.inversion.frames[1:])
    odd = dataclasses.replace(again, inversion=dataclasses.replace(again.inversion, frames=frames))
    write_solution(tmp_path / "odd", odd)
    assert read_solution(tmp_path / "odd", solved().transit).inversion.frames[0].chi2 == math.inf


def refusal(path: Path, transit: Transit | None = None) -> str:
    """The code of the refusal of a file."""
    with pytest.raises(DataError) as caught:
        read_solution(path, transit or solved().transit)
    return caught.value.code


def test_a_file_too_large_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solution_file, "MOST_BYTES", 2**10)
    with pytest.raises(DataError) as caught:
        write_solution(tmp_path / "large", solved())
    assert caught.value.code == "solution-too-large" and list(tmp_path.iterdir()) == []


CONTENTS: tuple[dict[str, Any], ...] = (
    {"version": 1},
    {"shape": "cube"},
    {"part": [0, 1, 99]},  # an image that the transit lacks
    {"part": [0, 1]},  # fewer images than results
    {"found": []},
)
ARRAYS: tuple[tuple[str, Any], ...] = (
    ("contents", np.frombuffer(b"{", np.uint8)),
    ("covariance", None),
    ("covariance", np.zeros((9, 9))),
    ("covariance", np.zeros((3, 3), np.float32)),
    ("covariance", np.zeros((3, 3), object)),
    ("dark-0000", np.full((2, 5), -1)),
    ("dark-0000", np.full((2, 5), 128)),
    ("dark-0000", np.zeros((3, 5), np.int64)),
    ("jacobian-0000", np.zeros((3, 5))),
    ("scene-0000", np.zeros(2**20, np.float32)),
)


def test_changed_and_damaged_files_and_other_images_are_refused(file: Path, tmp_path: Path) -> None:
    transit = solved().transit
    assert refusal(file, dataclasses.replace(transit, frames=transit.frames[1:])) == "bad-solution"
    with np.load(file) as archive:
        arrays = dict(archive)
    contents = json.loads(arrays["contents"].tobytes())
    cases = list(ARRAYS)
    for change in CONTENTS:
        text = json.dumps(contents | change).encode()
        cases.append(("contents", np.frombuffer(text, np.uint8)))
    for name, array in cases:
        other = {key: value for key, value in (arrays | {name: array}).items() if value is not None}
        np.savez(tmp_path / "changed.npz", **other)
        assert refusal(tmp_path / "changed.npz") == "bad-solution", (name, array)
    content = file.read_bytes()
    middle = len(content) // 2
    damaged = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    for bad in (damaged, content[:middle], b""):
        (tmp_path / "bad").write_bytes(bad)
        assert refusal(tmp_path / "bad") == "bad-solution"


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
        with pytest.raises(DataError, match="other-solution"):
            solution_of(transit, shape, solution)
