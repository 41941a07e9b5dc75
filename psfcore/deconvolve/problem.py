"""The problem of a method: prepare an image for it, run its iteration until it stops, and make the result.

An iteration stops after a fixed number of steps, or by the discrepancy principle (Morozov 1966), when the model fits
the image as well as the noise allows. The variance is computed from the model image H x, so that the noise of a faint
pixel does not influence the weight of that pixel:

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

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, Deconvolved, fluxes
from psfcore.deconvolve.declaration import Method, Stop, check_stop
from psfcore.deconvolve.edges import (
    FLAGGED_SHARE,
    Domain,
    band_px,
    lay_out,
    margin_for,
    share_from_beyond,
)
from psfcore.errors import DataError
from psfcore.fits.units import dn_per_unit
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.psf_sampling import check_compatible

# The first value of a missing pixel is computed from trusted neighbours if the PSF's weights on them sum to more than
# this.
_ENOUGH_NEIGHBOURS = 1e-4


class Iteration:
    """One step of a method, in two parts. `Problem.solve` calls them in turn, reports progress, and decides when to
    stop.

    The engine's spectrum carries the data from call to call:

    - Before `measure` it holds the transformed rows of the estimate x: call `engine.rows_forward(x)` at the start.
    - `measure` computes H x from these rows, stores the sums of chi2 in `judgement.sums`, and leaves the input of
      `update` in the spectrum.
    - `update` computes the next x from this input. If `last` is false, it leaves the transformed rows of the next x in
      the spectrum.

    Attributes
    ----------
    x
        The estimate, a plane [y, x] or in the engine's layout.
    change
        Rms of the change in the last step, divided by the rms of x.
    """

    x: NDArray[np.float32]
    change: float = 0.0

    def measure(self) -> None:
        """Compute H x and chi2."""
        raise NotImplementedError

    def update(self, *, last: bool) -> None:
        """Compute the next estimate.

        Parameters
        ----------
        last
            Whether this is the last step, so that `measure` is not called again.
        """
        raise NotImplementedError


def relative_change(moved: float, total: float) -> float:
    """The `change` of an iteration, from the sums of (change)^2 and x^2."""
    return float(np.sqrt(moved / total)) if total > 0 else 0.0


class Judgement(NamedTuple):
    """The judged pixels of Eq. (1) and their variance, as one argument of the compiled kernels.

    Attributes
    ----------
    rows
        The array [block][half][lane]: 1 for a judged row, else 0.
    first, last
        Judged columns, from `first` to `last` - 1.
    pixels
        The number n of judged pixels.
    slope, ground
        Terms of the variance in the domain's scaled unit.
    sums
        For each block of rows, the sum of Eq. (1) without the factor 1/n.
    """

    rows: NDArray[np.float32]
    first: int
    last: int
    pixels: int
    slope: np.float32
    ground: np.float32
    sums: NDArray[np.float64]

    @property
    def chi2(self) -> float:
        """The chi2 of Eq. (1), of the model image that was computed last."""
        return float(self.sums.sum()) / max(self.pixels, 1)


@dataclass(frozen=True, eq=False)
class Problem:
    """A checked image and PSF, the plane on which the scene is estimated, the engine for that plane, and when to
    stop.
    """

    method: Method
    image: Image
    psf: Psf
    conditions: Conditions
    domain: Domain
    engine: Engine
    judgement: Judgement
    edge_band_px: int
    steps: int
    stop: str

    def solve(self, iteration: Iteration) -> Deconvolved:
        """Run a method's iteration until it stops, and turn its estimate into the result for the image.

        Raises DataError "no-noise-model" if the rule is discrepancy and the noise is not known.
        """
        image, domain = self.image, self.domain
        domain.release()  # the iteration holds what it needs of the planes of the domain
        steps_done, because, chi2 = self._run(iteration)
        self.engine.release()
        x = iteration.x
        pixels = domain.cut([(0, x)] if x.ndim == 2 else self.engine.row_blocks_of(x))
        flux_in, flux_out, negative_pixels = fluxes(image, pixels)
        pixels[~image.finite] = np.nan
        return Deconvolved(
            pixels=pixels,
            method=self.method.name,
            steps_done=steps_done,
            stopped_because=because,
            flux_in=flux_in,
            flux_out=flux_out,
            negative_pixels=negative_pixels,
            last_change=iteration.change,
            edges=domain.edges,
            margin_px=domain.margin_px,
            edge_band_px=self.edge_band_px,
            chi2_per_pixel=chi2,
        )

    def _run(self, iteration: Iteration) -> tuple[int, str, float | None]:
        """The number of steps done, the reason of the end, and chi2 of Eq. (1); None if the noise is not known.

        After a fixed number of steps, chi2 belongs to the estimate before the last step.
        """
        judgement, steps, progress = self.judgement, self.steps, self.conditions.progress
        judged = self.conditions.noise is not None and judgement.pixels > 0
        if self.stop == "discrepancy":
            check_stop(self.stop, noise_is_known=self.conditions.noise is not None)
            if not judgement.pixels:
                raise DataError(
                    "no-noise-model",
                    "expected valid pixels away from the edges, because the stopping rule discrepancy judges them; got "
                    "none: use the stopping rule fixed",
                )
        for step in range(1, steps + 1):
            iteration.measure()
            if self.stop == "discrepancy" and judgement.chi2 <= 1:  # Eq. (1)
                because = f"chi2 of {judgement.chi2:.3f} a pixel after {step - 1} steps: as near as the noise allows"
                return step - 1, because, judgement.chi2
            iteration.update(last=step == steps)
            if progress is not None:
                progress(step, steps)
        chi2 = judgement.chi2 if judged else None
        if self.stop == "discrepancy":
            return steps, f"chi2 of {chi2:.3f} a pixel still above 1 at the most steps, {steps}", chi2
        return steps, f"all {steps} steps asked for were done", chi2


def pose(method: Method, image: Image, psf: Psf, conditions: Conditions, *, steps: int, stop: str) -> Problem:
    """Check the input and prepare a problem.

    Raises DataError: "bad-stop", "bad-edges", "all-masked", "no-signal", "plate-scale-mismatch", "no-exposure".
    """
    if stop not in get_args(Stop):
        raise DataError("bad-stop", f"expected stop to be fixed or discrepancy; got {stop}")
    check_compatible(image, psf)
    shares = share_from_beyond(psf)
    band = band_px(shares, FLAGGED_SHARE)
    margin_px = conditions.margin_px
    if margin_px is None:
        shape = (image.pixels.shape[0], image.pixels.shape[1])
        margin_px = margin_for(shares, shape, share=method.margin_share)
    domain = lay_out(image, edges=conditions.edges or method.edges, margin_px=margin_px)
    engine = conditions.engine_for(psf, domain.shape, domain.span, conditions.threads, domain.margin_px)
    judged = _judgement(image, band, domain, engine, conditions)
    return Problem(method, image, psf, conditions, domain, engine, judged, band, steps, stop)


def _judgement(
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
        pixels=int(np.count_nonzero(image.valid[judged])),
        slope=np.float32(slope / domain.scale),
        ground=np.float32((read_noise / domain.scale) ** 2),
        sums=np.zeros(engine.row_blocks),
    )


def first_estimate(problem: Problem) -> NDArray[np.float32]:
    """The first estimate [y, x]: the observation, on the field and its margin (the domain).

    The first value of a pixel that is not finite is the mean of the trusted pixels around it, weighted by the PSF. If
    there are too few of them, it is the mean of all trusted pixels.
    """
    domain, engine = problem.domain, problem.engine
    estimate = domain.pixels.copy()
    missing = ~domain.finite
    if missing.any():
        trusted, zero = domain.trusted, np.float32(0)
        everywhere = np.float32(domain.pixels[trusted].mean())
        gathered = _convolved(engine, lambda rows: np.where(trusted[rows], domain.pixels[rows], zero))
        for rows, light in gathered:
            np.copyto(estimate[rows], light, where=missing[rows])
            del light  # it is a view of the plane, which is not needed any more
        for rows, near in _convolved(engine, lambda rows: trusted[rows].astype(np.float32)):
            mean = estimate[rows] / np.maximum(near, _ENOUGH_NEIGHBOURS)
            known = np.where(near > _ENOUGH_NEIGHBOURS, mean, everywhere)
            np.copyto(estimate[rows], known, where=missing[rows])
    return estimate


def _convolved(
    engine: Engine, rows_of: Callable[[slice], NDArray[np.float32]]
) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """The field that `rows_of` computes in blocks of rows, convolved with the PSF, in blocks of rows. Besides the
    planes of the engine, only one is in memory.
    """
    lanes = engine.lanes_of(rows_of)
    engine.rows_forward(lanes)
    engine.columns(adjoint=False)
    engine.rows_inverse(lanes)
    for first, block in engine.row_blocks_of(lanes):
        yield slice(first, first + len(block)), block
