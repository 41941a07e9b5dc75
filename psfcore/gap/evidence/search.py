"""Search for the position or the template that explains most of the residuals.

A template f, displaced by d, changes the mean of disc n by

    T_n(d) = sum over pixels of q_n(x) f_n(x - d)          Eq. (1)

where q_n is the sensitivity of the disc (`cells`). This is a correlation, so one correlation gives all displacements of a
coarse grid. Let r be the residuals of the discs that remain after the fit of the PSF. The template at d decreases chi2 by

    gain(d) = (sum r T)^2 / sum T^2                        Eq. (2)

if sum r T is positive, because these templates add light; otherwise the gain is 0. Here r and T are in units
of the noise, without the component that a change of the PSF can absorb. In the same way, a change K of the PSF changes
the mean of disc n by

    T_n = sum over displacements of K(d) C_n(d),   C_n(d) = sum over pixels of q_n(x) scene_n(x - d)     Eq. (3)

One correlation for each disc therefore serves any number of kernels K. Ghosts (displaced copies of the image) and changes
of the PSF core also change the distribution of light within the discs. For them, r and T also contain the cells
(`near_discs`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from psfcore.convolution.convolver import correlations, linear_convolve
from psfcore.gap.evidence.cells import sensitivities
from psfcore.gap.evidence.linear_model import FLOOR
from psfcore.gap.evidence.near_discs import NearDiscs, cut
from psfcore.gap.evidence.unocculted_blocks import block_means
from psfcore.gap.view import View
from psfcore.psf import crop_or_pad

Plane = NDArray[np.float64]
Vector = NDArray[np.float64]

STEP_PX = 8
FINE_PX = 2
COARSE_BLUR_PX = 8.0
BLURS_PX = (2.0, 4.0, 8.0, 16.0)
NEAREST_RADII = 1.8  # smallest displacement of a copy, in radii of the disc: a closer copy looks like the disc's surroundings
KERNEL_REACH_PX = 255  # the orders of the mesh contain little light beyond this distance
SEEN = 1e-4  # positions whose sum T^2 is below this fraction of the largest sum T^2 are skipped
UNSEEN = 1e-300


def place_search(view: View) -> PlaceSearch:
    """The search of a view. It is created once for each view."""
    return view.once("place_search", lambda: PlaceSearch(view))


class PlaceSearch:
    """The sensitivities of the discs and of their cells, computed once for any number of searches."""

    def __init__(self, view: View) -> None:
        solution, self._expected = view.solution, view.expected
        self._planes, self._fine = {}, {}
        to_displacements, to_far = [], []
        self._near = NearDiscs(view)
        for n in solution.part:
            dark = solution.sky.dark[n]
            (plane,) = sensitivities(solution.optics, dark, np.full((1, dark[0].size), 1 / dark[0].size))
            self._planes[n] = block_means(plane, STEP_PX) * STEP_PX**2
            self._fine[n] = block_means(plane, FINE_PX) * FINE_PX**2
            scene = solution.optics.field(view.occulted_scene(n))
            to_displacements.append(_correlation(plane, scene, KERNEL_REACH_PX))
            self._near.add(n, scene)
            reach = max(self._planes[n].shape) - 2
            to_far.append(_correlation(self._planes[n], block_means(scene, STEP_PX), reach))
        self._to_displacements = np.array(to_displacements, dtype=np.float32)
        self._to_far = np.array(to_far)
        self._nearest_px = NEAREST_RADII * float(np.mean([f.place.radius_px for f in solution.sky.found]))
        frames = solution.inversion.frames
        self._sigma = np.array([np.hypot(f.noise, FLOOR * f.expected) for f in frames])
        responses = np.array([f.mean_jacobian for f in frames]) / self._sigma[:, None]
        residual = np.array([f.observed - f.expected for f in frames]) / self._sigma
        in_cells = np.array([self._near.of_kernel(slope) for slope in view.slope_kernels]).T
        self._of_means = _Unabsorbed(responses, residual)
        self._of_all = _Unabsorbed(
            np.concatenate([responses, in_cells]), np.concatenate([residual, self._near.residual])
        )

    def kernels(self, kernels: Sequence[Plane]) -> Vector:
        """The gain, Eq. (2), of each change of the PSF: (kernels,).

        kernels: changes of the PSF [y, x], with the centre at n // 2. The search uses the means of the discs and, for light
        that moves near a disc, also its cells, Eq. (3).
        """
        cells = np.array([self._near.of_kernel(kernel) for kernel in kernels]).T
        return self._gains_of(self._to_displacements, kernels, cells)

    def wide_kernels(self, kernels: Sequence[Plane]) -> Vector:
        """As `kernels`, for smooth changes of the PSF that may reach across the field. It uses only the means of the discs, not their cells, and coarse pixels."""
        return self._gains_of(self._to_far, [coarse_kernel(kernel, STEP_PX) for kernel in kernels])

    def _gains_of(
        self, to_displacements: NDArray[np.floating], kernels: Sequence[Plane], cells: Plane | None = None
    ) -> Vector:
        size, dtype = to_displacements.shape[1], to_displacements.dtype
        of_discs = [
            np.einsum("nyx,yx->n", to_displacements, crop_or_pad(kernel, size).astype(dtype))
            for kernel in kernels
        ]
        means = np.array(of_discs, dtype=np.float64).T / self._sigma[:, None]
        return self._gain(means, cells)

    @cached_property
    def copy(self) -> tuple[float, int, int]:
        """The blur (px) and the displacement (whole pixels x, y) of the copy of the image that explains most of the residuals.

        A copy is displaced by at least NEAREST_RADII times the radius of the disc. The search uses a coarse grid with one blur,
        then a fine grid around the best displacement with several blurs.
        """
        dx, dy = self._coarse_displacement
        best = (-1.0, COARSE_BLUR_PX, dx, dy)
        for blur_px in BLURS_PX:
            gain, at_x, at_y = self._fine_displacement(blur_px, dx, dy)
            best = max(best, (gain, blur_px, at_x, at_y))
        return best[1:]

    @property
    def _coarse_displacement(self) -> tuple[int, int]:
        """The displacement (x, y) of the coarse grid with the largest gain."""
        rows, columns = (2 * n - 1 for n in next(iter(self._planes.values())).shape)

        def response(n: int, q: Plane) -> Plane:
            copy = block_means(gaussian_filter(self._expected[n], COARSE_BLUR_PX), STEP_PX)
            return linear_convolve(q, copy[::-1, ::-1], (rows, columns))

        dy, dx = (_displacements(n) for n in (rows, columns))
        gain = self._gains(response)
        gain[np.hypot(dy[:, None], dx[None, :]) < self._nearest_px] = -1.0
        row, column = np.unravel_index(np.argmax(gain), gain.shape)
        return int(dx[column]), int(dy[row])

    def _fine_displacement(self, blur_px: float, dx: int, dy: int) -> tuple[float, int, int]:
        """The best gain and its displacement (x, y), among displacements within one coarse step of (dx, dy).

        The grid has a step of FINE_PX, and the gain contains the means and the cells of the discs.
        """
        reach = STEP_PX // FINE_PX
        steps = [(j, k) for j in range(-reach, reach + 1) for k in range(-reach, reach + 1)]
        places = [(dx + k * FINE_PX, dy + j * FINE_PX) for j, k in steps]
        of_means, of_cells = [], []
        for n, q in self._fine.items():
            copy = gaussian_filter(self._expected[n], blur_px)
            coarse = block_means(copy, FINE_PX)
            of_means.append([along_copy(q, coarse, x // FINE_PX, y // FINE_PX) for x, y in places])
            of_cells.append(self._near.of_copies(n, copy, places))
        means = np.array(of_means) / self._sigma[:, None]
        gain = self._gain(means, np.concatenate(of_cells), least=SEEN)
        best = int(np.argmax(gain))
        return float(gain[best]), *places[best]

    def _gains(self, response: Callable[[int, Plane], Plane]) -> Plane:
        """Eq. (2) at every position of the coarse grid [y, x]."""
        responses = np.array(
            [response(n, q) / s for (n, q), s in zip(self._planes.items(), self._sigma, strict=True)]
        )
        gain = self._gain(responses.reshape(self._sigma.size, -1), least=SEEN)
        return np.asarray(gain.reshape(responses.shape[1:]))

    def _gain(self, means: Plane, cells: Plane | None = None, *, least: float = 0.0) -> Vector:
        """Eq. (2) for several templates (templates,).

        means: T of the means of the discs (discs, templates), in units of the noise. cells: T of the cells (cells, templates);
        None: use the means alone. least: a template gains 0 if its sum T^2 is below this fraction of the largest sum T^2.
        """
        left, responses = (
            (self._of_means, means) if cells is None else (self._of_all, np.concatenate([means, cells]))
        )
        flat = left.of(responses)
        size, along = (flat**2).sum(axis=0), left.residual @ flat
        seen = size > max(least * float(size.max()), UNSEEN)
        return np.asarray(np.where(seen & (along > 0), along**2 / np.where(seen, size, 1.0), 0.0))


def distinguished(gains: Vector) -> float:
    """The effective number of templates that the data distinguish, from the gain of each of them (templates,).

    A search uses the template with the largest gain. The evidence is the mean over all templates, of which each is a priori
    equally probable. The evidence of the best one must therefore be divided by

        M / sum over templates of exp((gain - largest gain) / 2)                        Eq. (4)

    This is M if the data exclude all other templates, and 1 if all M templates explain the data equally well.
    """
    return float(gains.size / np.sum(np.exp((gains - gains.max()) / 2)))


class _Unabsorbed:
    """The component of residuals and responses that a change of the PSF cannot absorb, in units of the noise.

    absorbed: the responses to the coordinates of the PSF (n, coordinates). residual: (n,).
    """

    def __init__(self, absorbed: Plane, residual: Vector) -> None:
        self._absorbed = np.linalg.qr(absorbed)[0]
        self.residual: Vector = self.of(residual)

    def of(self, responses: Plane) -> Plane:
        """The component of the responses (n, templates) that a change of the PSF cannot absorb."""
        return np.asarray(responses - self._absorbed @ (self._absorbed.T @ responses))


def _correlation(plane: NDArray[np.floating], scene: NDArray[np.floating], reach_px: int) -> Plane:
    """C of Eq. (3) for displacements up to reach_px along each axis: (2 reach + 1, 2 reach + 1), with d = 0 in the middle."""
    around = np.pad(scene.astype(np.float64), reach_px)
    return np.asarray(correlations(plane[None].astype(np.float64), around, reach_px)[0])


def coarse_kernel(kernel: Plane, step: int) -> Plane:
    """A kernel [y, x], binned: each coarse pixel is the sum of `step` x `step` pixels. Its centre is in the
    middle of a coarse pixel."""
    middle = kernel.shape[0] // 2
    reach = (middle + step // 2) // step
    at = (np.arange(kernel.shape[0]) - middle + step // 2) // step + reach
    out = np.zeros((2 * reach + 1,) * 2)
    keep = at <= 2 * reach
    np.add.at(out, np.ix_(at[keep], at[keep]), kernel[np.ix_(keep, keep)])
    return out


def _displacements(count: int) -> NDArray[np.intp]:
    """The displacement (px) at each index of the full correlation of two rows; each row has (count + 1) / 2 elements."""
    line = (count + 1) // 2
    zero = line - 1 - (2 * (line // 2) - count // 2)
    return (np.arange(count) - zero) * STEP_PX


def displaced(plane: Any, dx: int, dy: int) -> Any:
    """A plane [y, x], moved by whole pixels. Pixels to which no pixel of the plane moves are 0."""
    return cut(plane, -dy, -dx, plane.shape)


def along_copy(q: Plane, plane: Plane, dx: int, dy: int) -> float:
    """Eq. (1): the sum of q times `displaced(plane, dx, dy)`, without a copy of the plane."""
    (rows, from_rows), (columns, from_columns) = (
        (slice(max(by, 0), max(size + min(by, 0), 0)), slice(max(-by, 0), max(size - max(by, 0), 0)))
        for by, size in zip((dy, dx), q.shape, strict=True)
    )
    return float(np.einsum("yx,yx->", q[rows, columns], plane[from_rows, from_columns]))
