"""The sky of a simulated transit, the light that the dark disc hides, and the noise-free images.

    I_i = P (S_f - h_i)        Eq. (1)

P is the convolution with the total PSF, which is cut to the reach of 2048 x 2048 px. Because P is linear, the scene of
a pointing is convolved once for all its images; only the hidden light is convolved for each image.

| symbol | name | unit |
|---|---|---|
| S_f | scenes[f]: constant scene of pointing f, including the margins beyond the field | DN/s |
| P S_f | seen_scenes[f]: convolved scene | DN/s |
| h_i | Behind.hidden: light that the disc hides in image i | DN/s |
| I_i | expected(i): noise-free image i | DN/s |

The share of a pixel behind the disc is exact: the area of the intersection of the disc and the square pixel.
F(x, y) is the area of the part of the disc that lies left of x and below y. In closed form:

    share = F(x1, y1) - F(x0, y1) - F(x1, y0) + F(x0, y0)                              Eq. (2)
    F(x, y) = integral from -r to x of max(0, min(y, s) + s) dX,  s = sqrt(r^2 - X^2)   Eq. (3)

| symbol | name | unit |
|---|---|---|
| x0, x1, y0, y1 | edges of a pixel, from the disc's centre | px |
| r | radius_px | px |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from psfcore.arrays import Flags, Kernel, Plane, squares
from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX
from psfcore.simulate.plan import Plan
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from psfcore.simulate.scene import drawn_scene, seen_through
from psfcore.transit.transit import Place

_SUM_TOLERANCE = 1e-3
_PLACE_STEP_PX = 1e-3
_ROUNDING = 1e-11  # rounding error of a share, which is a difference of areas of about 100 px^2


@dataclass(frozen=True, eq=False)
class TrueSky:
    """Scenes, occulter and PSF of a transit; all planes float64 [y, x] in DN/s on detector pixels.

    Attributes
    ----------
    diffraction, kernel
        Weights [y, x] of the diffraction PSF and of the total PSF, centre at [n // 2, n // 2]. The array of the total
        PSF has twice the edge of the scenes, at most the full reach.
    scenes
        The scene of each pointing, plan.margin_px larger than the field on each side.
    seen_scenes
        The scene of each pointing without the occulter, convolved with the PSF, on the field.
    behind
        For each image, the patch of the scene around the occulter.
    """

    plan: Plan
    scatter: ScatterTruth
    diffraction: Kernel
    kernel: Kernel
    scenes: Mapping[int, Plane]
    seen_scenes: Mapping[int, Plane]
    behind: tuple[Behind, ...]
    seed: int
    threads: int = 1

    def expected(self, index: int) -> Plane:
        """The noise-free image `index` from Eq. (1), on the pixels of the field."""
        around = self.behind[index]
        hidden = np.zeros((self.plan.size_px, self.plan.size_px))
        hidden[around.window()] = around.hidden(self.plan.place(index))
        seen = self.seen_scenes[self.plan.shots[index].pointing]
        return np.asarray(seen - self._hiding.apply(hidden))  # Eq. (1)

    @cached_property
    def _hiding(self) -> Convolver:
        field = (self.plan.size_px, self.plan.size_px)
        return Convolver(self.kernel, field, dtype=np.float64, threads=self.threads)


def true_sky(
    plan: Plan,
    scatter: ScatterTruth,
    diffraction: Kernel,
    seed: int,
    *,
    scenes: Mapping[int, Plane] | None = None,
    threads: int = 1,
) -> TrueSky:
    """The sky of a plan. Without `scenes`, the scenes are synthetic and follow from `seed`.

    Raises DataError "bad-diffraction", "bad-scene".

    Parameters
    ----------
    scenes
        A scene for each pointing, in the form that scene_from_image returns.
    diffraction
        The diffraction PSF: weights [y, x], centre at [n // 2, n // 2], sum 1.
    """
    _check_diffraction(diffraction)
    whole_px = plan.size_px + 2 * plan.margin_px
    kernel = total_kernel(scatter, diffraction, min(REACH_GRID_PX, 2 * whole_px), threads=threads)
    coarse: dict[int, Plane] = {}
    seen: dict[int, Plane] = {}
    around: dict[int, Behind] = {}
    for pointing in plan.pointings:
        fine = drawn_scene(plan, pointing, seed) if scenes is None else _checked_scene(scenes, pointing, plan)
        for index in (n for n, shot in enumerate(plan.shots) if shot.pointing == pointing):
            around[index] = behind(fine, plan.place(index), fine=plan.oversampling, margin_px=plan.margin_px)
        coarse[pointing] = binned(fine, plan.oversampling)
        del fine
        whole = seen_through(kernel, coarse[pointing], threads=threads)
        seen[pointing] = on_field(whole, plan.margin_px).copy()
    return TrueSky(
        plan=plan,
        scatter=scatter,
        diffraction=diffraction,
        kernel=kernel,
        scenes=coarse,
        seen_scenes=seen,
        behind=tuple(around[index] for index in range(len(plan.shots))),
        seed=seed,
        threads=threads,
    )


def on_field(plane: Plane, margin_px: int) -> Plane:
    """The part of a plane that lies on the field: the plane without its margins."""
    ny, nx = plane.shape
    return plane[margin_px : ny - margin_px, margin_px : nx - margin_px]


def _checked_scene(scenes: Mapping[int, Plane], pointing: int, plan: Plan) -> Plane:
    edge = (plan.size_px + 2 * plan.margin_px) * plan.oversampling
    if pointing not in scenes or scenes[pointing].shape != (edge, edge):
        got = scenes[pointing].shape if pointing in scenes else f"scenes of pointings {sorted(scenes)}"
        raise DataError(
            "bad-scene", f"pointing {pointing}: expected a scene of shape ({edge}, {edge}); got {got}"
        )
    scene = np.asarray(scenes[pointing], dtype=np.float64)
    if not np.isfinite(scene).all() or scene.min() < 0:
        raise DataError(
            "bad-scene",
            f"expected finite pixels >= 0; got negative, NaN or infinite pixels in the scene of pointing "
            f"{pointing}: set them to 0",
        )
    return scene


def _check_diffraction(diffraction: Kernel) -> None:
    if diffraction.ndim != 2 or not np.isfinite(diffraction).all() or diffraction.min() < -1e-12:
        raise DataError(
            "bad-diffraction",
            f"expected finite weights [y, x] >= 0; got shape {diffraction.shape}, weights of "
            f"{diffraction.min():.3g} to {diffraction.max():.3g}",
        )
    total = float(diffraction.sum())
    if abs(total - 1) > _SUM_TOLERANCE:
        raise DataError(
            "bad-diffraction",
            f"expected weights that sum to 1 on their grid; got {total:.6g}: divide the weights by their sum",
        )


def covered_share(place: Place, first: tuple[int, int], shape: tuple[int, int], fine: int = 1) -> Plane:
    """The share (0 to 1) of each fine pixel that is behind the disc, Eq. (2); array of (fine * ny, fine * nx).

    Each detector pixel is divided into `fine` fine pixels along each axis. The shares are exact except for rounding. A
    pixel entirely inside the disc gets exactly 1, a pixel entirely outside exactly 0.

    Parameters
    ----------
    first
        Position (row, column) of the first detector pixel.
    shape
        Numbers (ny, nx) of detector pixels.
    """
    y = first[0] - 0.5 + np.arange(fine * shape[0] + 1) / fine - place.y_px
    x = first[1] - 0.5 + np.arange(fine * shape[1] + 1) / fine - place.x_px
    corner = _area_left_below(x[None, :], y[:, None], place.radius_px)
    area = corner[1:, 1:] - corner[1:, :-1] - corner[:-1, 1:] + corner[:-1, :-1]
    share = area * fine**2
    return np.where(share < _ROUNDING, 0.0, np.where(share > 1 - _ROUNDING, 1.0, share))


def _area_left_below(x: Plane, y: Plane, r: float) -> Plane:
    """F(x, y), Eq. (3)."""
    x, y = np.broadcast_arrays(np.clip(x, -r, r), np.clip(y, -r, r))
    # y = r can give a square that is larger than r**2 by rounding.
    half = np.sqrt(np.maximum(r**2 - y**2, 0.0))  # half the length of the chord at y
    middle = np.clip(x, -half, half)
    area = y * (middle + half) + _half_segment(middle, r) - _half_segment(-half, r)
    caps = _half_segment(np.minimum(x, -half), r) - _half_segment(np.full_like(x, -r), r)
    caps = caps + _half_segment(np.maximum(x, half), r) - _half_segment(half, r)
    return np.asarray(np.where(y >= 0, area + 2 * caps, area))


def _half_segment(x: Plane, r: float) -> Plane:
    """Integral of sqrt(r^2 - X^2) from 0 to x."""
    root = np.sqrt(np.maximum(r**2 - x**2, 0.0))
    return np.asarray((x * root + r**2 * np.arcsin(np.clip(x / r, -1, 1))) / 2)


def fully_dark(place: Place, first: tuple[int, int], shape: tuple[int, int]) -> Flags:
    """True for pixels [y, x] whose four corners all lie inside the disc.

    Parameters
    ----------
    first, shape
        Position of the first pixel and number of pixels, see `covered_share`.
    """
    y = np.abs(first[0] + np.arange(shape[0]) - place.y_px) + 0.5
    x = np.abs(first[1] + np.arange(shape[1]) - place.x_px) + 0.5
    return np.asarray(np.hypot(x[None, :], y[:, None]) <= place.radius_px)


@dataclass(frozen=True, eq=False)
class Behind:
    """A patch of the scene around one position of the disc: fine pixels [y, x] in DN/s.

    Attributes
    ----------
    first
        Position (row, column) in the field of the first detector pixel of the patch.
    fine
        Number of fine pixels in a detector pixel along each axis.
    """

    first: tuple[int, int]
    scene: Plane
    fine: int

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx) in detector pixels."""
        return self.scene.shape[0] // self.fine, self.scene.shape[1] // self.fine

    def window(self, margin_px: int = 0) -> tuple[slice, slice]:
        """The slices of the patch in a plane that is margin_px larger than the field on each side."""
        (top, left), (ny, nx) = self.first, self.shape
        return (slice(top + margin_px, top + margin_px + ny), slice(left + margin_px, left + margin_px + nx))

    def hidden(self, place: Place) -> Plane:
        """The light that a disc at `place` hides in each detector pixel of the patch, DN/s."""
        return binned(self.scene * covered_share(place, self.first, self.shape, self.fine), self.fine)

    def hidden_slopes(self, place: Place) -> tuple[Plane, Plane]:
        """The derivatives of ``hidden`` with respect to the disc's x and y, DN/s per px.

        The derivatives are central differences between positions 0.001 px to either side.
        """
        return self._slope(place, _PLACE_STEP_PX, 0.0), self._slope(place, 0.0, _PLACE_STEP_PX)

    def _slope(self, place: Place, dx: float, dy: float) -> Plane:
        ahead = self.hidden(Place(place.x_px + dx, place.y_px + dy, place.radius_px))
        back = self.hidden(Place(place.x_px - dx, place.y_px - dy, place.radius_px))
        return (ahead - back) / (2 * (dx + dy))


def behind(fine_scene: Plane, place: Place, *, fine: int, margin_px: int) -> Behind:
    """The patch of a scene that the disc can hide when its centre lies less than a pixel from `place`.

    Parameters
    ----------
    fine_scene
        The scene in fine pixels [y, x], DN/s; it extends margin_px detector pixels beyond the field on each side.
    fine
        Number of fine pixels in a detector pixel along each axis.
    """
    reach = place.radius_px + 2
    field = (fine_scene.shape[0] // fine - 2 * margin_px, fine_scene.shape[1] // fine - 2 * margin_px)
    spans = []
    for at, n in zip((place.y_px, place.x_px), field, strict=True):
        spans.append((max(0, int(np.floor(at - reach))), min(n, int(np.ceil(at + reach)) + 1)))
    rows, columns = (slice((low + margin_px) * fine, (high + margin_px) * fine) for low, high in spans)
    return Behind((spans[0][0], spans[1][0]), fine_scene[rows, columns].copy(), fine)


def binned(fine_plane: Plane, fine: int) -> Plane:
    """The mean of each block of (fine, fine) pixels."""
    if fine == 1:
        return fine_plane
    return np.asarray(squares(fine_plane, fine).mean(axis=(1, 3)))
