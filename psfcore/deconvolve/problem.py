"""The parts that all methods share: prepare an image for a method, run its iteration, and make the result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, Deconvolved, fluxes
from psfcore.deconvolve.edges import (
    FLAGGED_SHARE,
    Domain,
    Edges,
    band_px,
    lay_out,
    margin_for,
    share_from_beyond,
)
from psfcore.deconvolve.stopping import Iteration, Judgement, Stop, check_steps, judgement, run
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.psf_sampling import check_compatible

# The first value of a missing pixel is computed from trusted neighbours if the PSF's weights on them sum to more than
# this.
_ENOUGH_NEIGHBOURS = 1e-4


@dataclass(frozen=True, eq=False)
class Problem:
    """A checked image and PSF, the plane on which the scene is estimated, and the engine for that plane."""

    image: Image
    psf: Psf
    conditions: Conditions
    domain: Domain
    engine: Engine
    judgement: Judgement
    edge_band_px: int

    def solve(self, iteration: Iteration, *, method: str, steps: int, stop: Stop) -> Deconvolved:
        """Run a method's iteration until it stops, and turn its estimate into the result for the image."""
        image, domain = self.image, self.domain
        domain.release()  # the iteration holds what it needs of the planes of the domain
        ended = run(
            iteration,
            self.judgement,
            steps=steps,
            stop=stop,
            noise_known=self.conditions.noise is not None,
            progress=self.conditions.progress,
        )
        x = iteration.x
        pixels = domain.cut([(0, x)] if x.ndim == 2 else self.engine.row_blocks_of(x))
        flux_in, flux_out, negative_pixels = fluxes(image, pixels)
        pixels[~image.finite] = np.nan
        return Deconvolved(
            pixels=pixels,
            method=method,
            steps_done=ended.steps_done,
            stopped_because=ended.because,
            flux_in=flux_in,
            flux_out=flux_out,
            negative_pixels=negative_pixels,
            last_change=iteration.change,
            edges=domain.edges,
            margin_px=domain.margin_px,
            edge_band_px=self.edge_band_px,
            chi2_per_pixel=ended.chi2,
        )


def pose(
    image: Image,
    psf: Psf,
    conditions: Conditions,
    *,
    edges: Edges,
    margin_share: float,
    steps: int,
    stop: Stop,
) -> Problem:
    """Check the input and prepare a problem.

    edges: the default of the method, used if `conditions.edges` is None. margin_share: largest fraction of
    its light that a pixel at the edge may get from beyond the margin; `margin_for` computes the default width of the
    margin from this fraction. Raises
    DataError: "bad-steps", "bad-stop", "bad-edges", "all-masked", "no-signal", "plate-scale-mismatch", "no-exposure".
    """
    check_steps(steps, stop)
    check_compatible(image, psf)
    shares = share_from_beyond(psf)
    band = band_px(shares, FLAGGED_SHARE)
    margin_px = conditions.margin_px
    if margin_px is None:
        margin_px = margin_for(shares, (image.pixels.shape[0], image.pixels.shape[1]), share=margin_share)
    domain = lay_out(image, edges=conditions.edges or edges, margin_px=margin_px)
    engine = conditions.engine_for(psf, domain.shape, domain.span, conditions.threads)
    judged = judgement(image, band, domain, engine, conditions)
    return Problem(image, psf, conditions, domain, engine, judged, band)


def first_estimate(problem: Problem) -> NDArray[np.float32]:
    """The first estimate [y, x]: the observation, on the field and its margin (the domain).

    The first value of a pixel that is not finite is the mean of the trusted pixels around it, weighted by the PSF. If
    there are too few of them, it is the mean of all trusted pixels.
    """
    domain, engine = problem.domain, problem.engine
    estimate = domain.pixels.copy()
    missing = ~domain.finite
    if missing.any():
        observed = np.where(domain.trusted, domain.pixels, np.float32(0))
        near = engine.apply(domain.trusted.astype(np.float32))[missing]
        gathered = engine.apply(observed)[missing]
        everywhere = np.float32(domain.pixels[domain.trusted].mean())
        estimate[missing] = np.where(
            near > _ENOUGH_NEIGHBOURS, gathered / np.maximum(near, _ENOUGH_NEIGHBOURS), everywhere
        )
    return estimate
