"""When an iteration ends: after a number of steps, or when the fit is as good as the noise allows.

The discrepancy principle (Morozov 1966) with the noise expected of the estimate's own image, so that faint
pixels are not judged by their luck:

    chi2 = 1/n sum over judged pixels of (y - H x)^2 / (g H x + r^2)        Eq. (1)

The first estimate with chi2 <= 1 is the result: steps beyond it fit the noise. Judged are the n trusted
pixels outside the band along the edges in which light from beyond the field decides.

| symbol | name | unit |
|---|---|---|
| g, r^2 | slope, ground of the variance | (image unit), (image unit)^2 |
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
from psfcore.image import Image
from psfcore.noise import dn_per_unit

Stop = Literal["fixed", "discrepancy"]
MOST_STEPS = 10_000


@dataclass(frozen=True)
class Ended:
    """After how many steps an iteration ended, why, and chi2 of Eq. (1) where the noise is known.

    With a fixed number of steps chi2 is that of the estimate before the last step.
    """

    steps_done: int
    because: str
    chi2: float | None


@dataclass(frozen=True, eq=False)
class Judgement:
    """Which pixels Eq. (1) counts, and their variance, as row stages take it.

    rows [block][half][lane]: 1 where a row is judged; first, last: range of columns; count: pixels, n.
    slope, ground: the variance's terms in the domain's scaled unit; sums: chi2 * n, one for each block.
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
        """As a row stage takes them."""
        return self.rows, self.first, self.last, self.slope, self.ground, self.sums

    @property
    def chi2(self) -> float:
        """Eq. (1) of the last row stage."""
        return float(self.sums.sum()) / max(self.count, 1)


def judgement(
    image: Image, band_px: int, domain: Domain, engine: Engine, conditions: Conditions
) -> Judgement:
    """Lay out what Eq. (1) needs, leaving out a band along the edges, of a quarter of the field at most.

    Without noise, variance 1: chi2 is then the mean square in scaled units.
    """
    ny, nx = image.pixels.shape
    band = min(band_px, ny // 4, nx // 4)
    rows = np.zeros(engine.row_blocks * engine.lanes_shape[2] * engine.lanes_shape[3], np.float32)
    top, left = (part.start for part in domain.field)
    rows[top + band : top + ny - band] = 1
    judged = (slice(band, ny - band), slice(band, nx - band))
    slope, readout = 0.0, domain.scale
    if conditions.noise is not None:
        dn = dn_per_unit(image)
        slope, readout = conditions.noise.photon_gain_dn / dn, conditions.noise.read_noise_dn / dn
    return Judgement(
        rows=rows.reshape(engine.row_blocks, *engine.lanes_shape[2:]),
        first=left + band,
        last=left + nx - band,
        count=int(np.count_nonzero(image.valid[judged])),
        slope=np.float32(slope / domain.scale),
        ground=np.float32((readout / domain.scale) ** 2),
        sums=np.zeros(engine.row_blocks),
    )


class Iteration:
    """A method's steps, put between the parts that every method shares.

    A method gives `measure`, which brings what H x says of the estimate x into the engine's spectrum and
    fills the judgement, and `update`, which makes the next estimate of it.
    """

    def measure(self) -> None:
        """H x and how it fits."""
        raise NotImplementedError

    def update(self, *, last: bool) -> None:
        """The next estimate. After the last one, nothing more will be measured."""
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
    """Step until `stop` is met, at most `steps` times.

    Raises DataError "no-noise-model" for a discrepancy without noise.
    """
    if stop == "discrepancy" and not (noise_known and found.count):
        raise DataError(
            "no-noise-model", "expected photon gain and read noise to stop by discrepancy; got none"
        )
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


def check_steps(steps: int, stop: str) -> None:
    """Raise DataError "bad-steps" or "bad-stop"."""
    if not 1 <= steps <= MOST_STEPS:
        raise DataError("bad-steps", f"expected at least one step and at most {MOST_STEPS}; got {steps}")
    if stop not in ("fixed", "discrepancy"):
        raise DataError("bad-stop", f"expected stop to be fixed or discrepancy; got {stop}")
