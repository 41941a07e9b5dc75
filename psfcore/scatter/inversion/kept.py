"""Write the solution of a transit to a file, and read it back without any change of its numbers.

The file is a zip archive without compression: one .npy file per array, and solution.json with everything else. It
contains only what `invert` computed. Images, noise and diffraction PSF come from the transit. A solution can therefore
be read only together with the transit from which it was made. The PSF at the solution is computed from the coordinates.

| array | content |
|---|---|
| coordinates, covariance, curve_pct, curve_sigma | fields of Inversion |
| normal, score, mean_jacobian | fields of FrameFit, first axis: the frames of the fit |
| scene-0000, ... | the scene of each frame of the transit, in the engine's order |
| dark-0000, ... | rows and columns of the dark pixels of each frame of the transit, (2, pixels) |
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from psfcore.errors import DataError
from psfcore.scatter.inversion.reconstruction import TransitScenes
from psfcore.scatter.inversion.results import FrameFit, Inversion, Round, Solution
from psfcore.scatter.optics import Optics, Pixels
from psfcore.scatter.shapes import Shape, shape_named
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.occulter import FoundPlace
from psfcore.transit.transit import Transit
from psfcore.whole_files import whole_file

MOST_BYTES = 4 * 2**30  # of a file; S3 takes up to 5 GiB in one request
MOST_JSON_BYTES = 2**24
_JSON = "solution.json"
_HEADER_BYTES = 4096  # no .npy header is longer


@dataclass(frozen=True)
class _FrameLight:
    """The scalar values of a FrameFit. Other files contain its arrays and its frame."""

    observed: float
    expected: float
    noise: float
    chi2: float


@dataclass(frozen=True)
class _Contents:
    """The content of solution.json. found: one entry for each frame of the transit. lights: one for each fitted frame."""

    version: Literal[1]
    shape: str
    field: tuple[int, int]
    files: tuple[str, ...]
    part: tuple[int, ...]
    found: tuple[FoundPlace, ...]
    lights: tuple[_FrameLight, ...]
    rounds: tuple[Round, ...]
    converged: bool
    left_out: dict[str, str]


_CONTENTS = TypeAdapter(_Contents)


def write_solution(path: Path, solution: Solution) -> None:
    """Write a solution of `invert`, completely or not at all.

    Raises DataError "solution-too-large" above MOST_BYTES, and OSError.
    """
    size = sum(array.nbytes for _, array in _arrays(solution)) + MOST_JSON_BYTES
    if size > MOST_BYTES:
        raise DataError(
            "solution-too-large", f"expected a solution of at most {MOST_BYTES} bytes; got up to {size} bytes"
        )
    with whole_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(_JSON), _as_json(solution))
        for name, array in _arrays(solution):
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), (1, 0), allow_pickle=False)


def _as_json(solution: Solution) -> str:
    inversion, transit = solution.inversion, solution.transit
    contents = _Contents(
        version=1,
        shape=inversion.shape.name,
        field=transit.shape,
        files=tuple(frame.file for frame in transit.frames),
        part=solution.part,
        found=tuple(solution.sky.found),
        lights=tuple(_FrameLight(f.observed, f.expected, f.noise, f.chi2) for f in inversion.frames),
        rounds=inversion.rounds,
        converged=inversion.converged,
        left_out=inversion.left_out,
    )
    return json.dumps(asdict(contents), default=lambda scalar: scalar.item())  # NumPy's scalars


def _arrays(solution: Solution) -> Iterator[tuple[str, NDArray[Any]]]:
    """All arrays of the file by name. Scenes come one by one, because they are large."""
    inversion, sky = solution.inversion, solution.sky
    for name in ("coordinates", "covariance", "curve_pct", "curve_sigma"):
        yield name, getattr(inversion, name)
    for name in ("normal", "score", "mean_jacobian"):
        yield name, np.stack([getattr(frame, name) for frame in inversion.frames])
    for n, scene in enumerate(sky.scenes):
        yield f"scene-{n:04d}", scene
    for n, dark in enumerate(sky.dark):
        yield f"dark-{n:04d}", np.stack(dark).astype(np.int64)


def read_solution(path: Path, transit: Transit, *, threads: int = 1) -> Solution:
    """Read a solution from a file. transit: the transit from which the solution was made.

    Raises OSError, and DataError "bad-solution" if the file is damaged, has an unknown version, or belongs to another
    transit.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"got a file of more than {MOST_BYTES} bytes")
        with zipfile.ZipFile(path) as archive:
            return _solution(_Members(archive), transit, threads)
    except (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError) as error:
        why = _first_line(error)
        raise DataError(
            "bad-solution", f"expected a kept solution of this transit, of file version 1: {why}"
        ) from error


def _first_line(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{_JSON}, {'.'.join(map(str, first['loc']))}: {first['msg']}"
    return str(error)


class _Members:
    """The members of an archive. A member is read only if it has the expected size; otherwise ValueError is raised."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive

    def contents(self) -> _Contents:
        """The content of solution.json."""
        contents = _CONTENTS.validate_python(json.loads(self._bytes(_JSON, MOST_JSON_BYTES)))
        assert isinstance(contents, _Contents)
        return contents

    def floats(self, name: str, *shape: int) -> NDArray[np.float64]:
        """An array of double precision."""
        return self._array(name, np.dtype(np.float64), shape)

    def scene(self, n: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """The scene of a frame."""
        return self._array(f"scene-{n:04d}", np.dtype(np.float32), shape)

    def dark(self, n: int, field: tuple[int, int]) -> Pixels:
        """The dark pixels of a frame, all inside the field."""
        name = f"dark-{n:04d}"
        size = self._info(f"{name}.npy").file_size
        rows, columns = self._array(
            name, np.dtype(np.int64), (2, None), most=min(size, 16 * field[0] * field[1])
        )
        for pixels, length in ((rows, field[0]), (columns, field[1])):
            if pixels.size and not (pixels.min() >= 0 and pixels.max() < length):
                raise ValueError(f"{name}: got pixels outside the images")
        return rows.astype(np.intp), columns.astype(np.intp)

    def _array(
        self, name: str, dtype: np.dtype[Any], shape: tuple[int | None, ...], most: int | None = None
    ) -> NDArray[Any]:
        """Read an array, and check its type and shape. None in `shape` allows any length, but at most `most` bytes in
        all."""
        sizes = [n for n in shape if n is not None]
        limit = int(np.prod(sizes)) * dtype.itemsize if most is None else most
        with self._open(f"{name}.npy", limit + _HEADER_BYTES) as member:
            if np.lib.format.read_magic(member) != (1, 0):
                raise ValueError(f"{name}: got an unknown version of .npy")
            found, by_columns, kind = np.lib.format.read_array_header_1_0(member)
            fits = len(found) == len(shape) and all(w in (None, n) for n, w in zip(found, shape, strict=True))
            if not fits or by_columns or kind != dtype:
                raise ValueError(f"{name}: expected {shape} of {dtype}; got {found} of {kind}")
            return np.frombuffer(member.read(), dtype).reshape(found).copy()

    def _bytes(self, name: str, most: int) -> bytes:
        with self._open(name, most) as member:
            return bytes(member.read())

    def _open(self, name: str, most: int) -> Any:
        """Open a member for reading. Raises ValueError if it has more than `most` bytes."""
        info = self._info(name)
        if info.compress_type != zipfile.ZIP_STORED or info.file_size > most:
            raise ValueError(
                f"{name}: expected at most {most} bytes without compression; got {info.file_size}"
            )
        return self._archive.open(info)

    def _info(self, name: str) -> zipfile.ZipInfo:
        try:
            return self._archive.getinfo(name)
        except KeyError as error:
            raise ValueError(f"got a file without {name}") from error


def _solution(members: _Members, transit: Transit, threads: int) -> Solution:
    contents = members.contents()
    _check_transit(contents, transit)
    shape = _shape(contents.shape)
    size, images = len(shape.parameters), len(contents.part)
    total = TotalPsf(transit.diffraction, shape, transit.shape, threads=threads)
    radii = total.radii_px
    coordinates = members.floats("coordinates", size)
    optics = Optics(total.kernel(coordinates), transit.shape, threads=threads)
    frames = range(len(transit.frames))
    sky = TransitScenes.restored(
        transit,
        optics,
        scenes=[members.scene(n, optics.engine.lanes_shape) for n in frames],
        found=list(contents.found),
        dark=[members.dark(n, transit.shape) for n in frames],
    )
    inversion = Inversion(
        shape=shape,
        coordinates=coordinates,
        covariance=members.floats("covariance", size, size),
        radii_px=radii,
        curve_pct=members.floats("curve_pct", radii.size),
        curve_sigma=members.floats("curve_sigma", radii.size),
        rounds=contents.rounds,
        converged=contents.converged,
        frames=tuple(
            _frame_fit(sky, n, light, normal.copy(), score.copy(), mean_jacobian.copy())
            for n, light, normal, score, mean_jacobian in zip(
                contents.part,
                contents.lights,
                members.floats("normal", images, size, size),
                members.floats("score", images, size),
                members.floats("mean_jacobian", images, size),
                strict=True,
            )
        ),
        left_out=contents.left_out,
    )
    return Solution(
        inversion=inversion,
        transit=transit,
        total=total,
        optics=optics,
        sky=sky,
        part=contents.part,
        threads=threads,
    )


def _check_transit(contents: _Contents, transit: Transit) -> None:
    files = tuple(frame.file for frame in transit.frames)
    if contents.files != files or contents.field != transit.shape:
        raise ValueError(
            f"got {len(contents.files)} images of {contents.field} px; this transit has {len(files)} images of "
            f"{transit.shape} px, or their names differ"
        )
    if len(contents.found) != len(files) or not all(0 <= n < len(files) for n in contents.part):
        raise ValueError("got occulters or images that the transit does not have")


def _shape(name: str) -> Shape:
    try:
        return shape_named(name)
    except DataError as error:
        raise ValueError(error.message) from error


def _frame_fit(
    sky: TransitScenes,
    n: int,
    light: _FrameLight,
    normal: NDArray[np.float64],
    score: NDArray[np.float64],
    mean_jacobian: NDArray[np.float64],
) -> FrameFit:
    frame = sky.transit.frames[n]
    return FrameFit(
        file=frame.file,
        pointing=frame.pointing,
        found=sky.found[n],
        dark=sky.dark[n],
        observed=light.observed,
        expected=light.expected,
        noise=light.noise,
        chi2=light.chi2,
        normal=normal,
        score=score,
        mean_jacobian=mean_jacobian,
    )
