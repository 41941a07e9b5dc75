"""A PSF that changes over the field, from PSFs at places of the detector: of stars, of a design, or of another package.

At the places (u_i, v_i), the weights of each pixel of the PSF are fitted by least squares:

    min sum over i of (K_i - K0 - sum over m of u_i^a v_i^b K_m)^2        Eq. (1)

A power that the places do not determine is left out: of PSFs along one line, u and v cannot be told apart. A fit can
fall below 0 between the places or at the corners of the detector. The terms of such a pixel are made smaller, all by
one factor, until its lowest weight is 0. The central pixel of each plane keeps the sum of the plane.

| symbol | name |
|---|---|
| K_i | kernels of the given PSFs |
| K0, K_m, u, v, a, b | Eq. (1) of `psfcore.psf_field` |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np

from psfcore.arrays import Matrix
from psfcore.errors import DataError
from psfcore.psf import PLATE_SCALE_TOLERANCE, Psf
from psfcore.psf_field import MOST_POWERS, FieldTerm, Place, checked_places, common_shape, factors_at

# A power adds nothing if the places determine it to less than this share of its size.
_DETERMINED = 1e-3

Powers = tuple[int, int]


@dataclass(frozen=True)
class PlacedPsf:
    """A PSF at the pixel (x, y) of the detector, counted from 0."""

    psf: Psf
    x_px: float
    y_px: float


@dataclass(frozen=True)
class PlacesFit:
    """A PSF that changes over the field, fitted to PSFs at places.

    Attributes
    ----------
    misplaced
        For each given PSF, the share of its light that the fit puts elsewhere: half the sum of the absolute
        differences.
    left_out
        Powers (a, b) that the places do not determine.
    clipped
        Share of the light at the worst place that the fit had below 0.
    """

    psf: Psf
    misplaced: tuple[float, ...]
    left_out: tuple[Powers, ...]
    clipped: float


def fit_places(given: Sequence[PlacedPsf], detector: tuple[int, int], *, order: int = 1) -> PlacesFit:
    """Fit Eq. (1) with all powers whose sum is at most `order`.

    The fit has the name, the cards and the plate scale of the first PSF.

    Raises DataError "bad-order", "too-few-places", "psfs-differ", "place-outside", "places-too-close", and the errors
    of `Psf`.

    Parameters
    ----------
    detector
        Size (nx, ny) of the detector, px.
    """
    if not 1 <= order <= MOST_POWERS:
        raise DataError("bad-order", f"expected an order of 1 to {MOST_POWERS}; got {order}")
    first = given[0].psf if given else None
    if first is None or len({(one.x_px, one.y_px) for one in given}) < 2:
        raise DataError(
            "too-few-places", "expected PSFs at two places or more, each at another pixel: name more PSFs"
        )
    _check_alike(first, given, detector)
    place = Place.of_detector(*detector)
    places = np.array([place.from_pixel(one.x_px, one.y_px).coordinates((1, 1)) for one in given]).reshape(
        -1, 2
    )
    wanted = [(total - b, b) for total in range(1, order + 1) for b in range(total + 1)]
    powers = _determined(places, wanted)
    factors = np.array([[1.0, *(u**a * v**b for a, b in powers)] for u, v in places])
    kernels = np.array(common_shape([one.psf.kernel for one in given]))
    planes = np.tensordot(np.linalg.pinv(factors), kernels, 1)  # Eq. (1)
    clipped = raise_to_zero(planes, powers)
    found = np.tensordot(factors, planes, 1)
    misplaced = tuple(float(np.abs(one - other).sum() / 2) for one, other in zip(found, kernels, strict=True))
    terms = tuple(FieldTerm(plane, a, b) for plane, (a, b) in zip(planes[1:], powers, strict=True))
    psf = replace(
        first,
        kernel=planes[0],
        components={},
        fitted=None,
        field_terms=terms,
        place=place,
        provenance={
            "fitted to": f"PSFs at {len(given)} places of the detector of {detector[0]} x {detector[1]} px"
        },
    )
    return PlacesFit(psf, misplaced, tuple(one for one in wanted if one not in powers), clipped)


def read_array_psf(path: str | Path) -> list[PlacedPsf]:
    """The PSFs of an ArrayPSF of the package regularizepsf, each at the centre of its patch. Negative weights become 0,
    and each PSF gets the sum 1.

    Raises DataError "missing-package" if the package is not installed, and the errors of `Psf`.
    """
    try:
        module = import_module("regularizepsf")
    except ModuleNotFoundError as error:
        raise DataError(
            "missing-package",
            f"expected the package regularizepsf to read {Path(path).name}; {error}: pip install regularizepsf, or "
            "name PSFs in FITS files with their places, FILE@X,Y",
        ) from error
    loaded = module.ArrayPSF.load(Path(path))
    placed = []
    for (row, column), values in zip(loaded.coordinates, np.asarray(loaded.values, np.float64), strict=True):
        kernel = np.maximum(values, 0.0)
        psf = Psf(kernel / kernel.sum(), Path(path).stem, "unversioned", None, "user")
        ny, nx = kernel.shape
        placed.append(PlacedPsf(psf, float(column) + nx // 2, float(row) + ny // 2))
    return placed


def _check_alike(first: Psf, given: Sequence[PlacedPsf], detector: tuple[int, int]) -> None:
    nx, ny = detector
    for one in given:
        scales = (first.plate_scale_arcsec, one.psf.plate_scale_arcsec)
        differ = None not in scales and abs((scales[1] or 1) / (scales[0] or 1) - 1) > PLATE_SCALE_TOLERANCE
        if differ or one.psf.field_terms:
            raise DataError(
                "psfs-differ",
                f"expected PSFs without terms FIELD and with one plate scale; got {one.psf.name} with {scales[1]} "
                f"arcsec/px and {len(one.psf.field_terms)} terms, beside {scales[0]} arcsec/px: name PSFs of one kind",
            )
        if not (0 <= one.x_px <= nx - 1 and 0 <= one.y_px <= ny - 1):
            raise DataError(
                "place-outside",
                f"expected places on the detector of {nx} x {ny} px, counted from 0; got {one.x_px:g},{one.y_px:g}: "
                "correct the place, or the size of the detector",
            )


def _determined(places: Matrix, wanted: Sequence[Powers]) -> list[Powers]:
    """Those powers that the places determine, beside 1 and the powers before them."""
    basis = np.full((len(places), 1), len(places) ** -0.5)
    powers = []
    for a, b in wanted:
        column = places[:, 0] ** a * places[:, 1] ** b
        rest = column - basis @ (basis.T @ column)
        size = float(np.linalg.norm(rest))
        if size > _DETERMINED * max(float(np.linalg.norm(column)), 1e-9):
            basis = np.column_stack([basis, rest / size])
            powers.append((a, b))
    return powers


def raise_to_zero(planes: Matrix, powers: Sequence[Powers]) -> float:
    """Change the planes K0 and K_m so that no weight is below 0 on the detector; returns the share of the light that
    was below 0 at the worst place.

    Raises DataError "places-too-close" if the central weights would be below 0.
    """
    terms = [FieldTerm(plane, a, b) for plane, (a, b) in zip(planes[1:], powers, strict=True)]
    factors = factors_at(terms, checked_places(terms))
    centre = (planes.shape[1] // 2, planes.shape[2] // 2)
    sums = planes.sum(axis=(1, 2))
    lowest, below = planes[0].copy(), 0.0
    for of_place in factors:
        kernel = np.tensordot(of_place, planes, 1)
        below = max(below, -float(np.minimum(kernel, 0).sum()))
        np.minimum(lowest, kernel, out=lowest)
    np.maximum(planes[0], 0, out=planes[0])
    lifted = lowest < 0
    planes[1:, lifted] *= planes[0, lifted] / (planes[0, lifted] - lowest[lifted])
    planes[:, centre[0], centre[1]] += sums - planes.sum(axis=(1, 2))
    if (factors @ planes[:, *centre]).min() < 0:
        raise DataError(
            "places-too-close",
            "expected PSFs at places from which the PSF at the corners of the detector can be extrapolated; got "
            "central weights below 0 there: name PSFs nearer to the corners, or a lower --order",
        )
    return below
