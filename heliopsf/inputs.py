"""Images as users have them: files, HDUs, sunpy Maps, NDData and CCDData, arrays; and their regions. Each becomes an
``Image``.

This module does not import ``sunpy``, ``dask`` and ``astropy.nddata``. An object of one of their classes can exist only
if these modules are already loaded.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

import numpy as np
from astropy import units
from astropy.io import fits
from astropy.io.fits import Header
from numpy.typing import ArrayLike, NDArray

from heliopsf.parameters import COUNTS, Region, level_dn
from heliopsf.psfs import existing_file
from psfcore.deconvolve.box import Box
from psfcore.errors import DataError, DataWarning
from psfcore.fits.blocks import LIMITS
from psfcore.fits.cards import card_trouble, long_key, number_of, plain_value
from psfcore.fits.header import read_first_image, read_summary
from psfcore.fits.observation import (
    observation_of,
    observation_of_hdus,
    read_observation,
    real_pixels,
    stored_bits,
)
from psfcore.fits.saturation import with_saturation
from psfcore.fits.unusable import ERRORS, FLAGS
from psfcore.fits.viewing.regions import moved_header
from psfcore.image import Image

if TYPE_CHECKING:
    from astropy.nddata import NDData
    from astropy.wcs.wcsapi import BaseHighLevelWCS, SlicedLowLevelWCS

ImageHdu: TypeAlias = "fits.PrimaryHDU | fits.ImageHDU | fits.CompImageHDU"
_EXPECTED = (
    "a sunpy Map, an NDData, CCDData or NDCube, an array, a pair (array, header), an HDU or HDUList, a path or the "
    "bytes of a FITS file, or a list of these"
)
_HDUS = (fits.PrimaryHDU, fits.ImageHDU, fits.CompImageHDU)
_NO_VALUES = ("HISTORY", "KEYCOMMENTS", "COMMENT", "SIMPLE", "END", "")
_UNITS = {
    "XPOSURE": "s",
    "EXPTIME": "s",
    "WAVELNTH": "angstrom",
}  # of cards that a table may hold as quantities


@dataclass(frozen=True)
class _Parts:
    """An image in memory.

    Attributes
    ----------
    data
        The pixels, which may not be computed yet.
    planes
        Planes by name, as `psfcore.fits.unusable` names them.
    """

    data: Any
    header: Header
    planes: Mapping[str, ArrayLike | None]


def is_map(image: object) -> TypeGuard[NDData]:
    """Whether an object is a sunpy Map."""
    return _is_of(image, "sunpy.map", "GenericMap")


def is_nddata(image: object) -> TypeGuard[NDData]:
    """Whether an object is an NDData, such as a CCDData. A sunpy Map is also an NDData."""
    return _is_of(image, "astropy.nddata", "NDData")


def is_hdu(image: object) -> TypeGuard[ImageHdu]:
    """Whether an object is an HDU of images."""
    return isinstance(image, _HDUS)


def is_pair(image: object) -> TypeGuard[tuple[NDArray[np.generic], Mapping[str, object] | Header]]:
    """Whether an object is an array with its metadata: (array, header or table of cards)."""
    return isinstance(image, tuple) and len(image) == 2 and isinstance(image[1], Mapping | Header)


@contextmanager
def on_disk(image: object) -> Iterator[object]:
    """The path of a temporary file with the bytes of a FITS file; any other image unchanged."""
    if isinstance(image, bytes | bytearray | memoryview):
        with TemporaryDirectory() as folder:
            path = Path(folder) / "image.fits"
            path.write_bytes(image)
            yield path
    else:
        yield image


def is_sequence(image: object) -> bool:
    """Whether an object is a MapSequence of sunpy."""
    return _is_of(image, "sunpy.map", "MapSequence")


def is_many(image: object) -> bool:
    """Whether an object is a list of images: a list, a tuple, what ``Fido.fetch`` returns, or a MapSequence."""
    one = isinstance(image, str | bytes | bytearray | memoryview | fits.HDUList) or is_pair(image)
    return (isinstance(image, Sequence) and not one) or is_sequence(image)


def _is_of(image: object, module: str, name: str) -> bool:
    # While a module is imported, it has no classes yet.
    return isinstance(image, getattr(sys.modules.get(module), name, ()))


def image_of(image: object, *, saturation: object, hdu: int | None = None) -> Image:
    """The ``Image`` of psfcore for an image of the user.

    Pixels that the mask excludes are pixels without a value. Raises ``DataError`` "bad-input" for another kind of
    object, "bad-unit" for a logarithmic unit, and the errors of reading an image.

    Parameters
    ----------
    saturation
        The saturation level: a number of DN, or a quantity.
    """
    level = level_dn(saturation, {} if saturation is None else header_of(image, hdu))
    if isinstance(image, Image):
        return image if level is None else with_saturation(image, requested_dn=level)
    if isinstance(image, str | Path):
        return read_observation(image, LIMITS, saturation_dn=level, hdu=hdu)
    if is_hdu(image) or isinstance(image, fits.HDUList):
        number, hdus = _chosen(image, hdu)
        return observation_of_hdus(hdus, number, chosen=hdu, saturation_dn=level)
    parts = _parts_of(image)
    data = _computed(parts.data)
    return observation_of(
        real_pixels(data),
        parts.header,
        bits=stored_bits(data, parts.header),
        planes={
            name: _as_large(plane, data.shape) for name, plane in parts.planes.items() if plane is not None
        },
        saturation_dn=level,
    )


def _as_large(plane: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.generic]:
    """A mask or an uncertainty for every pixel. Raises ``DataError`` "mask-shape"."""
    try:
        return np.broadcast_to(plane, shape)
    except ValueError as error:
        message = f"expected a mask and an uncertainty of {shape}; got {np.shape(plane)}"
        raise DataError("mask-shape", message) from error


def uncertainty_of(image: object) -> NDArray[np.float64] | None:
    """The standard deviation [y, x] of an NDData in the unit of its pixels; None if it has none.

    Gives a ``DataWarning`` "uncertainty-dropped" for an uncertainty of an unknown kind.
    """
    if not is_nddata(image) or image.uncertainty is None:
        return None
    from astropy.nddata import StdDevUncertainty

    try:
        deviation = image.uncertainty.represent_as(StdDevUncertainty)
        unit = image.unit or units.dimensionless_unscaled
        return np.asarray(
            units.Quantity(deviation.array, deviation.unit or unit).to_value(unit), dtype=np.float64
        )
    except (TypeError, units.UnitsError) as error:
        warnings.warn(
            DataWarning(
                "uncertainty-dropped",
                f"the uncertainty of the image is not used: expected a standard deviation or variance; {error}",
            ),
            stacklevel=4,
        )
        return None


def shape_of(image: object, hdu: int | None = None) -> tuple[int, int]:
    """The shape (ny, nx) of an image of the user. No pixel of a file is read.

    Raises ``DataError`` "bad-input", "no-such-file" or "not-2d", and the errors of reading a header.
    """
    if isinstance(image, str | Path):
        return read_summary(existing_file(image), LIMITS, hdu=hdu).shape
    if is_hdu(image) or isinstance(image, fits.HDUList):
        shape = hdu_of(image, hdu).shape
    else:
        shape = image.pixels.shape if isinstance(image, Image) else np.shape(_parts_of(image).data)
    if len(shape) != 2:
        raise DataError("not-2d", f"expected an image with two axes; got {len(shape)}")
    return shape[0], shape[1]


def header_of(image: object, hdu: int | None = None) -> Header:
    """The header of an image of the user, or of its header alone (a ``Header`` or a table of cards).

    Raises ``DataError`` "bad-input", "bad-unit", "no-such-file", and the errors of reading a header.
    """
    if isinstance(image, Image):
        return image.header
    if isinstance(image, str | Path):
        return read_first_image(existing_file(image), LIMITS, hdu=hdu)[1].header
    if isinstance(image, Header):
        return image
    if is_hdu(image) or isinstance(image, fits.HDUList):
        return hdu_of(image, hdu).header.copy()
    return _header(image) if isinstance(image, Mapping) else _parts_of(image).header


def hdu_of(image: object, number: int | None = None) -> ImageHdu:
    """An HDU, or that of an HDUList as `_chosen` chooses it."""
    chosen, hdus = _chosen(image, number)
    return hdus[chosen]


def _chosen(image: object, number: int | None) -> tuple[int, dict[int, ImageHdu]]:
    """The number of the HDU, or of the first one with an image of two axes; and all such HDUs by their numbers.

    Raises ``DataError`` "three-axes" if an image of more axes comes first, "no-image" and "not-2d".
    """
    hdus = list(image) if isinstance(image, fits.HDUList) else [image]
    images = {n: one for n, one in enumerate(hdus) if is_hdu(one) and len(one.shape) == 2}
    for n, one in enumerate(hdus):
        wanted = n == number or (number is None and is_hdu(one) and len(one.shape) > 0)
        if wanted and n in images:
            return n, images
        if wanted and is_hdu(one):
            raise DataError(
                "three-axes" if len(one.shape) > 2 and len(hdus) > 1 else "not-2d",
                f"expected an image with two axes; HDU {n} has {len(one.shape)}: choose another HDU, or one plane of "
                "it",
            )
    raise DataError(
        "no-image",
        f"expected an HDU with an image of two axes; got {len(hdus)} HDUs, images in {list(images)}: "
        + ("choose one of these" if images else "use a file with an image"),
    )


def _parts_of(image: object) -> _Parts:
    """An image in memory with its header. Raises ``DataError`` "bad-input" and "bad-unit"."""
    image, meta = image if is_pair(image) else (image, {})
    header = _header(image.meta if is_nddata(image) else meta)
    if is_nddata(image):
        # ``CCDData.read`` takes the cards of the coordinates out of the header.
        if not is_map(image) and hasattr(image.wcs, "to_header"):
            header.extend(image.wcs.to_header(), strip=False, unique=True, end=True)
        known = getattr(image.uncertainty, "uncertainty_type", None) in ("std", "var")
        planes = {FLAGS[0]: image.mask, ERRORS[0]: image.uncertainty.array if known else None}
        parts = _Parts(image.data, header, planes)
    elif isinstance(image, np.ndarray):
        plain = getattr(image, "unmasked", image)
        plain = plain.value if isinstance(plain, units.Quantity) else plain
        parts = _Parts(np.asarray(plain), header, {FLAGS[0]: getattr(image, "mask", None)})
    elif _is_of(image, "dask.array", "Array"):
        parts = _Parts(image, header, {})
    else:
        raise DataError("bad-input", f"expected {_EXPECTED}; got {type(image).__name__}")
    # The unit is read even if the header gives one, because it may be logarithmic. That of a Map is the one of its
    # header.
    text = None if is_map(image) and "BUNIT" in header else unit_text(getattr(image, "unit", None))
    if text is not None:
        header.setdefault("BUNIT", text)
    return parts


def _computed(data: Any) -> NDArray[np.generic]:
    """The pixels. A dask array is computed, with a ``DataWarning`` "dask-computed"."""
    if not hasattr(data, "compute"):
        return np.asarray(data)
    warnings.warn(
        DataWarning(
            "dask-computed",
            f"the dask array of {' x '.join(map(str, data.shape[::-1]))} px is computed; the result is an array in "
            "memory",
        ),
        stacklevel=5,
    )
    return np.asarray(data.compute())


def unit_text(unit: units.UnitBase | units.function.FunctionUnitBase | None) -> str | None:
    """The value of the card BUNIT for a unit; adu and counts also become "DN". Raises ``DataError`` "bad-unit"."""
    if unit is None:
        return None
    logarithmic = {units.mag, units.dex, units.dB}
    if isinstance(unit, units.function.FunctionUnitBase) or logarithmic & set(getattr(unit, "bases", ())):
        raise DataError(
            "bad-unit",
            "expected pixels that are proportional to the light, such as DN or DN/s; got the logarithmic unit "
            f"{unit}: convert the pixels first",
        )
    pixel_free = unit * units.pix if units.pix in getattr(unit, "bases", ()) else unit
    for text, time in (("DN", units.dimensionless_unscaled), ("DN/s", units.s)):
        if any(pixel_free == count / time for count in COUNTS):
            return text
    return str(unit) or None


def _header(meta: Mapping[str, object] | Header) -> Header:
    """The cards of a table. Values that no card can hold are left out: such values do not describe the observation."""
    if isinstance(meta, Header):
        return meta.copy()
    header = Header()
    for key, value in meta.items():
        name = str(key).upper()
        with suppress(*card_trouble()):
            plain = (
                value.to_value(_UNITS.get(name, value.unit)) if isinstance(value, units.Quantity) else value
            )
            for line in str(plain).splitlines() if name == "HISTORY" else ():
                header.add_history(line)
            if name not in _NO_VALUES:
                header[long_key(name)] = plain_value(plain)
    return header


def box_of(region: Region, image: object, hdu: int | None = None) -> Box:
    """The pixels of a region of an image.

    Raises ``DataError`` "bad-region", "region-outside" or "region-too-small".

    Parameters
    ----------
    region
        The region: a text "x0:x1,y0:y1"; two slices [y, x], such as ``np.s_[50:250, 100:400]``; or, for a Map, its
        bottom left and top right corner as ``Map.submap`` takes them: coordinates, or quantities in pixels.
    """
    shape = shape_of(image, hdu)
    if isinstance(region, str):
        return Box.parse(region).checked(shape)
    two = isinstance(region, tuple | list) and len(region) == 2
    slices = [part for part in region if isinstance(part, slice)] if two else []
    if len(slices) == 2:
        steps = [part.step for part in slices if part.step not in (None, 1)]
        if steps:
            raise DataError("bad-region", f"expected slices without a step; got a step of {steps[0]}")
        (y0, y1, _), (x0, x1, _) = (part.indices(size) for part, size in zip(slices, shape, strict=True))
        return Box(x0, x1, y0, y1).checked(shape)
    if not two or not is_map(image):
        raise DataError(
            "bad-region",
            'expected a region as "x0:x1,y0:y1", as np.s_[y0:y1, x0:x1], or for a Map as its bottom left and top '
            "right corner; "
            f"got {region!r:.80}",
        )
    try:
        part = image.submap(region[0], top_right=region[1])
    except (ValueError, TypeError, AttributeError, units.UnitsError) as error:
        raise DataError(
            "bad-region", f"expected two corners that Map.submap accepts; it says: {error}"
        ) from error
    x0, y0 = (
        round(float((whole - cut).to_value(units.pix)))
        for whole, cut in zip(image.reference_pixel, part.reference_pixel, strict=True)
    )
    ny, nx = part.data.shape
    return Box(x0, x0 + nx, y0, y0 + ny).checked(shape)


def cut(image: object, box: Box, hdu: int | None = None) -> object:
    """The box of a Map, an NDData or an HDU, with its coordinates; other images unchanged."""
    if is_map(image):
        top_right = [box.x1 - 1, box.y1 - 1] * units.pix
        return image.submap([box.x0, box.y0] * units.pix, top_right=top_right)
    rows, columns = box.slices
    if is_nddata(image):
        return type(image)(
            image.data[box.slices],
            meta=_moved(image.meta, columns, rows),
            mask=None if image.mask is None else image.mask[box.slices],
            wcs=_part_of(image.wcs, box),
            unit=image.unit,
        )
    if isinstance(image, fits.HDUList):
        return fits.HDUList([cut(hdu_of(image, hdu), box)])
    if is_hdu(image):
        return type(image)(image.data[box.slices], moved_header(image.header, columns, rows))
    if is_pair(image):
        return image[0][box.slices], _moved(image[1], columns, rows)
    return image


def _part_of(wcs: BaseHighLevelWCS | None, box: Box) -> BaseHighLevelWCS | SlicedLowLevelWCS | None:
    """The coordinates of a box. Those of a slice of a cube are no ``WCS``, and have no slices of their own."""
    if wcs is None or hasattr(wcs, "to_header"):
        return None if wcs is None else wcs[box.slices]
    from astropy.wcs.wcsapi import SlicedLowLevelWCS

    return SlicedLowLevelWCS(wcs.low_level_wcs, box.slices)


def _moved(meta: Mapping[str, object] | Header, columns: slice, rows: slice) -> dict[str, object] | Header:
    """A header or a table of cards for these columns and rows."""
    if isinstance(meta, Header):
        return moved_header(meta, columns, rows)
    moved = dict(meta)
    for key, value in meta.items():
        name = str(key).upper()
        if name.startswith("CRPIX") and (at := number_of(value)) is not None:
            moved[key] = at - (columns if name[5:6] == "1" else rows).start
    return moved
