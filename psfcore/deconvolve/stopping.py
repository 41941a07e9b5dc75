"""Stopping rules: a fixed number of steps, or the discrepancy principle.

The discrepancy principle (Morozov 1966) stops when the model fits the image as well as the noise allows. The variance
is computed from the model image H x, so that the noise of a faint pixel does not influence the weight of that pixel:

    chi2 = 1/n sum over judged pixels of (y - H x)^2 / (g H x + r^2)        Eq. (1)

The first estimate with chi2 <= 1 is the result, because further steps would fit the noise. Chi2 is computed from the n
judged pixels: the trusted pixels that are not near an edge. In a band along the edges (`edge_band_px`), more than 5 %
of the light may come from beyond the field, which the model does not contain.

| symbol | name | unit |
|---|---|---|
| g, r^2 | slope and ground (constant term) of the variance | (image unit), (image unit)^2 |
| n | judged pixels | - |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, Progress
from psfcore.deconvolve.edges import Domain
from psfcore.errors import DataError
from psfcore.fits.units import dn_per_unit
from psfcore.image import Image

Stop = Literal["fixed", "discrepancy"]
MOST_STEPS = 10_000


@dataclass(frozen=True)
class Ended:
    """How an iteration ended: number of steps, reason, and chi2 of Eq. (1); chi2 is None if the noise is not known.

    With a fixed number of steps, chi2 belongs to the estimate before the last step.
    """

    steps_done: int
    because: str
    chi2: float | None


@dataclass(frozen=True, eq=False)
class Judgement:
    """The judged pixels of Eq. (1) and their variance, in the layout that the compiled kernels need.

    rows [block][half][lane]: 1 for a judged row, else 0. first, last: judged columns, from `first` to `last` - 1.
    count: n. slope, ground: terms of the variance in the domain's scaled unit. sums: for each block of rows, the sum of
    Eq. (1) without the factor 1/n.
    """

    rows: NDArray[np.float32]
    first: int
    last: int
    count: int
    slope: np.float32
    ground: np.float32
    sums: NDArray[np.float64]

    @property
    def numbers(self) -> tuple[Any, ...]:
        """These values as arguments of a compiled kernel."""
        return self.rows, self.first, self.last, self.slope, self.ground, self.sums

    @property
    def chi2(self) -> float:
        """chi2 of Eq. (1), for the model image that was computed last."""
        return float(self.sums.sum()) / max(self.count, 1)


def judgement(
    image: Image, band_px: int, domain: Domain, engine: Engine, conditions: Conditions
) -> Judgement:
    """Prepare Eq. (1). Pixels in a band of `band_px` along the edges (at most a quarter of the field) are not judged.

    If the noise is not known, the variance is 1, and chi2 is the mean square difference in scaled units.
    Raises DataError "no-exposure".
    """
    ny, nx = image.pixels.shape
    band = min(band_px, ny // 4, nx // 4)
    rows = np.zeros(engine.row_blocks * engine.lanes_shape[2] * engine.lanes_shape[3], np.float32)
    top, left = (part.start for part in domain.field)
    rows[top + band : top + ny - band] = 1
    judged = (slice(band, ny - band), slice(band, nx - band))
    slope, read_noise = 0.0, domain.scale
    if conditions.noise is not None:
        dn = dn_per_unit(image)
        slope, read_noise = conditions.noise.photon_gain_dn / dn, conditions.noise.read_noise_dn / dn
    return Judgement(
        rows=rows.reshape(engine.row_blocks, *engine.lanes_shape[2:]),
        first=left + band,
        last=left + nx - band,
        count=int(np.count_nonzero(image.valid[judged])),
        slope=np.float32(slope / domain.scale),
        ground=np.float32((read_noise / domain.scale) ** 2),
        sums=np.zeros(engine.row_blocks),
    )


class Iteration:
    """One step of a method, in two parts. `run` calls them in turn, reports progress, and decides when to stop.

    The engine's spectrum carries the data from call to call:

    - Before `measure` it holds the transformed rows of the estimate x: call `engine.rows_forward(x)` at the start.
    - `measure` computes H x from these rows, stores the sums of chi2 in `judgement.sums`, and leaves the input of
      `update` in the spectrum.
    - `update` computes the next x from this input. If `last` is false, it leaves the transformed rows of the next x in
      the spectrum.

    x: the estimate, a plane [y, x] or in the engine's layout.
    """

    x: NDArray[np.float32]

    @property
    def change(self) -> float:
        """Rms of the change in the last step, divided by the rms of x."""
        raise NotImplementedError

    def measure(self) -> None:
        """Compute H x and chi2."""
        raise NotImplementedError

    def update(self, *, last: bool) -> None:
        """Compute the next estimate. last: True if `measure` is not called again."""
        raise NotImplementedError


def run(
    iteration: Iteration,
    found: Judgement,
    *,
    steps: int,
    stop: Stop,
    noise_known: bool,
    progress: Progress | None,
) -> Ended:
    """Run an iteration until the rule `stop` ends it, for at most `steps` steps.

    Raises DataError "no-noise-model" if the rule is discrepancy and the noise is not known.
    """
    if stop == "discrepancy" and not (noise_known and found.count):
        raise no_noise_model()
    for step in range(1, steps + 1):
        iteration.measure()
        if stop == "discrepancy" and found.chi2 <= 1:  # Eq. (1)
            because = f"chi2 of {found.chi2:.3f} a pixel after {step - 1} steps: as near as the noise allows"
            return Ended(step - 1, because, found.chi2)
        iteration.update(last=step == steps)
        if progress is not None:
            progress(step, steps)
    chi2 = found.chi2 if noise_known and found.count else None
    if stop == "discrepancy":
        return Ended(steps, f"chi2 of {chi2:.3f} a pixel still above 1 at the most steps, {steps}", chi2)
    return Ended(steps, f"all {steps} steps asked for were done", chi2)


def no_noise_model() -> DataError:
    """The error if the rule is discrepancy and the noise is not known."""
    return DataError(
        "no-noise-model",
        "expected photon gain, read noise and valid pixels away from the edges, because the stopping rule discrepancy "
        "needs them; at least one is missing: give the noise figures, or use the stopping rule fixed",
    )


def check_steps(steps: int, stop: str) -> None:
    """Raise DataError "bad-steps" or "bad-stop"."""
    if not 1 <= steps <= MOST_STEPS:
        raise DataError("bad-steps", f"expected 1 to {MOST_STEPS} steps; got {steps}")
    if stop not in ("fixed", "discrepancy"):
        raise DataError("bad-stop", f"expected stop to be fixed or discrepancy; got {stop}")
