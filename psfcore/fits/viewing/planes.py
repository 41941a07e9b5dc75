"""Decodes planes of FITS files for a viewer, and keeps them for some time for the many requests of a viewer.

A plane is decoded in a process of its own. Its values are those of the file after BSCALE, BZERO and BLANK are applied.
No pixel is divided by the exposure time or masked.

A decoded plane is stored in a file without a name in the folder of temporary files. The plane is not kept as an array
in memory, because many slow clients may read different planes at the same time. The system's page cache keeps the
pixels in memory as long as there is room. The disk space becomes free when the plane is no longer kept and nobody reads
it. This module loads no numerical library; only the decoding process needs one.
"""

from __future__ import annotations

import math
import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO
from weakref import WeakValueDictionary

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import LONGEST_TEXT, optional_text
from psfcore.fits.header import all_hdus, is_plane, read_summary
from psfcore.limited import run_limited

IMAGE = "image"
PIXEL_BYTES = 4
MOST_BYTES, MOST_PLANES = 2**27, 8

Key = tuple[str, str]  # SHA-256 of the file, and name of the plane


@dataclass(frozen=True)
class Decoded:
    """The shape (ny, nx) of a decoded plane, and its unit (BUNIT), if the file gives one."""

    shape: tuple[int, int]
    unit: str | None


class Plane:
    """A decoded plane: little-endian float32, row 0 first. Any number of threads may read it."""

    def __init__(self, path: Path, decoded: Decoded) -> None:
        """Open the file of the pixels, which may be removed afterwards. Raises OSError."""
        self.shape, self.unit = decoded.shape, decoded.unit
        self._handle = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._handle)

    @property
    def length(self) -> int:
        """Number of bytes of the pixels."""
        return self.shape[0] * self.shape[1] * PIXEL_BYTES

    def rows(self, first: int, count: int) -> bytes:
        """The pixels of ``count`` rows, starting at row ``first``. Raises EOFError if the file has become shorter."""
        row_bytes = self.shape[1] * PIXEL_BYTES
        read = os.pread(self._handle, count * row_bytes, first * row_bytes)
        if len(read) < count * row_bytes:
            raise EOFError(f"expected {count * row_bytes} bytes of a decoded plane; got {len(read)}")
        return read


class Planes:
    """Keeps the planes that were used last: at most MOST_PLANES planes, with at most MOST_BYTES together."""

    def __init__(self, temporary: Callable[[], AbstractContextManager[Path]]) -> None:
        """Keep no plane yet; `temporary` gives a path for a temporary file as a context manager, which removes the file
        at the end.
        """
        self._temporary = temporary
        self._kept: OrderedDict[Key, Plane] = OrderedDict()
        self._lock = threading.Lock()
        # The right to decode a plane.
        self._turns: WeakValueDictionary[Key, threading.Lock] = WeakValueDictionary()

    def kept(self, key: Key) -> Plane | None:
        """The plane, if it is still kept."""
        with self._lock:
            plane = self._kept.get(key)
            if plane is not None:
                self._kept.move_to_end(key)
            return plane

    def decoded(self, key: Key, decode: Callable[[BinaryIO], Decoded]) -> Plane:
        """The plane. If it is not kept, ``decode`` writes it to a file. Raises the errors of ``decode``.

        If several threads request the same plane at the same time, one of them decodes it and the others wait.
        """
        with self._lock:
            turn = self._turns.setdefault(key, threading.Lock())
        with turn:
            plane = self.kept(key)
            if plane is None:
                with self._temporary() as path, path.open("wb") as target:
                    plane = Plane(path, decode(target))
                with self._lock:
                    self._kept[key] = plane
                    while (
                        len(self._kept) > MOST_PLANES
                        or sum(one.length for one in self._kept.values()) > MOST_BYTES
                    ):
                        self._kept.popitem(last=False)
            return plane


def decode_plane(path: str | Path, name: str, limits: FitsLimits, target: BinaryIO) -> Decoded:
    """Write the pixels of a plane to ``target`` as little-endian float32, in the order of the FITS file (row 0 first).

    NaN stays NaN. Returns the shape and the unit of the plane. Raises HeaderError for an unusable header; DataError
    "unreadable-pixels" or "no-such-plane".

    Parameters
    ----------
    name
        Name of the plane: IMAGE for the first 2-D image of the file, or the name of a plane of a product, for example
        "quality".
    """
    hdu = None if name == IMAGE else _number_of_plane(path, name.upper(), limits)
    shape = read_summary(path, limits, hdu=hdu).shape
    answer = run_limited(write_pixels, path, target, pixels=math.prod(shape), hdu=hdu, limits=asdict(limits))
    return Decoded(shape, answer["unit"])


def write_pixels(
    target: BinaryIO, *, path: str, hdu: int | None, limits: dict[str, int]
) -> dict[str, object]:
    """Write the pixels of an image to ``target`` as little-endian float32; returns its unit. Call it in a limited
    process.
    """
    from psfcore.fits.hdus import ascii_text, read_pixels  # loads the numerical libraries

    stored = read_pixels(path, FitsLimits(**limits), hdu=hdu)
    target.write(stored.pixels.astype("<f4").data)
    unit = optional_text(stored.header, "BUNIT")
    return {"unit": None if unit is None else ascii_text(unit)[:LONGEST_TEXT]}


def _number_of_plane(path: str | Path, name: str, limits: FitsLimits) -> int:
    """The HDU of a plane of a product. Raises DataError "no-such-plane"."""
    planes = {hdu.name: hdu.number for hdu in all_hdus(path, limits)[1:] if is_plane(hdu)}
    if name not in planes:
        advice = ": submit the deconvolution with error_draws" if name == "ERROR" else ""
        raise DataError(
            "no-such-plane",
            f"expected a plane of this file ({', '.join([IMAGE, *map(str.lower, planes)])}); got "
            f"{name.lower()}{advice}",
        )
    return planes[name]
