"""The sky of a simulated transit, and its noise-free images.

    I_i = P (S_f - h_i)        Eq. (1)

P is the convolution with the total PSF, which is cut to the reach of 2048 x 2048 px. Because P is linear, the scene of a
pointing is convolved once for all its images; only the hidden light is convolved for each image.

| symbol | name | unit |
|---|---|---|
| S_f | scenes[f]: constant scene of pointing f, including the margins beyond the field | DN/s |
| P S_f | seen_scenes[f]: convolved scene | DN/s |
| h_i | Behind.hidden: light that the disc hides in image i | DN/s |
| I_i | expected(i), noise_free[i]: noise-free image i | DN/s |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX
from psfcore.simulate.disc import Behind, behind, binned
from psfcore.simulate.plan import Plan
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from psfcore.simulate.scene import drawn_scene

Plane = NDArray[np.float64]
Kernel = NDArray[np.float64]

_SUM_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class TrueSky:
    """Scenes, occulter and PSF of a transit; all planes float64 [y, x] in DN/s on detector pixels.

    diffraction, kernel: weights [y, x], centre at [n // 2, n // 2]. kernel is the total PSF on twice the edge of the
    scenes, at most the full reach. scenes: the scene of each pointing, plan.margin_px larger than the field on each side.
    seen_scenes: the scene of each pointing without the occulter, convolved with the PSF, on the field. behind: for each
    image, the patch of the scene around the occulter.
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
    def noise_free(self) -> tuple[Plane, ...]:
        """expected() of every image; computed at first use and kept, 8 bytes per pixel and image."""
        return tuple(self.expected(index) for index in range(len(self.plan.shots)))

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

    scenes: a scene for each pointing, in the form that scene_from_image returns. diffraction: weights [y, x], centre at
    [n // 2, n // 2], sum 1. Raises DataError "bad-diffraction", "bad-scene".
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
        through = Convolver(kernel, (whole_px, whole_px), dtype=np.float64, threads=threads)
        seen[pointing] = on_field(
            np.asarray(through.apply(coarse[pointing]), dtype=np.float64), plan.margin_px
        ).copy()
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
            f"expected finite pixels >= 0; got negative, NaN or infinite pixels in the scene of pointing {pointing}",
        )
    return scene


def _check_diffraction(diffraction: Kernel) -> None:
    if diffraction.ndim != 2 or not np.isfinite(diffraction).all() or diffraction.min() < -1e-12:
        raise DataError(
            "bad-diffraction", f"expected finite weights [y, x] >= 0; got shape {diffraction.shape}"
        )
    total = float(diffraction.sum())
    if abs(total - 1) > _SUM_TOLERANCE:
        raise DataError("bad-diffraction", f"expected weights that sum to 1 on their grid; got {total:.6g}")
