"""Regions of the images of users: a text, two slices, or two corners as ``submap`` of sunpy takes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from astropy import units
from astropy.io.fits import Header

from heliopsf.inputs import is_map, is_nddata, shape_of
from psfcore.deconvolve.box import Box
from psfcore.errors import DataError
from psfcore.fits.viewing.regions import moved_header


def box_of(region: Any, image: Any) -> Box:
    """The pixels of a region of an image.

    region: a text "x0:x1,y0:y1"; two slices [y, x], such as ``np.s_[50:250, 100:400]``; or, for a Map, its bottom left
    and top right corner as ``Map.submap`` takes them: coordinates, or quantities in pixels.
    Raises ``DataError`` "bad-region", "region-outside" or "region-too-small".
    """
    shape = shape_of(image)
    if isinstance(region, str):
        return Box.parse(region).checked(shape)
    if not isinstance(region, tuple | list) or len(region) != 2:
        raise _bad(region)
    if all(isinstance(part, slice) for part in region):
        return _of_slices(region[0], region[1], shape).checked(shape)
    if not is_map(image):
        raise _bad(region)
    try:
        part = image.submap(region[0], top_right=region[1])
    except (ValueError, TypeError, AttributeError, units.UnitsError) as error:
        raise DataError(
            "bad-region", f"expected two corners that Map.submap accepts; it says: {error}"
        ) from error
    moved = (
        round(float((whole - cut).to_value(units.pix)))
        for whole, cut in zip(image.reference_pixel, part.reference_pixel, strict=True)
    )
    x0, y0 = moved
    ny, nx = part.data.shape
    return Box(x0, x0 + nx, y0, y0 + ny).checked(shape)


def cut(image: Any, box: Box) -> Any:
    """The box of a Map, an NDData or an array, with its coordinates; other images unchanged."""
    if is_map(image):
        corners = ((box.x0, box.y0), (box.x1 - 1, box.y1 - 1))
        bottom_left, top_right = (list(corner) * units.pix for corner in corners)
        return image.submap(bottom_left, top_right=top_right)
    if is_nddata(image):
        rows, columns = box.slices
        meta = image.meta
        return type(image)(
            image.data[box.slices],
            meta=moved_header(meta, columns, rows)
            if isinstance(meta, Header)
            else _moved(meta, columns, rows),
            wcs=None if image.wcs is None else image.wcs[box.slices],
            unit=image.unit,
        )
    return image


def _moved(meta: Mapping[str, Any], columns: slice, rows: slice) -> dict[str, Any]:
    """A table of cards for these columns and rows."""
    moved = dict(meta)
    for key, value in meta.items():
        name = str(key).upper()
        if name.startswith("CRPIX") and isinstance(value, int | float):
            moved[key] = value - (columns if name[5:6] == "1" else rows).start
    return moved


def _of_slices(rows: slice, columns: slice, shape: tuple[int, int]) -> Box:
    for part in (rows, columns):
        if part.step not in (None, 1):
            raise DataError("bad-region", f"expected slices without a step; got a step of {part.step}")
    (y0, y1, _), (x0, x1, _) = rows.indices(shape[0]), columns.indices(shape[1])
    return Box(x0, x1, y0, y1)


def _bad(region: Any) -> DataError:
    return DataError(
        "bad-region",
        'expected a region as "x0:x1,y0:y1", as np.s_[y0:y1, x0:x1], or for a Map as its bottom left and top right corner; '
        f"got {region!r:.80}",
    )
