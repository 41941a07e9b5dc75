"""The photon bound: the smallest standard errors that an analysis of a transit can reach.

The bound follows from the Fisher information F. The true scenes and the diffraction PSF are given. The only errors are
photon noise and read noise.

    F_jk = sum over pixels of (dm / dp_j) (dm / dp_k) / var(m)       Eq. (1)
    var(m) = (g m t + r^2) / t^2                                      Eq. (2)
    dm / dp_j = (ds / dp_j) * d * (S - h),  dm / dq = -s * d * (dh / dq)   Eq. (3)
    sigma^2(f) = (df / dp)^T F^-1 (df / dp)                           Eq. (4)

The information that one pixel contains about m is taken as 1 / var(m). An estimator that is linear in the pixel values
cannot use more. An estimator that uses the full likelihood can use slightly more: at most t / (g m), which is the
information of the photon count without read noise. This limit exceeds 1 / var(m) by the factor 1 + r^2 / (g m t).
For g = 6 DN, r = 2 DN and 2.5 photons (m t = 15 DN) the factor is 94 / 90, about 4 % more.

The data for the scatter are the fully dark pixels of every image: their four corners lie within the occulter's radius.
The bound and the fit do not use the pixels around the disc as data. The fit estimates the scene from these pixels; here
the scene is given. The data for the position of an occulter are the pixels whose centres lie at most 5 px beyond its
radius; the PSF is given. In high-only images, pixels that clip are left out.

| symbol | name | unit |
|---|---|---|
| m | expected pixel | DN/s |
| p | b, c, total; the stretch is fitted together with these three | px, -, -, - |
| q | x or y of the occulter's centre | px |
| f | any function of the parameters, for example a point of a curve | - |
| s, d | scatter kernel, diffraction PSF; * is linear convolution | - |
| S, h | scene, light that the disc hides | DN/s |
| g, r, t | photon_gain_dn, read_noise_dn, exposure_s | DN, DN, s |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfcore.arrays import Kernel, Plane
from psfcore.errors import DataError
from psfcore.psf import CURVE_RADII_PX, REACH_GRID_PX, cumulative_curve, encircled_energy
from psfcore.simulate.plan import HIGH
from psfcore.simulate.scatter_truth import (
    PARAMETERS,
    amplitude_slopes,
    anisotropic_kernel,
    convolved,
    kernel_slopes,
)
from psfcore.simulate.scene import seen_through
from psfcore.simulate.sky import TrueSky, fully_dark, on_field

Window = tuple[slice, slice]

PLACE_MARGIN_PX = 5.0
_LAW = 3  # number of parameters of the power law: b, c and total are the first three of PARAMETERS


@dataclass(frozen=True)
class CurveBound:
    """The light beyond one radius (1 - encircled energy), percent: of the total PSF, and of its scatter kernel alone.

    `total_sigma` and `diffuse_sigma` are the standard errors of the two, in percentage points.
    """

    radius_px: float
    total_pct: float
    total_sigma: float
    diffuse_pct: float
    diffuse_sigma: float


@dataclass(frozen=True)
class PhotonBound:
    """The smallest standard errors that photon noise and read noise allow.

    Attributes
    ----------
    b_px, c, total, a
        Errors of the parameters of the power law, fitted together.
    covariance
        Covariance matrix of b, c and total.
    stretch
        Error of the stretch along stretch_angle_deg, fitted together with b, c and total.
    places_px
        Errors of x and y of the occulter in each image, px.
    dark_pixels
        Number of fully dark pixels in all images.
    """

    images: int
    dark_pixels: int
    b_px: float
    c: float
    total: float
    a: float
    covariance: tuple[tuple[float, ...], ...]
    curve: tuple[CurveBound, ...]
    stretch: float
    stretch_angle_deg: float
    places_px: tuple[tuple[float, float], ...]

    def to_json(self) -> dict[str, object]:
        """Plain values, as `heliopsf simulate bound --json` writes them."""
        return {
            "images": self.images,
            "dark_pixels": self.dark_pixels,
            "sigma": {"b": self.b_px, "c": self.c, "total": self.total, "a": self.a},
            "covariance": [list(row) for row in self.covariance],
            "curve": [vars(at) for at in self.curve],
            "stretch": {"sigma": self.stretch, "angle_deg": self.stretch_angle_deg},
            "places": [{"x": x, "y": y} for x, y in self.places_px],
        }


def bound_of_sky(sky: TrueSky, *, threads: int = 1) -> PhotonBound:
    """The bound of any transit of `sky`; the noise realisation does not matter.

    Raises DataError "no-bound" if the dark pixels do not determine a parameter.
    """
    slopes = kernel_slopes(sky.scatter)
    sizes = (*[REACH_GRID_PX] * _LAW, sky.kernel.shape[0])  # the stretch is needed only near the discs
    total_slopes = {
        name: convolved(slope, sky.diffraction, size, threads=threads)
        for (name, slope), size in zip(slopes.items(), sizes, strict=True)
    }
    information, dark_pixels = _scatter_information(sky, total_slopes, threads)
    law = _inverse(information[:_LAW, :_LAW])
    with_stretch = _inverse(information)
    by_a = np.array(list(amplitude_slopes(sky.scatter).values())[:_LAW])
    sigmas = np.sqrt(np.diag(law))
    return PhotonBound(
        images=len(sky.plan.shots),
        dark_pixels=dark_pixels,
        b_px=float(sigmas[0]),
        c=float(sigmas[1]),
        total=float(sigmas[2]),
        a=float(np.sqrt(by_a @ law @ by_a)),
        covariance=tuple(tuple(float(value) for value in row) for row in law),
        curve=_curve(sky, law, slopes, total_slopes, threads),
        stretch=float(np.sqrt(with_stretch[-1, -1])),
        stretch_angle_deg=sky.scatter.angle_deg,
        places_px=tuple(_place_bound(sky, index) for index in range(len(sky.plan.shots))),
    )


def _scatter_information(sky: TrueSky, total_slopes: dict[str, Kernel], threads: int) -> tuple[Plane, int]:
    """F of Eq. (1) for PARAMETERS from the fully dark pixels, and the number of these pixels."""
    plan = sky.plan
    information, dark_pixels = np.zeros((len(PARAMETERS), len(PARAMETERS))), 0
    for pointing in plan.pointings:
        scene = sky.scenes[pointing]
        whole = {
            name: on_field(seen_through(kernel, scene, threads=threads), plan.margin_px)
            for name, kernel in total_slopes.items()
        }
        for index in (n for n, shot in enumerate(plan.shots) if shot.pointing == pointing):
            window = _window(sky, index)
            hidden = _hidden(sky, index, window)
            slopes = np.stack(
                [whole[name][window] - seen_through(total_slopes[name], hidden) for name in PARAMETERS]
            )
            expected = sky.seen_scenes[pointing][window] - seen_through(sky.kernel, hidden)
            dark = fully_dark(plan.place(index), _first(window), hidden.shape)
            variance = plan.noise.variance(expected[dark], plan.shots[index].exposure_s)  # Eq. (2)
            information += (slopes[:, dark] / variance) @ slopes[:, dark].T  # Eq. (1)
            dark_pixels += int(dark.sum())
    return information, dark_pixels


def _place_bound(sky: TrueSky, index: int) -> tuple[float, float]:
    """The errors of x and y (px) of the occulter in one image."""
    plan, shot = sky.plan, sky.plan.shots[index]
    place, window = plan.place(index), _window(sky, index)
    hidden = _hidden(sky, index, window)
    expected = sky.seen_scenes[shot.pointing][window] - seen_through(sky.kernel, hidden)
    by_place = []
    for slope in sky.behind[index].hidden_slopes(place):
        moved = np.zeros_like(hidden)
        moved[_inside(sky, index, window)] = slope
        by_place.append(-seen_through(sky.kernel, moved))  # Eq. (3)
    top, left = _first(window)
    y, x = np.mgrid[top : top + hidden.shape[0], left : left + hidden.shape[1]]
    used = np.hypot(x - place.x_px, y - place.y_px) <= place.radius_px + PLACE_MARGIN_PX
    if plan.saturation_dn is not None and shot.gain_mode == HIGH:
        used &= expected * shot.exposure_s + plan.dark_offset_dn < plan.saturation_dn
    slopes = np.stack(by_place)[:, used]
    variance = plan.noise.variance(expected[used], shot.exposure_s)
    sigma_x, sigma_y = np.sqrt(np.diag(_inverse((slopes / variance) @ slopes.T)))
    return float(sigma_x), float(sigma_y)


def _curve(
    sky: TrueSky, law: Plane, slopes: dict[str, Kernel], total_slopes: dict[str, Kernel], threads: int
) -> tuple[CurveBound, ...]:
    """1 - encircled energy of the total PSF and of the scatter kernel, with errors from Eq. (4)."""
    diffuse = anisotropic_kernel(sky.scatter, REACH_GRID_PX)
    total = convolved(diffuse, sky.diffraction, REACH_GRID_PX, threads=threads)
    radii = np.array(CURVE_RADII_PX)
    values = [cumulative_curve(kernel, radii) for kernel in (total, diffuse)]
    sigmas = []
    for parts in (total_slopes, slopes):
        by_law = np.stack([-100 * encircled_energy(parts[name], radii) for name in PARAMETERS[:_LAW]])
        sigmas.append(np.sqrt(np.einsum("jr,jk,kr->r", by_law, law, by_law)))  # Eq. (4)
    return tuple(
        CurveBound(
            radius_px=radius,
            total_pct=float(values[0][n]),
            total_sigma=float(sigmas[0][n]),
            diffuse_pct=float(values[1][n]),
            diffuse_sigma=float(sigmas[1][n]),
        )
        for n, radius in enumerate(CURVE_RADII_PX)
    )


def _inverse(information: Plane) -> Plane:
    """F^-1. The parameters are scaled first, so that the inverse is numerically accurate."""
    scale = np.sqrt(np.diag(information))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise DataError(
            "no-bound",
            "expected dark pixels that depend on every parameter; got a parameter that changes no dark pixel: simulate "
            "the transit with scatter (--total) and light",
        )
    correlation = information / np.outer(scale, scale)
    if np.linalg.cond(correlation) > 1 / np.finfo(np.float64).eps:
        raise DataError(
            "no-bound",
            "expected dark pixels that distinguish the parameters; got a singular matrix. Use more images or larger "
            "discs",
        )
    return np.asarray(np.linalg.inv(correlation) / np.outer(scale, scale))


def _window(sky: TrueSky, index: int) -> Window:
    """The part of the field around the occulter, as slices. It contains all pixels from which the position is
    measured.
    """
    place, size = sky.plan.place(index), sky.plan.size_px
    half = int(np.ceil(place.radius_px + PLACE_MARGIN_PX)) + 1
    row, column = int(np.rint(place.y_px)), int(np.rint(place.x_px))
    return (
        slice(max(0, row - half), min(size, row + half + 1)),
        slice(max(0, column - half), min(size, column + half + 1)),
    )


def _first(window: Window) -> tuple[int, int]:
    return window[0].start, window[1].start


def _inside(sky: TrueSky, index: int, window: Window) -> Window:
    """The part of a window that the occulter can hide."""
    rows, columns = sky.behind[index].window()
    top, left = _first(window)
    return slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)


def _hidden(sky: TrueSky, index: int, window: Window) -> Plane:
    """The light that the occulter hides in a window, DN/s."""
    plane = np.zeros((window[0].stop - window[0].start, window[1].stop - window[1].start))
    plane[_inside(sky, index, window)] = sky.behind[index].hidden(sky.plan.place(index))
    return plane
