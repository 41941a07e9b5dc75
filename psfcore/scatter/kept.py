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
from psfcore.scatter.optics import Optics, Pixels
from psfcore.scatter.reconstruction import FrameFit, Inversion, Round, Solution, TransitScenes
from psfcore.scatter.shapes import shape_named
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.occulter import FoundPlace
from psfcore.transit.transit import Transit
from psfcore.whole_files import whole_file

MOST_BYTES = 4 * 2**30  # of a file; S3 takes up to 5 GiB in one request
MOST_JSON_BYTES = 2**24
_JSON = "solution.json"


@dataclass(frozen=True)
class _FrameLight:
    """The scalar values of a FrameFit. Arrays of the file and the transit contain its other fields."""

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
    text = json.dumps(asdict(contents), default=lambda scalar: scalar.item())  # NumPy's scalars
    with whole_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(_JSON), text)
        for name, array in _arrays(solution):
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), (1, 0), allow_pickle=False)


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
            if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
                raise ValueError("got a compressed member")
            return _solution(archive, transit, threads)
    except ValidationError as error:
        first = error.errors()[0]
        why = f"{_JSON}, {'.'.join(map(str, first['loc']))}: {first['msg']}"
    except DataError as error:  # an unknown shape
        why = error.message
    except (zipfile.BadZipFile, EOFError, KeyError, MemoryError, ValueError, NotImplementedError) as error:
        why = str(error)
    raise DataError("bad-solution", f"expected a kept solution of this transit, of file version 1: {why}")


def _array(archive: zipfile.ZipFile, name: str, kind: type, *shape: int | None) -> NDArray[Any]:
    """An array of the archive. None in `shape` allows any length. Raises ValueError if type or shape are others."""
    with archive.open(f"{name}.npy") as member:
        array = np.lib.format.read_array(member, allow_pickle=False)
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.dtype != kind:
        raise ValueError(f"{name}: expected {shape} of {np.dtype(kind)}; got {array.shape} of {array.dtype}")
    return np.ascontiguousarray(array)


def _dark(archive: zipfile.ZipFile, n: int, field: tuple[int, int]) -> Pixels:
    """The dark pixels of a frame, all inside the field."""
    rows, columns = _array(archive, f"dark-{n:04d}", np.int64, 2, None)
    for pixels, length in ((rows, field[0]), (columns, field[1])):
        if pixels.size and not (pixels.min() >= 0 and pixels.max() < length):
            raise ValueError(f"dark-{n:04d}: got pixels outside the images")
    return rows.astype(np.intp), columns.astype(np.intp)


def _solution(archive: zipfile.ZipFile, transit: Transit, threads: int) -> Solution:
    contents = _CONTENTS.validate_python(json.loads(archive.read(_JSON)))
    _check_transit(contents, transit)
    shape = shape_named(contents.shape)
    size, images = len(shape.parameters), len(contents.part)
    total = TotalPsf(transit.diffraction, shape, transit.shape, threads=threads)
    radii = total.radii_px
    coordinates = _array(archive, "coordinates", np.float64, size)
    optics = Optics(total.kernel(coordinates), transit.shape, threads=threads)
    every, lanes = range(len(transit.frames)), optics.engine.lanes_shape
    sky = TransitScenes(
        transit,
        observed=[optics.lanes(frame.pixels) for frame in transit.frames],
        scenes=[_array(archive, f"scene-{n:04d}", np.float32, *lanes) for n in every],
        found=list(contents.found),
        dark=[_dark(archive, n, transit.shape) for n in every],
    )
    inversion = Inversion(
        shape=shape,
        coordinates=coordinates,
        covariance=_array(archive, "covariance", np.float64, size, size),
        radii_px=radii,
        curve_pct=_array(archive, "curve_pct", np.float64, radii.size),
        curve_sigma=_array(archive, "curve_sigma", np.float64, radii.size),
        rounds=contents.rounds,
        converged=contents.converged,
        frames=tuple(
            FrameFit(
                file=transit.frames[n].file,
                pointing=transit.frames[n].pointing,
                found=sky.found[n],
                dark=sky.dark[n],
                normal=normal,
                score=score,
                mean_jacobian=mean_jacobian,
                **vars(light),
            )
            for n, light, normal, score, mean_jacobian in zip(
                contents.part,
                contents.lights,
                _array(archive, "normal", np.float64, images, size, size),
                _array(archive, "score", np.float64, images, size),
                _array(archive, "mean_jacobian", np.float64, images, size),
                strict=True,
            )
        ),
        left_out=contents.left_out,
    )
    return Solution(transit, total, optics, sky, contents.part, threads, inversion)


def _check_transit(contents: _Contents, transit: Transit) -> None:
    files = tuple(frame.file for frame in transit.frames)
    if contents.files != files or contents.field != transit.shape:
        raise ValueError(
            f"got {len(contents.files)} images of {contents.field} px; this transit has {len(files)} images of "
            f"{transit.shape} px, or their names differ"
        )
    if len(contents.found) != len(files) or not all(0 <= n < len(files) for n in contents.part):
        raise ValueError("got occulters or images that the transit does not have")
