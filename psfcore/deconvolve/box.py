"""A box of an image that is deconvolved alone. This module imports no numerical libraries, because the web process uses
it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from psfcore.errors import DataError

BOX = r"^\d{1,6}:\d{1,6},\d{1,6}:\d{1,6}$"
SMALLEST_BOX_PX = 16
LARGEST_ERROR = 0.05  # default of the largest bound of the error, as a share of the mean light of the box

Shape = tuple[int, int]


@dataclass(frozen=True)
class Box:
    """The pixels x0 <= x < x1 and y0 <= y < y1 of an image, counted from 0."""

    x0: int
    x1: int
    y0: int
    y1: int

    @classmethod
    def parse(cls, text: str) -> Box:
        """The box of a text "x0:x1,y0:y1". Raises DataError "bad-region"."""
        if not re.match(BOX, text):
            raise DataError(
                "bad-region",
                f'expected a region as x0:x1,y0:y1 in pixels, such as "100:400,50:250"; got {text!r:.60}',
            )
        x, y = (part.split(":") for part in text.split(","))
        return cls(int(x[0]), int(x[1]), int(y[0]), int(y[1]))

    def __str__(self) -> str:
        return f"{self.x0}:{self.x1},{self.y0}:{self.y1}"

    @property
    def slices(self) -> tuple[slice, slice]:
        """The rows and columns of the box, as indices of an array [y, x]."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    @property
    def shape(self) -> Shape:
        """(ny, nx) of the box."""
        return self.y1 - self.y0, self.x1 - self.x0

    def checked(self, shape: Shape) -> Box:
        """This box, if it lies in an image of this shape (ny, nx). Raises DataError "region-outside" or
        "region-too-small".
        """
        ny, nx = shape
        if not (0 <= self.x0 < self.x1 <= nx and 0 <= self.y0 < self.y1 <= ny):
            raise DataError(
                "region-outside",
                f"expected a region x0:x1,y0:y1 with 0 <= x0 < x1 <= {nx} and 0 <= y0 < y1 <= {ny}, the size of the "
                f"image; got {self}",
            )
        if min(self.shape) < SMALLEST_BOX_PX:
            raise DataError(
                "region-too-small",
                f"expected a region of at least {SMALLEST_BOX_PX} px per side; got {self.shape[1]} x {self.shape[0]} "
                "px",
            )
        return self

    def wider(self, width_px: int, shape: Shape, multiple: int = 1) -> Box:
        """The box with a rim, inside an image of this shape. The rim is widened until the corners are multiples."""
        ny, nx = shape
        return Box(
            max(0, (self.x0 - width_px) // multiple * multiple),
            min(nx, -(-(self.x1 + width_px) // multiple) * multiple),
            max(0, (self.y0 - width_px) // multiple * multiple),
            min(ny, -(-(self.y1 + width_px) // multiple) * multiple),
        )

    def inside(self, rim: Box) -> Box:
        """This box in the pixels of a wider box."""
        return Box(self.x0 - rim.x0, self.x1 - rim.x0, self.y0 - rim.y0, self.y1 - rim.y0)


def region_without_discrepancy() -> DataError:
    """The error for a request for a region with the stopping rule discrepancy."""
    return DataError(
        "region-discrepancy",
        "expected the stopping rule fixed with a region, because the rule discrepancy judges the whole image; got "
        "discrepancy: leave it out, or deconvolve the whole image",
    )


def region_without_errors(draws: int) -> DataError:
    """The error for a request for a region with an ERROR plane."""
    return DataError(
        "region-errors",
        "expected error_draws 0 with a region, because the noise of the light that is subtracted would be missing "
        f"in the errors; got {draws}: leave it out, or deconvolve the whole image",
    )
