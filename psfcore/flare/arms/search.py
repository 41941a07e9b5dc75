"""First values of the arms' angles and of the spacing of their orders, found by a grid search.

The smooth part of the image is removed. At the correct angle and spacing, the remaining image is brighter at the orders
than halfway between the orders.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.flare.arms.image import Flags, Plane, smooth
from psfcore.flare.arms.orders import NEEDED_ORDERS_AN_ARM

_SEARCH_STEP_DEG = 0.25
_SEARCH_STEP_PX = 0.25
_APART_DEG = 4.0  # two arms are at least this far apart
_NEAR_DEG = 3.0  # an arm is searched within this distance of an angle that the caller gives
_CUT = 5.0  # largest contrast, in local standard deviations


def search_arms(
    difference: Plane,
    usable: Flags,
    centre: tuple[float, float],
    n_arms: int,
    spacing_range_px: tuple[float, float],
    angles_near_deg: tuple[float, ...] | None,
    radii_px: tuple[float, float],
) -> tuple[NDArray[np.float64], float]:
    """Return first values of the angles (degrees) and of the spacing (px).

    Along an arm, the orders are brighter than the pixels beside the arm and brighter than the pixels between the
    orders. At the returned spacing, the orders on the found arms are brighter than the pixels between the orders by the
    largest amount.
    """
    degrees = np.arange(-90.0, 90.0, _SEARCH_STEP_DEG)
    lit, seen = _along_lines(_contrast(difference, usable), usable, centre, degrees, radii_px)
    step = 2 * _SEARCH_STEP_PX / radii_px[1]
    low, high = spacing_range_px
    spacings = low * np.exp(np.arange(0.0, np.log(high / low) + step, step))
    scores = np.array([_scores(lit, seen, spacing, radii_px) for spacing in spacings])  # [spacing, 2, angle]
    found = _best_angles(degrees, scores.sum(axis=1).max(axis=0), n_arms, angles_near_deg)
    near = np.array([_between_deg(degrees, angle) <= 2 * _SEARCH_STEP_DEG for angle in found])
    between = np.array([scores[:, 1, here].max(axis=1) for here in near]).sum(axis=0)
    best = int(between.argmax())
    beside = scores[best].sum(axis=0)
    angles = [degrees[here][int(beside[here].argmax())] for here in near]
    return np.asarray(angles), float(spacings[best])


def _contrast(difference: Plane, usable: Flags) -> Plane:
    """The image without its smooth part, divided by its local standard deviation, clipped at +-_CUT; 0 where unusable."""
    detail = smooth(difference, usable, 0.7) - smooth(difference, usable, 5.0)
    scatter = np.sqrt(smooth(detail**2, usable, 15.0))
    ratio = np.divide(detail, scatter, out=np.zeros_like(detail), where=usable & (scatter > 0))
    return np.clip(ratio, -_CUT, _CUT)


def _along_lines(
    contrast: Plane,
    usable: Flags,
    centre: tuple[float, float],
    degrees: NDArray[np.float64],
    radii_px: tuple[float, float],
) -> tuple[Plane, Plane]:
    """The contrast and the number of usable pixels [angle, radius step], each summed over both sides of the centre."""
    radii = np.arange(0.0, radii_px[1], _SEARCH_STEP_PX)
    lit, seen = np.zeros((degrees.size, radii.size)), np.zeros((degrees.size, radii.size))
    cosine, sine = np.cos(np.deg2rad(degrees))[:, None], np.sin(np.deg2rad(degrees))[:, None]
    for side in (1, -1):
        where = (centre[1] + side * radii * sine, centre[0] + side * radii * cosine)
        lit += ndimage.map_coordinates(contrast, where, order=1, mode="constant")
        seen += ndimage.map_coordinates(usable.astype(np.float64), where, order=1, mode="constant")
    seen[:, radii < radii_px[0]] = 0
    lit[:, radii < radii_px[0]] = 0
    return lit, seen


def _scores(lit: Plane, seen: Plane, spacing: float, radii_px: tuple[float, float]) -> Plane:
    """Two scores [2, angle] that are large if orders lie at this spacing along this angle.

    The first is the summed contrast at the orders. The second is this sum minus the summed contrast between the orders.
    Each score is divided by the square root of its number of pixels. It is 0 if too few orders are usable.
    """
    orders = np.arange(1, int(radii_px[1] / spacing))
    at = np.rint(orders * spacing / _SEARCH_STEP_PX).astype(int)
    between = np.rint((orders + 0.5) * spacing / _SEARCH_STEP_PX).astype(int)
    between = between[between < lit.shape[1]]
    lit_at, lit_between = lit[:, at].sum(axis=1), lit[:, between].sum(axis=1)
    seen_at = seen[:, at].sum(axis=1)
    number = seen_at + seen[:, between].sum(axis=1)
    enough = seen_at >= NEEDED_ORDERS_AN_ARM
    none = np.zeros_like(lit_at)
    return np.stack(
        (
            np.divide(lit_at, np.sqrt(seen_at), out=none.copy(), where=enough),
            np.divide(lit_at - lit_between, np.sqrt(number), out=none, where=enough),
        )
    )


def _best_angles(
    degrees: NDArray[np.float64],
    score: NDArray[np.float64],
    n_arms: int,
    near_deg: tuple[float, ...] | None,
) -> NDArray[np.float64]:
    """The angles with the best scores, at least _APART_DEG apart.

    Their number is n_arms. If `near_deg` is given, there is one angle within _NEAR_DEG of each angle of `near_deg`.
    """
    found: list[float] = []
    for arm in range(n_arms if near_deg is None else len(near_deg)):
        allowed = np.ones(degrees.size, dtype=bool)
        if near_deg is not None:
            allowed = _between_deg(degrees, near_deg[arm]) <= _NEAR_DEG
        for other in found:
            allowed &= _between_deg(degrees, other) >= _APART_DEG
        found.append(float(degrees[int(np.where(allowed, score, -np.inf).argmax())]))
    return np.sort(np.asarray(found))


def _between_deg(a: NDArray[np.float64], b: float) -> NDArray[np.float64]:
    """Angle between two lines, 0 to 90 degrees."""
    return np.asarray(np.abs((a - b + 90.0) % 180.0 - 90.0))
