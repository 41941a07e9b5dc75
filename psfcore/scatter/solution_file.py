"""Write the solution of a transit to a file, and read it back without any change of its numbers.

The file is a NumPy archive (.npz, not compressed). It contains only what `invert` computed. Images, noise and
diffraction PSF come from the transit. A solution can therefore be read only together with the transit from which it was
made. The PSF at the solution is computed from the coordinates.

| array | content |
|---|---|
| contents | everything that is no array, as JSON |
| coordinates, covariance, curve_pct, curve_sigma | fields of Inversion |
| observed, expected, noise, chi2, normal, score | fields of FrameFit; first axis: frames of the fit |
| jacobian-0000, ... | FrameFit.jacobian of each frame of the fit; its number is that of the frame in the transit |
| scene-0000, ... | the scene of each frame of the transit, in the engine's order |
| dark-0000, ... | rows and columns of the dark pixels of each frame of the transit, (2, pixels) |
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from psfcore.arrays import Number
from psfcore.errors import DataError
from psfcore.files import whole_file
from psfcore.scatter.reconstruction import FrameFit, Inversion, Round, Solution, TransitScenes
from psfcore.scatter.scenes import Scenes
from psfcore.scatter.shapes import shape_named
from psfcore.scatter.total_psf import Optics, Pixels, TotalPsf
from psfcore.transit.occulter import FoundPlace
from psfcore.transit.transit import Transit

MOST_BYTES = 4 * 2**30  # of a file; S3 takes up to 5 GiB in one request
_CONTENTS = "contents"
_NUMBERS_OF_FRAMES = ("observed", "expected", "noise", "chi2")
_ARRAYS_OF_FRAMES = ("normal", "score")


@dataclass(frozen=True)
class _Contents:
    """The values of a stored solution that are not arrays.

    Attributes
    ----------
    found
        The place of the occulter in each frame of the transit.
    part
        The indices of the fitted frames.
    """

    version: Literal[2]
    shape: str
    field: tuple[int, int]
    files: tuple[str, ...]
    part: tuple[int, ...]
    found: tuple[FoundPlace, ...]
    rounds: tuple[Round, ...]
    converged: bool
    left_out: dict[str, str]


def write_solution(path: Path, solution: Solution) -> None:
    """Write a solution of `invert`, completely or not at all.

    Raises DataError "solution-too-large" above MOST_BYTES, and OSError.
    """
    inversion, transit, sky = solution.inversion, solution.transit, solution.sky
    contents = _Contents(
        version=2,
        shape=inversion.shape.name,
        field=transit.shape,
        files=tuple(frame.file for frame in transit.frames),
        part=solution.part,
        found=tuple(sky.found),
        rounds=inversion.rounds,
        converged=inversion.converged,
        left_out=inversion.left_out,
    )
    text = json.dumps(asdict(contents), default=lambda scalar: scalar.item())  # NumPy's scalars
    arrays: dict[str, NDArray[np.generic]] = {_CONTENTS: np.frombuffer(text.encode(), np.uint8)}
    for name in ("coordinates", "covariance", "curve_pct", "curve_sigma"):
        arrays[name] = getattr(inversion, name)
    for name in (*_NUMBERS_OF_FRAMES, *_ARRAYS_OF_FRAMES):
        arrays[name] = np.stack([np.asarray(getattr(frame, name)) for frame in inversion.frames])
    for n, (scene, dark) in enumerate(zip(sky.scenes, sky.dark, strict=True)):
        arrays |= {f"scene-{n:04d}": scene, f"dark-{n:04d}": np.stack(dark).astype(np.int64)}
    for n, frame in zip(solution.part, inversion.frames, strict=True):
        arrays[f"jacobian-{n:04d}"] = frame.jacobian
    size = sum(array.nbytes for array in arrays.values())
    if size > MOST_BYTES:
        raise DataError(
            "solution-too-large", f"expected a solution of at most {MOST_BYTES} bytes; got {size} bytes"
        )
    with whole_file(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_solution(path: Path, transit: Transit, *, threads: int = 1) -> Solution:
    """Read a solution from a file.

    Raises OSError, and DataError "bad-solution" if the file is damaged, has an unknown version, or belongs to another
    transit.

    Parameters
    ----------
    transit
        The transit from which the solution was made.
    """
    try:
        with path.open("rb") as file, NpzFile(file, allow_pickle=False) as archive:
            return _solution(archive, transit, threads)
    except ValidationError as error:
        first = error.errors()[0]
        why = f"{_CONTENTS}, {'.'.join(map(str, first['loc']))}: {first['msg']}"
    except DataError as error:  # an unknown shape
        why = error.message
    except (zipfile.BadZipFile, EOFError, KeyError, MemoryError, ValueError, NotImplementedError) as error:
        why = str(error)
    raise DataError("bad-solution", f"expected a kept solution of this transit, of file version 2: {why}")


def _array(archive: NpzFile, name: str, kind: type[Number], *shape: int | None) -> NDArray[Number]:
    """An array of the archive. None in `shape` allows any length. Raises ValueError if type or shape are others."""
    array = archive[name]
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.dtype != kind:
        raise ValueError(f"{name}: expected {shape} of {np.dtype(kind)}; got {array.shape} of {array.dtype}")
    return np.ascontiguousarray(array)


def _dark(archive: NpzFile, n: int, field: tuple[int, int]) -> Pixels:
    """The dark pixels of a frame, all inside the field."""
    pixels = _array(archive, f"dark-{n:04d}", np.int64, 2, None)
    if not ((pixels >= 0) & (pixels < np.array(field)[:, None])).all():
        raise ValueError(f"dark-{n:04d}: got pixels outside the images")
    rows, columns = pixels.astype(np.intp)
    return rows, columns


def _solution(archive: NpzFile, transit: Transit, threads: int) -> Solution:
    text = _array(archive, _CONTENTS, np.uint8, None).tobytes()
    contents = TypeAdapter(_Contents).validate_python(json.loads(text))
    _check_transit(contents, transit)
    shape = shape_named(contents.shape)
    size, images = len(shape.parameters), len(contents.part)
    total = TotalPsf(transit.diffraction, shape, transit.shape, threads=threads)
    radii = total.radii_px
    coordinates = _array(archive, "coordinates", np.float64, size)
    optics = Optics(total.kernel(coordinates), transit.shape, threads=threads)
    every, lanes = range(len(transit.frames)), optics.engine.lanes_shape
    scenes = Scenes(len(every), lanes)
    for n in every:
        scenes[n] = _array(archive, f"scene-{n:04d}", np.float32, *lanes)
    sky = TransitScenes(
        transit,
        scenes=scenes,
        found=list(contents.found),
        dark=[_dark(archive, n, transit.shape) for n in every],
    )
    numbers = [_array(archive, name, np.float64, images).tolist() for name in _NUMBERS_OF_FRAMES]
    lengths = ((size, size), (size,))
    arrays = [
        _array(archive, name, np.float64, images, *of_one)
        for name, of_one in zip(_ARRAYS_OF_FRAMES, lengths, strict=True)
    ]
    names = (*_NUMBERS_OF_FRAMES, *_ARRAYS_OF_FRAMES)
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
                jacobian=_array(archive, f"jacobian-{n:04d}", np.float64, size, sky.dark[n][0].size),
                **dict(zip(names, values, strict=True)),
            )
            for n, *values in zip(contents.part, *numbers, *arrays, strict=True)
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
