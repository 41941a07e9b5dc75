"""The stray light of a flare along a diffraction arm: observed, and simulated with a PSF.

Hofmeister et al., The point-spread function of HRI_EUV, section "Solar flare". The core of a flare is saturated, so
its light must be fitted from the light that the PSF diffracts and scatters. The intensities x of a box of 7 x 7 px
around the centre are free:

    s(r) = sum over k of x_k h(r - p_k),   x_k >= 0                                          Eq. (1)
    minimise sum over u of ((s_u - d_u) / e_u)^2   with   mean s = mean d at 60 to 70 px     Eq. (2)

d is the flare image minus an image from before the flare. s_u and d_u are means over the pixels of a strip along the
arm, one mean for each distance u in steps of 1 px. If the noise of the camera is known, e_u is the noise of d_u, and
the sum is chi^2. Otherwise e_u = d_u, and the root of the mean of the terms is the percentage error that the paper
minimises. Non-negative least squares (Lawson and Hanson 1974, chapter 23) finds the minimum. The constraint is an
additional row with a large weight (their chapter 22).

Departure from the paper: the paper iterates "until the percentage root mean square error was minimized" and does not
say how. Here chi^2 is minimised if the noise is known, because beyond 60 px the percentage error of single pixels is
mostly noise.

What the comparison can show: x is fitted for each PSF separately, so the unknown flare does not make a PSF look wrong.
But x also compensates for scatter that is too strong or too weak at all distances. The comparison therefore tests only
the shape of the PSF: the light between the orders relative to the light in the orders.

| symbol | name | unit |
|---|---|---|
| d, e | difference, sigma | image unit |
| h | kernel | - |
| x | box [y, x] | image unit, of the scene |
| u | distance_px, along the arm from the centre | px |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import nnls

from psfcore.arrays import Flags, Plane, Vector, json_attributes
from psfcore.errors import DataError
from psfcore.psf import Psf
from psfcore.scatter.total_psf import DIFFRACTION, SCATTER

BOX_PX = 7
MATCHED_PX = (60.0, 70.0)
FITTED_PX = (10.0, 80.0)
# The strip is as wide as the box, so that it contains the orders of all pixels of the box.
HALF_WIDTH_PX = BOX_PX / 2
FEWEST_DISTANCES = 20
_CONSTRAINT_WEIGHT = 1e4
# A pixel with a smaller fraction of the light of the box does not count as a free parameter.
_USED_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class ArmProfile:
    """Light along an arm: the mean over the strip at each distance from the flare, and its noise if known.

    Attributes
    ----------
    rows, columns
        The pixels of the strip.
    member
        The index of the distance of each pixel.
    """

    centre_xy: tuple[int, int]
    arm_deg: float
    distance_px: Vector
    observed: Vector
    sigma: Vector | None
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    member: NDArray[np.intp]

    def mean(self, values: Vector) -> Vector:
        """Mean at each distance of `values`, which has one value per pixel of the strip."""
        count = np.bincount(self.member, minlength=self.distance_px.size)
        return np.asarray(np.bincount(self.member, values, minlength=self.distance_px.size) / count)


@dataclass(frozen=True, eq=False)
class FlareFit:
    """The light along an arm as simulated with one PSF, and the fitted flare.

    Attributes
    ----------
    box
        Light of the flare [y, x].
    simulated
        The simulated arm profile, s_u of the equations above.
    rms_pct
        Root mean square of 100 (s_u / d_u - 1) over the distances with d_u > 0.
    chi2_per_distance
        The sum in Eq. (2) divided by the number of distances; None if the noise is unknown.
    reduced_chi2
        The same sum divided by the degrees of freedom (number of distances - number of used pixels of the box + 1 for
        the constraint).
    matched
        Mean s divided by mean d at 60 to 70 px.
    matched_noise_pct
        The noise of mean d, in percent of mean d; the constraint treats mean d as exact.
    """

    box: Plane
    simulated: Vector
    rms_pct: float
    chi2_per_distance: float | None
    reduced_chi2: float | None
    used_pixels: int
    matched: float
    matched_noise_pct: float | None

    def as_json(self) -> dict[str, object]:
        """All fields as JSON values; `flare_light` is the sum of the box."""
        return {
            **json_attributes(self, "rms_pct", "chi2_per_distance", "reduced_chi2", "used_pixels"),
            "simulated_over_observed_where_matched": self.matched,
            "matched_noise_pct": self.matched_noise_pct,
            "flare_light": float(self.box.sum()),
            **json_attributes(self, "box", "simulated"),
        }


@dataclass(frozen=True, eq=False)
class FlareComparison:
    """The fits of the total PSF and of its diffraction PSF alone along one arm of one flare.

    Attributes
    ----------
    diffraction
        The fit of the diffraction PSF; None if the file of the PSF does not separate diffraction from scatter.
    explained
        The share of the changes beside the arm that the total PSF and its fitted box explain, see `explained_share`.
    """

    profile: ArmProfile
    total: FlareFit
    diffraction: FlareFit | None
    explained: float

    @property
    def rms_factor(self) -> float | None:
        """rms_pct of diffraction alone divided by rms_pct of the total PSF; None if diffraction is None."""
        return None if self.diffraction is None else self.diffraction.rms_pct / self.total.rms_pct

    @property
    def chi2_factor(self) -> float | None:
        """chi^2 of diffraction alone divided by chi^2 of the total PSF; None if one of the two is not known."""
        alone = None if self.diffraction is None else self.diffraction.chi2_per_distance
        if alone is None or not self.total.chi2_per_distance:
            return None
        return alone / self.total.chi2_per_distance

    def as_json(self) -> dict[str, object]:
        """The comparison as JSON, with the profile."""
        return {
            **json_attributes(self.profile, "centre_xy", "arm_deg", "distance_px", "observed", "sigma"),
            "total": self.total.as_json(),
            "diffraction": None if self.diffraction is None else self.diffraction.as_json(),
            **json_attributes(self, "rms_factor", "chi2_factor"),
            "explained_share_off_the_arm": self.explained,
        }


def flare_centre(difference: Plane, usable: Flags, usable_before: Flags) -> tuple[int, int]:
    """Position (x, y) of the flare, px.

    The position is the middle of the largest patch of pixels that are unusable in the flare image but usable in the
    image before. If there is no such patch, the position is the brightest pixel of the smoothed difference.

    Raises DataError "flare-no-light" if no pixel became brighter.

    Parameters
    ----------
    usable, usable_before
        True for the usable pixels of the flare image and of the image before.
    """
    labels, count = ndimage.label(~usable & usable_before, structure=np.ones((3, 3)))
    if count:
        y, x = np.nonzero(labels == np.bincount(labels.ravel())[1:].argmax() + 1)
        return round(float(x.mean())), round(float(y.mean()))
    smooth = ndimage.gaussian_filter(np.where(usable & usable_before, difference, 0.0), 1.0)
    if not smooth.max() > 0:
        raise DataError(
            "flare-no-light",
            "expected pixels brighter than in the image before; got none: check the order of the two images",
        )
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return int(column), int(row)


def arm_profile(
    difference: Plane,
    usable: Flags,
    centre_xy: tuple[int, int],
    arm_deg: float,
    *,
    variance: Plane | None = None,
    distances_px: tuple[float, float] = FITTED_PX,
) -> ArmProfile:
    """Profile along the arm that leaves the centre at `arm_deg`, degrees from +x towards +y.

    Distances at which less than half of the strip is usable are left out. Raises DataError "flare-bad-centre",
    "flare-short-arm".

    Parameters
    ----------
    variance
        The variance [y, x] of each pixel of the difference.
    """
    ny, nx = difference.shape
    if not (0 <= centre_xy[0] < nx and 0 <= centre_xy[1] < ny):
        raise DataError(
            "flare-bad-centre", f"expected a centre (x, y) on the image of {nx} x {ny} px; got {centre_xy}"
        )
    y, x = np.indices(difference.shape)
    angle = np.deg2rad(arm_deg)
    along = (x - centre_xy[0]) * np.cos(angle) + (y - centre_xy[1]) * np.sin(angle)
    across = -(x - centre_xy[0]) * np.sin(angle) + (y - centre_xy[1]) * np.cos(angle)
    distance = np.rint(along).astype(np.intp)
    strip = (np.abs(across) <= HALF_WIDTH_PX) & (distance >= distances_px[0]) & (distance <= distances_px[1])
    wanted = np.bincount(distance[strip], minlength=1)
    found = np.bincount(distance[strip & usable], minlength=wanted.size)
    kept = np.flatnonzero((found > 0) & (2 * found >= np.maximum(wanted, HALF_WIDTH_PX)))
    if kept.size < FEWEST_DISTANCES:
        raise DataError(
            "flare-short-arm",
            f"expected at least {FEWEST_DISTANCES} distances with usable pixels along the arm at {arm_deg:g} degrees "
            f"from {centre_xy}; got {kept.size}: choose another arm or a wider range of distances",
        )
    rows, columns = np.nonzero(strip & usable & np.isin(distance, kept))
    member = np.searchsorted(kept, distance[rows, columns])
    count = np.bincount(member)
    observed = np.bincount(member, difference[rows, columns]) / count
    sigma = None if variance is None else np.sqrt(np.bincount(member, variance[rows, columns])) / count
    return ArmProfile(
        centre_xy,
        arm_deg,
        kept.astype(np.float64),
        observed,
        sigma,
        rows=rows,
        columns=columns,
        member=member,
    )


def fit_flare(profile: ArmProfile, kernel: Plane) -> FlareFit:
    """Fit the intensities of the box so that the simulated profile matches the observed one, Eq. (2).

    Raises DataError "flare-no-light" if the mean difference at 60 to 70 px is not positive.

    Parameters
    ----------
    kernel
        A PSF [y, x], centre at [n // 2, n // 2].
    """
    # Each column is the profile of unit light in one pixel of the box.
    design = np.stack(
        [
            profile.mean(_at(kernel, profile.rows - row, profile.columns - column))
            for row, column, _ in _box(profile, np.zeros((BOX_PX, BOX_PX)))
        ],
        axis=1,
    )
    observed, sigma = profile.observed, profile.sigma
    matched = (profile.distance_px >= MATCHED_PX[0]) & (profile.distance_px <= MATCHED_PX[1])
    level = float(observed[matched].mean()) if matched.any() else 0.0
    if not level > 0:
        raise DataError(
            "flare-no-light",
            f"expected light of the flare at {MATCHED_PX[0]:g} to {MATCHED_PX[1]:g} px along the arm; "
            f"got a mean difference of {level:.3g} over {int(matched.sum())} distances: check the direction of the arm "
            "and the image before the flare",
        )
    # Without noise, d_u is the error, but at least a tenth of the level: a value near 0 would dominate the fit.
    error = sigma if sigma is not None else np.maximum(observed, 0.1 * level)
    constraint = design[matched].mean(axis=0)
    weight = _CONSTRAINT_WEIGHT * np.sqrt(observed.size) / level
    # The solver needs columns of similar size. Without scaling, the light of the box is about 1e7, and the columns
    # differ.
    scale = np.linalg.norm(design / error[:, None], axis=0)
    rows = np.vstack((design / error[:, None], weight * constraint)) / np.where(scale > 0, scale, 1.0)
    solved, _ = nnls(rows, np.append(observed / error, weight * level))
    box = (solved / np.where(scale > 0, scale, 1.0)).reshape(BOX_PX, BOX_PX)
    simulated, lit = design @ box.ravel(), observed > 0
    used = int(np.count_nonzero(box > _USED_SHARE * box.sum()))
    chi2 = noise_pct = None
    if sigma is not None:
        chi2 = float((((simulated - observed) / sigma) ** 2).sum())
        noise_pct = float(100 * np.sqrt((sigma[matched] ** 2).sum()) / np.count_nonzero(matched) / level)
    return FlareFit(
        box=box,
        simulated=simulated,
        rms_pct=float(100 * np.sqrt(np.mean((simulated[lit] / observed[lit] - 1) ** 2))),
        chi2_per_distance=None if chi2 is None else chi2 / observed.size,
        reduced_chi2=None if chi2 is None else chi2 / max(1, observed.size - used + 1),
        used_pixels=used,
        matched=float(simulated[matched].mean() / level),
        matched_noise_pct=noise_pct,
    )


def compare_on_flare(
    difference: Plane,
    usable: Flags,
    psf: Psf,
    centre_xy: tuple[int, int],
    arm_deg: float,
    *,
    variance: Plane | None = None,
    distances_px: tuple[float, float] = FITTED_PX,
) -> FlareComparison:
    """Compare the total PSF with the light along one arm of a flare.

    If the PSF has the components diffraction and scatter, the diffraction PSF alone is compared too.
    Raises the DataErrors of `arm_profile` and `fit_flare`.
    """
    profile = arm_profile(
        difference, usable, centre_xy, arm_deg, variance=variance, distances_px=distances_px
    )
    alone = psf.components.get(DIFFRACTION) if SCATTER in psf.components else None
    total = fit_flare(profile, psf.kernel)
    return FlareComparison(
        profile=profile,
        total=total,
        diffraction=None if alone is None else fit_flare(profile, alone),
        explained=explained_share(difference, usable, profile, total, psf.kernel, variance=variance),
    )


def explained_share(
    difference: Plane,
    usable: Flags,
    profile: ArmProfile,
    fit: FlareFit,
    kernel: Plane,
    *,
    variance: Plane | None = None,
) -> float:
    """The share of the changes around the flare that is explained by the stray light of the flare:

        1 - (sum (s - d)^2 - sum e^2) / (sum d^2 - sum e^2)

    The sums are over the pixels at the distances of the profile, without the strip along the arm. The share is 1 if all
    changes are stray light of the flare. It is 0 or less if the changes do not decrease when the simulated stray light
    is subtracted.
    """
    x0, y0 = profile.centre_xy
    near, far = profile.distance_px[[0, -1]]
    half = int(far) + 1
    top, left = max(0, y0 - half), max(0, x0 - half)
    window = np.s_[top : y0 + half + 1, left : x0 + half + 1]
    observed = difference[window]
    place: NDArray[np.intp] = np.indices(observed.shape) + np.array([top, left])[:, None, None]
    radius = np.hypot(place[0] - y0, place[1] - x0)
    counted = usable[window] & (radius >= near) & (radius <= far)
    counted[profile.rows - top, profile.columns - left] = False
    simulated = np.zeros(observed.shape)
    for row, column, light in _box(profile, fit.box):
        if light > 0:
            simulated += light * _at(kernel, np.asarray(place[0] - row), np.asarray(place[1] - column))
    noise = 0.0 if variance is None else float(variance[window][counted].sum())
    left_over = float(((simulated - observed)[counted] ** 2).sum()) - noise
    return 1 - left_over / max(float((observed[counted] ** 2).sum()) - noise, 1e-300)


def _box(profile: ArmProfile, box: Plane) -> list[tuple[int, int, float]]:
    """(row, column, light) of each pixel of the box."""
    half = box.shape[0] // 2
    x, y = profile.centre_xy
    return [(y + j - half, x + i - half, float(light)) for (j, i), light in np.ndenumerate(box)]


def _at(kernel: Plane, dy: NDArray[np.intp], dx: NDArray[np.intp]) -> Vector:
    """The kernel's weights at these offsets from its centre; 0 outside its array."""
    ny, nx = kernel.shape
    row, column = dy + ny // 2, dx + nx // 2
    there = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
    return np.where(there, kernel[np.where(there, row, 0), np.where(there, column, 0)], 0.0)
