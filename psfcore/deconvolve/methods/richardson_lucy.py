"""Richardson-Lucy deconvolution (Richardson 1972, Lucy 1974), which Hofmeister et al. recommend for HRI_EUV.

    x <- x * H^T( w y / (H x) + (1 - w) / s ),   s = H^T 1      Eq. (1)

Without masked pixels (w = 1), Eq. (1) is the published step. It conserves the flux, sum x = sum y over the plane,
because H^T is applied to y / (H x). A masked pixel (w = 0) gets the ratio 1 / s, at which it agrees with the model and
does not change the fit. The ratio 1 would be wrong for the following reason. The published step does not restore light
that leaves the plane, so the ratios of the other pixels converge to 1 / s. A pixel with the ratio 1 would become
fainter by the factor s at each step. Negative pixels are due to noise around zero. They count as 0 in the ratio,
because the method cannot represent negative light.

In the paper the scene is zero beyond the field (edges "zero"). In this case, the outermost rows of the result become 4
to 6 % too dark: light that enters from beyond the field replaces the light that leaves the field, but only on average.
If the mirror image of the field continues the scene, the error is at most 1.3 % (`python -m studies.edges`). The
default is therefore "symmetric". A margin of about 64 px is enough, because the published step compensates for the
light that crosses the edge of the margin.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate | image unit |
| w | trusted, 1 or 0 | - |
| s | share of a pixel's light that falls on the plane and on the PSF's array; 1 / s is `agreed` | - |
| H, H^T | Engine.apply, Engine.adjoint | - |
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.engine import buffer_from_spectrum, spectrum_from_buffer
from psfcore.convolution.fft_kernels import LANES, forward, inverse
from psfcore.deconvolve.conditions import Conditions, Deconvolved, Progress
from psfcore.deconvolve.edges import Edges
from psfcore.deconvolve.lucy_ratio import DARK_OF_FLOOR, Ratio, light_above_floor
from psfcore.deconvolve.problem import Problem, pose
from psfcore.deconvolve.stopping import Iteration, Stop
from psfcore.image import Image
from psfcore.psf import Psf

METHOD = "richardson-lucy"
EDGES: Edges = "symmetric"
MARGIN_SHARE = 0.05
KEEPS_FLUX = True
_SUMS: Any = {"contract", "reassoc"}
_SUMMED = 16 * LANES

Single = NDArray[np.float32]


def deconvolve(
    image: Image, psf: Psf, conditions: Conditions, *, steps: int = 20, stop: Stop = "fixed"
) -> Deconvolved:
    """Estimate the scene from `image` [y, x], which was observed with `psf`. The first estimate is the observation.

    The result is not negative. It is NaN where the image is not finite. Where the image is saturated, the result is an
    estimate from the surrounding pixels. Raises the errors of `problem.pose`, and DataError "no-signal".
    """
    problem = pose(image, psf, conditions, edges=EDGES, margin_share=MARGIN_SHARE, steps=steps, stop=stop)
    return problem.solve(_RichardsonLucy(problem), method=METHOD, steps=steps, stop=stop)


def richardson_lucy(
    image: Image, psf: Psf, *, steps: int = 20, threads: int = 1, progress: Progress | None = None
) -> Deconvolved:
    """Run the published method: a fixed number of steps, and a scene that is zero beyond the field."""
    conditions = Conditions(edges="zero", threads=threads, progress=progress)
    return deconvolve(image, psf, conditions, steps=steps)


class _RichardsonLucy(Iteration):
    """The iteration of Eq. (1). A block of rows stays in the cache between two convolutions."""

    def __init__(self, problem: Problem) -> None:
        estimate = light_above_floor(problem)
        brightest = float(estimate.max())
        self._engine = problem.engine
        self.x = problem.engine.to_lanes(estimate)
        del estimate  # makes room for the planes of the ratio
        self._ratio = Ratio(problem, agreed(problem), brightest)
        self._dark = self._ratio.floor * np.float32(DARK_OF_FLOOR)
        self._moved, self._total = np.zeros((2, problem.engine.row_blocks))
        self._engine.rows_forward(self.x)

    def measure(self) -> None:
        self._ratio.measure()

    def update(self, *, last: bool) -> None:
        self._engine.columns(adjoint=True)
        self._engine.row_stage(
            _update_rows, self.x, self._dark, not last, self._moved, self._total
        )  # Eq. (1)

    @property
    def change(self) -> float:
        """Rms of the change in the last step, divided by the rms of x."""
        total = float(self._total.sum())
        return float(np.sqrt(self._moved.sum() / total)) if total > 0 else 0.0


def agreed(problem: Problem) -> Single | float:
    """Compute 1 / s of Eq. (1) on the domain. If all pixels are trusted, 1 / s is not needed, and the result is 1."""
    if problem.domain.trusted.all():
        return 1.0
    ones = np.ones(problem.domain.shape, dtype=np.float32)
    return np.asarray(1 / np.maximum(problem.engine.adjoint(ones), np.finfo(np.float32).eps))


@compiled(fastmath=_SUMS, error_model="numpy")
def _update_rows(spectrum, estimate, dark, again, moved, total, buffer, corner, start, stop, length, passes, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """Compute x <- x * correction, Eq. (1). Set values below `dark` to 0. Add up (change)^2 and x^2 for each block."""
    used = estimate.shape[1] * 2 * LANES
    zero = np.float32(0.0)
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, passes, lengths, tw, offsets)
        whole = estimate[block].reshape(-1)
        moved_here = 0.0
        total_here = 0.0
        # The sums of short parts are in single precision, so that the compiler can use vector instructions.
        for first in range(0, used, _SUMMED):
            moved_part = zero
            total_part = zero
            x, z = whole[first : first + _SUMMED], buffer[first : first + _SUMMED]
            for n in range(x.size):
                old = x[n]
                # Rounding may turn a correction of 0 into a negative number.
                new = old * max(z[n], zero)
                new = zero if new < dark else new
                x[n] = new
                z[n] = new
                moved_part += (new - old) * (new - old)
                total_part += new * new
            moved_here += moved_part
            total_here += total_part
        moved[block] = moved_here
        total[block] = total_here
        if again:
            buffer[used : length * 2 * LANES] = zero
            forward(buffer, length, passes, lengths, tw, offsets)
            spectrum_from_buffer(spectrum, buffer, corner, block, length, place)
