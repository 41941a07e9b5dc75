"""Search for the position or the template that explains most of the residuals.

A template f, displaced by d, changes the mean of disc n by

    T_n(d) = sum over pixels of q_n(x) f_n(x - d)          Eq. (1)

where q_n is the sensitivity of the disc (`cells`). This is a correlation, so one correlation gives all displacements.
Let r be the residuals of the discs that remain after the fit of the PSF. The template at d decreases chi2 by

    gain(d) = (sum r T)^2 / sum T^2                        Eq. (2)

if sum r T is positive, because these templates add light; otherwise the gain is 0. Here r and T are in units
of the noise, without the component that a change of the PSF can absorb. In the same way, a change K of the PSF changes
the mean of disc n by

    T_n = sum over displacements of K(d) C_n(d),   C_n(d) = sum over pixels of q_n(x) scene_n(x - d)     Eq. (3)

One correlation for each disc therefore serves any number of kernels K.

Ghosts (displaced copies of the image) and changes of the PSF core also change the distribution of light within the
discs: a wider core hardly changes the mean of a disc, but it changes the outermost cells. For them, r and T also
contain the cells, by Eqs. (1) and (3) in a small patch around each disc (`NearDisc`). The mean brightness of the disc
is removed from the responses of its cells, because it is known from the whole field. Light that scatters into the disc
from outside the patch is nearly uniform over the disc, so it is neglected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from psfcore.arrays import Matrix, Number, Vector, cut
from psfcore.convolution.convolver import correlations
from psfcore.gap.evidence.cells import cells_of, coarse_kernel, sensitivities, whitening
from psfcore.gap.evidence.linear_model import FLOOR
from psfcore.gap.evidence.unocculted_blocks import block_means
from psfcore.gap.view import Field, View
from psfcore.psf import crop_or_pad
from psfcore.scatter.total_psf import Optics

STEP_PX = 8
FINE_PX = 2
COARSE_BLUR_PX = 8.0
BLURS_PX = (2.0, 4.0, 8.0, 16.0)
# smallest displacement of a copy, in radii of the disc: a closer copy looks like the disc's surroundings
NEAREST_RADII = 1.8
KERNEL_REACH_PX = 255  # the orders of the mesh contain little light beyond this distance
MARGIN_PX = 28  # distance from the edge of the disc to the edge of its patch
NEAR_REACH_PX = 64  # largest displacement of light within a patch, along each axis
SEEN = 1e-4  # positions whose sum T^2 is below this fraction of the largest sum T^2 are skipped
UNSEEN = 1e-300


def place_search(view: View) -> PlaceSearch:
    """The search of a view. It is created once for each view."""
    return view.once("place_search", lambda: PlaceSearch(view))


class PlaceSearch:
    """The sensitivities of the discs and of their cells, computed once for any number of searches."""

    def __init__(self, view: View) -> None:
        solution, self._expected = view.solution, view.expected
        self._images = solution.part
        self._near = near_discs(view, self._images)
        self._planes, self._fine, to_displacements, to_far = [], [], [], []
        for n in self._images:
            dark = solution.sky.dark[n]
            plane = sensitivities(solution.optics, dark, np.full((1, dark[0].size), 1 / dark[0].size))[0]
            self._planes.append(block_means(plane, STEP_PX) * STEP_PX**2)
            self._fine.append(block_means(plane, FINE_PX) * FINE_PX**2)
            scene = solution.optics.field(view.occulted_scenes[n])
            to_displacements.append(_sums(plane[None].astype(np.float64), scene, KERNEL_REACH_PX)[0])
            to_far.append(_at_displacements(self._planes[-1], block_means(scene, STEP_PX)))
        self._to_displacements = np.array(to_displacements, dtype=np.float32)
        self._to_far = np.array(to_far)
        self._nearest_px = NEAREST_RADII * float(np.mean([f.place.radius_px for f in solution.sky.found]))
        frames = solution.inversion.frames
        self._sigma = np.array([np.hypot(f.noise, FLOOR * f.expected) for f in frames])
        responses = np.array([f.mean_jacobian for f in frames]) / self._sigma[:, None]
        residual = np.array([f.observed - f.expected for f in frames]) / self._sigma
        in_cells = self._of_cells(view.slope_kernels)
        self._of_means = _Unabsorbed(responses, residual)
        self._of_all = _Unabsorbed(
            np.concatenate([responses, in_cells]),
            np.concatenate([residual, *(near.residual for near in self._near)]),
        )

    def kernels(self, kernels: Sequence[Matrix]) -> Vector:
        """The gain, Eq. (2), of each change of the PSF: (kernels,).

        The search uses the means of the discs and, for light that moves near a disc, also the cells of this disc, Eq.
        (3).

        Parameters
        ----------
        kernels
            Changes of the PSF [y, x], with the centre at n // 2.
        """
        return self._gain(self._of_discs(self._to_displacements, kernels), self._of_cells(kernels))

    def wide_kernels(self, kernels: Sequence[Matrix]) -> Vector:
        """As `kernels`, for smooth changes of the PSF that may reach across the field. It uses only the means of the
        discs, not their cells, and coarse pixels.
        """
        return self._gain(self._of_discs(self._to_far, [coarse_kernel(one, STEP_PX) for one in kernels]))

    def _of_discs(self, to_displacements: NDArray[np.floating], kernels: Sequence[Matrix]) -> Matrix:
        """T of Eq. (3) for the means of the discs (discs, kernels)."""
        size, dtype = to_displacements.shape[1], to_displacements.dtype
        cropped = (crop_or_pad(kernel, size).astype(dtype) for kernel in kernels)
        return np.array([np.einsum("nyx,yx->n", to_displacements, kernel) for kernel in cropped], float).T

    def _of_cells(self, kernels: Sequence[Matrix]) -> Matrix:
        """T of Eq. (3) for the cells of all discs (cells, kernels), in units of their noise."""
        return np.array([np.concatenate([near.of_kernel(one) for near in self._near]) for one in kernels]).T

    @cached_property
    def copy(self) -> tuple[tuple[float, int, int], float]:
        """The blur (px) and the displacement (whole pixels x, y) of the copy of the image that explains most of the
        residuals; and the number of copies that the data distinguish.

        A copy is displaced by at least NEAREST_RADII times the radius of the disc. The search uses a coarse grid with
        one blur, then a fine grid around the best displacement with several blurs.
        """
        copies = (gaussian_filter(self._expected[n], COARSE_BLUR_PX) for n in self._images)
        both = zip(self._planes, copies, strict=True)
        means = np.array([_at_displacements(q, block_means(copy, STEP_PX)) for q, copy in both])
        along = (np.arange(means.shape[1]) - means.shape[1] // 2) * STEP_PX
        at = np.stack(np.meshgrid(along, along), axis=-1)
        far = np.hypot(at[..., 0], at[..., 1]) >= self._nearest_px
        gains = self._gain(means[:, far], least=SEEN)
        best = int(np.argmax(gains))
        dx, dy = at[far][best].tolist()
        found = [(*self._fine_displacement(blur_px, dx, dy), blur_px) for blur_px in BLURS_PX]
        gain, at_x, at_y, blur_px = max(found)
        # The means alone tell displacements apart less well than the means and the cells do.
        sharper = max(gain / max(float(gains[best]), UNSEEN), 1.0)
        apart = distinguished(gains * sharper) * distinguished(np.array([one[0] for one in found]))
        return (blur_px, at_x, at_y), apart

    def _fine_displacement(self, blur_px: float, dx: int, dy: int) -> tuple[float, int, int]:
        """The best gain and its displacement (x, y), among displacements within one coarse step of (dx, dy).

        The grid has a step of FINE_PX, and the gain contains the means and the cells of the discs.
        """
        reach, means, cells = STEP_PX // FINE_PX, [], []
        for n, q, near in zip(self._images, self._fine, self._near, strict=True):
            copy = gaussian_filter(self._expected[n], blur_px)
            coarse = block_means(copy, FINE_PX)
            means.append(_sums(q[None], coarse, reach, -dy // FINE_PX, -dx // FINE_PX).ravel())
            of_copies = near.of_copies(copy, dx, dy, STEP_PX)[:, ::FINE_PX, ::FINE_PX]
            cells.append(of_copies.reshape(of_copies.shape[0], -1))
        gain = self._gain(np.array(means), np.concatenate(cells), least=SEEN)
        best = int(np.argmax(gain))
        row, column = np.divmod(best, 2 * reach + 1)
        return float(gain[best]), dx + (int(column) - reach) * FINE_PX, dy + (int(row) - reach) * FINE_PX

    def _gain(self, means: Matrix, cells: Matrix | None = None, *, least: float = 0.0) -> Vector:
        """Eq. (2) for several templates (templates,).

        Parameters
        ----------
        means
            T of the means of the discs (discs, templates).
        cells
            T of the cells (cells, templates), in units of the noise; None: use the means alone.
        least
            A template gains 0 if its sum T^2 is below this fraction of the largest sum T^2.
        """
        responses, left = means / self._sigma[:, None], self._of_means
        if cells is not None:
            responses, left = np.concatenate([responses, cells]), self._of_all
        flat = left.of(responses)
        size, along = (flat**2).sum(axis=0), left.residual @ flat
        seen = size > max(least * float(size.max()), UNSEEN)
        return np.asarray(np.where(seen & (along > 0), along**2 / np.where(seen, size, 1.0), 0.0))


def distinguished(gains: Vector) -> float:
    """The effective number of templates that the data distinguish, from the gain of each of them (templates,).

    A search uses the template with the largest gain. The evidence is the mean over all templates, of which each is a
    priori equally probable. The evidence of the best one must therefore be divided by

        M / sum over templates of exp((gain - largest gain) / 2)                        Eq. (4)

    This is M if the data exclude all other templates, and 1 if all M templates explain the data equally well.
    """
    return float(gains.size / np.sum(np.exp((gains - gains.max()) / 2)))


class _Unabsorbed:
    """The component of residuals and responses that a change of the PSF cannot absorb, in units of the noise.

    Parameters
    ----------
    absorbed
        The responses to the coordinates of the PSF (n, coordinates).
    residual
        The residuals (n,).
    """

    def __init__(self, absorbed: Matrix, residual: Vector) -> None:
        self._absorbed = np.linalg.qr(absorbed)[0]
        self.residual: Vector = self.of(residual)

    def of(self, responses: Matrix) -> Matrix:
        """The component of the responses (n, templates) that a change of the PSF cannot absorb."""
        return np.asarray(responses - self._absorbed @ (self._absorbed.T @ responses))


# --- patches around the discs -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class NearDisc:
    """The cells of one disc, in a patch around it. All fields after `left` are in units of the noise of the cells,
    without the mean of the disc.

    Attributes
    ----------
    top, left
        The first pixel of the patch.
    planes
        The sensitivities of the cells (cells, y, x).
    residual
        The residuals of the cells (cells,).
    to_displacements
        The array C of Eq. (3) (cells, displacements y, displacements x).
    """

    top: int
    left: int
    planes: NDArray[np.float32]
    residual: Vector
    to_displacements: NDArray[np.floating]

    def of_kernel(self, change: Matrix) -> Vector:
        """The response of each cell to a change of the PSF, T of Eq. (3), (cells,).

        Parameters
        ----------
        change
            The change of the PSF [y, x], with the centre at [n // 2, n // 2].
        """
        near = crop_or_pad(change, 2 * NEAR_REACH_PX + 1).astype(np.float32)
        return np.asarray(np.tensordot(self.to_displacements, near, axes=2), dtype=np.float64)

    def of_copies(self, image: Field, dx: int, dy: int, reach_px: int) -> Matrix:
        """The response of each cell to each copy of an image [y, x], T of Eq. (1): (cells, copies y, copies x).

        The copies are displaced by (dx, dy) and up to reach_px more along each axis, in whole pixels.
        """
        return np.asarray(
            _sums(self.planes, image, reach_px, self.top - dy, self.left - dx), dtype=np.float64
        )


def near_discs(view: View, images: Sequence[int]) -> list[NearDisc]:
    """The patches around the discs of these images. All have the same size."""
    solution, shape = view.solution, view.solution.transit.shape
    radius_px = max(solution.sky.found[n].place.radius_px for n in solution.part)
    whole = 2 * math.ceil(radius_px + MARGIN_PX) + 1
    size = min(whole, shape[0]), min(whole, shape[1])
    # This kernel is large enough to connect any two pixels of a patch.
    small = Optics(crop_or_pad(view.kernel, 2 * max(size) - 1), size, threads=solution.threads)
    out = []
    for n in images:
        place, (rows, columns) = solution.sky.found[n].place, solution.sky.dark[n]
        top = int(np.clip(round(place.y_px) - size[0] // 2, 0, shape[0] - size[0]))
        left = int(np.clip(round(place.x_px) - size[1] // 2, 0, shape[1] - size[1]))
        weights = cells_of((rows, columns), place.x_px, place.y_px).weights
        planes = sensitivities(small, (rows - top, columns - left), weights)
        frame = solution.transit.frames[n]
        observed = cut(frame.pixels, top, left, size).astype(np.float64)
        variance = solution.transit.noise.variance(observed, frame.exposure_s)
        flat = planes.reshape(planes.shape[0], -1).astype(np.float64)
        residual, expected = solution.residual(n)
        white = whitening((flat * variance.ravel()) @ flat.T)
        along = white @ (weights @ expected)  # the mean of the disc, which is removed
        along /= max(float(np.linalg.norm(along)), 1e-300)
        white = white - np.outer(along, along @ white)
        planes = (white @ flat).astype(np.float32).reshape(planes.shape)
        scene = solution.optics.field(view.occulted_scenes[n])
        to_displacements = _sums(planes, scene, NEAR_REACH_PX, top, left)
        out.append(NearDisc(top, left, planes, white @ (weights @ residual), to_displacements))
    return out


# --- planes and kernels -------------------------------------------------------------------------------------


def _sums(
    planes: NDArray[np.floating], image: NDArray[np.floating], reach: int, top: int = 0, left: int = 0
) -> NDArray[np.floating]:
    """Eq. (1) for displacements up to `reach` along each axis: (planes, 2 reach + 1, 2 reach + 1), with d = 0 in the
    middle.

    The image is 0 outside its pixels.

    Parameters
    ----------
    planes
        The planes q (planes, y, x); their first pixel is the pixel [top, left] of the image.
    """
    ny, nx = planes.shape[1:]
    return correlations(
        planes, cut(image, top - reach, left - reach, (ny + 2 * reach, nx + 2 * reach)), reach
    )


def _at_displacements(plane: Matrix, image: Matrix) -> Matrix:
    """Eq. (1) for one plane, at all displacements at which at least two of its rows or columns overlap with the
    image.
    """
    return np.asarray(_sums(plane[None], image, max(plane.shape) - 2)[0])


def displaced(plane: NDArray[Number], dx: int, dy: int) -> NDArray[Number]:
    """A plane [y, x], moved by whole pixels. Pixels to which no pixel of the plane moves are 0."""
    return cut(plane, -dy, -dx, plane.shape)
