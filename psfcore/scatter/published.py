"""The inversion exactly as published, and variants that each correct one of its four biases.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", steps (a) to (j). The
steps are repeated in six rounds. Each round deconvolves the images with Richardson-Lucy, locates the occulters, sets
their discs to zero, and fits subsets of equations. Three rounds fit free shells; then three rounds fit a softened power
law. Where the text of the paper leaves a choice, a comment beside the constant explains the choice made here.

`Choices` describes the four biases and their corrections.

| symbol | name | unit |
|---|---|---|
| a, b, c | Published.a, b_px, c | px^c, px, - |
| A_S, B | Equations.ring_sums, Equations.unscattered | DN/s px^2, DN/s |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
from psfcore.deconvolve.methods.richardson_lucy import deconvolve
from psfcore.errors import DataError
from psfcore.image import Image
from psfcore.psf import CENTRE_TOLERANCE, REACH_GRID_PX, Psf, crop_or_pad, cumulative_curve, squared_radii
from psfcore.scatter.published_equations import UNOCCULTED, Equations, free_fit, power_law_fit
from psfcore.scatter.segments import Segments, segment_sums, shells_as_published
from psfcore.scatter.total_psf import CURVE_RADII_PX
from psfcore.transit.occulter import FoundPlace, disc_distance, find_occulter, fully_dark
from psfcore.transit.transit import Frame, Transit

Kernel = NDArray[np.float64]
Vector = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

LUCY_STEPS = 20
FREE_ROUNDS = 3
POWER_LAW_ROUNDS = 3
SHRUNK_PX = 1.0
UNOCCULTED_WITHIN_PX = 5.0
UNOCCULTED_A_FRAME = 10
LEAST_LEVEL_DN_S = 1e-3
# Each equation is divided by its observed value. In discs with only a few photons, some observed values are zero or
# negative, and their weight would be infinite. Therefore no divisor is smaller than this fraction of the disc's mean.
LEAST_OF_MEAN = 0.5


@dataclass(frozen=True)
class Choices:
    """The four biases of the published fit. True: as published. False: corrected.

    weighed_by_observed: each equation is divided by its own noisy intensity; the fitted light in faint discs is then
    too low. Corrected: each equation is divided by the noise expected at the disc's mean. added: the scatter kernel is
    added to the diffraction PSF, Eq. (1) of `equations`. Corrected: kernel and diffraction PSF are convolved, so the
    ring sums are computed from the diffracted scene. counted_on_array: the unscattered light is 1 minus the scatter
    summed over the array of the diffraction PSF. Corrected: the sum covers the full reach. whole_disc_blanked: all
    pixels whose centres lie within the radius are set to zero. Corrected: only the fully dark pixels are set to zero.
    """

    weighed_by_observed: bool = True
    added: bool = True
    counted_on_array: bool = True
    whole_disc_blanked: bool = True


AS_PUBLISHED = Choices()
CORRECTED_ALONE = {
    "weights from the expected intensity": replace(AS_PUBLISHED, weighed_by_observed=False),
    "scatter and diffraction convolved": replace(AS_PUBLISHED, added=False),
    "light counted on the full reach": replace(AS_PUBLISHED, counted_on_array=False),
    "only fully dark pixels blanked": replace(AS_PUBLISHED, whole_disc_blanked=False),
}


@dataclass(frozen=True, eq=False)
class Published:
    """The result of the published recipe.

    a, b_px, c: the power law of the last round. spread: standard deviations of a, b_px and c over the subsets; None if
    fewer than two subsets were kept. total: the fraction of scattered light, summed over a square grid of grid_px pixels.
    rounds: for each round, "free shells" or "softened power law", and 1 - encircled energy (in percent) at radii_px of the
    total PSF, which is the scatter kernel convolved with the diffraction PSF. equations: the number of equations in the
    last round.
    """

    a: float
    b_px: float
    c: float
    spread: dict[str, float] | None
    total: float
    grid_px: int
    radii_px: Vector
    rounds: tuple[tuple[str, Vector], ...]
    equations: int

    @property
    def curve_pct(self) -> Vector:
        """1 - encircled energy of the final total PSF at radii_px, percent."""
        return self.rounds[-1][1]

    @property
    def scatter(self) -> Kernel:
        """The scatter kernel [y, x] on (grid_px, grid_px)."""
        return _power_law_kernel(np.array([self.a, self.b_px, self.c]), self.grid_px)


def invert_as_published(
    transit: Transit,
    choices: Choices = AS_PUBLISHED,
    *,
    seed: int = 1,
    subsets: int = 100,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Published:
    """Run steps (a) to (j).

    Raises DataError "no-lines" if no pixel is occulted. Raises DataError "no-scatter" if the fit is not physical: it
    scatters more than all light, or the maximum of its PSF is not at the centre.
    """
    return _Recipe(transit, choices, seed, subsets, threads, progress).run()


class _Recipe:
    def __init__(
        self, transit: Transit, choices: Choices, seed: int, subsets: int, threads: int, progress: Progress
    ) -> None:
        self.transit, self.choices, self.seed, self.subsets = transit, choices, seed, subsets
        self.threads, self.progress = threads, progress
        field = max(transit.shape)
        # The paper counts scatter "out to the edge of the PSF". Here this is the edge of the array of the diffraction
        # PSF. In the paper, this array is as large as the images.
        self.grid = (
            min(transit.diffraction.shape[0], REACH_GRID_PX) if choices.counted_on_array else REACH_GRID_PX
        )
        reach = float(np.hypot(self.grid // 2, self.grid // 2)) + 1.0
        self.segments = Segments(shells_as_published(reach), reach_grid_px=self.grid)
        self.psf_size = min(2 * field, REACH_GRID_PX)
        self.to_total = Convolver(
            transit.diffraction, (self.psf_size, self.psf_size), dtype=np.float64, threads=threads
        )
        self.diffract = Engine(transit.diffraction, transit.shape, threads=threads)
        self.radii = np.array([r for r in CURVE_RADII_PX if r < self.psf_size // 2])
        self.radius_of_segment = _radii_of(self.segments)

    def run(self) -> Published:
        kernel = crop_or_pad(self.transit.diffraction, self.psf_size)
        rounds = []
        law, middle = np.array([0.15, 6.0, 2.5]), self.grid // 2
        counts = self.segments.counts.astype(np.float64)
        for n in range(FREE_ROUNDS + POWER_LAW_ROUNDS):
            equations = self._equations(kernel, n)
            draws: dict[str, Any] = {"seed": self.seed * 100 + n, "subsets": self.subsets}
            if n < FREE_ROUNDS:
                name, fitted = "free shells", free_fit(equations, counts, **draws)
                scatter = self._free_kernel(fitted.mean)
            else:
                fitted = power_law_fit(equations, counts, self.radius_of_segment, law, **draws)
                name, law = "softened power law", fitted.mean
                scatter = _power_law_kernel(law, self.grid)
            centre = float(scatter[middle, middle])
            if not centre > 0:
                raise DataError(
                    "no-scatter",
                    f"round {n + 1}, {name}: expected scatter of less than 100 % of the light; got "
                    f"{100 * (1 - centre):.3g} %",
                )
            kernel = np.maximum(self.to_total.apply(crop_or_pad(scatter, self.psf_size)), 0.0)
            _check_brightest_at_centre(kernel, f"round {n + 1}: {name}")
            rounds.append((name, cumulative_curve(kernel, self.radii)))
        spread = fitted.fits.std(axis=0, ddof=1).tolist() if len(fitted.fits) > 1 else None
        return Published(
            a=float(law[0]),
            b_px=float(law[1]),
            c=float(law[2]),
            spread=None if spread is None else dict(zip(("a", "b_px", "c"), spread, strict=True)),
            total=1 - centre,
            grid_px=self.grid,
            radii_px=self.radii,
            rounds=tuple(rounds),
            equations=len(equations),
        )

    def _equations(self, kernel: Kernel, n: int) -> Equations:
        """The equations of all images, from steps (d) to (h)."""
        frames = self.transit.frames
        scenes = self._deconvolved(kernel, n)
        rng = np.random.default_rng([self.seed, n])
        parts = []
        for k, frame in enumerate(frames):
            self.progress(f"round {n + 1}: equations", k, len(frames))
            found = find_occulter(
                k, frames, scenes.__getitem__, [f.place for f in frames], kernel, self.transit.noise
            )  # step (e)
            part = self._equations_of_frame(frame, scenes[k], found, rng)
            if part is not None:
                parts.append(part)
        if not parts:
            raise DataError(
                "no-lines",
                "expected occulted pixels in the images; got none; check the positions of the discs in transit.json",
            )
        return Equations.joined(parts)

    def _deconvolved(self, kernel: Kernel, n: int) -> list[NDArray[np.float32]]:
        """Step (d): the scenes of all images, deconvolved with Richardson-Lucy."""
        psf = Psf(kernel, name="round", version=str(n), instrument=None, status="draft")
        conditions = Conditions(
            edges="zero", margin_px=0, threads=self.threads, engine_for=PreparedPsfs().engine_for
        )
        scenes = []
        for k, frame in enumerate(self.transit.frames):
            self.progress(f"round {n + 1}: deconvolving", k, len(self.transit.frames))
            image = Image(
                pixels=frame.pixels.astype(np.float64),
                mask=np.zeros(frame.pixels.shape, np.uint8),
                header=Header(),
                unit="DN/s",
                exposure_s=frame.exposure_s,
            )
            scenes.append(deconvolve(image, psf, conditions, steps=LUCY_STEPS).pixels.astype(np.float32))
        return scenes

    def _equations_of_frame(
        self, frame: Frame, scene: NDArray[np.float32], found: FoundPlace, rng: np.random.Generator
    ) -> Equations | None:
        """The equations of one image, from steps (f) to (h); None if no pixel of the image is occulted."""
        shape, place = self.transit.shape, found.place
        distance = disc_distance(shape, place)
        within = distance <= place.radius_px
        blanked = within if self.choices.whole_disc_blanked else fully_dark(shape, place)
        true = np.where(blanked, np.float32(0), scene)  # step (f)
        occulted = distance <= place.radius_px - SHRUNK_PX
        if frame.filled is not None:
            occulted &= ~frame.filled
        rows, columns = np.nonzero(occulted)
        if rows.size == 0:
            return None
        outside = np.flatnonzero((~within & (distance <= place.radius_px + UNOCCULTED_WITHIN_PX)).ravel())
        outside = rng.choice(outside, min(UNOCCULTED_A_FRAME, outside.size), replace=False)
        targets = np.concatenate(
            (np.stack((rows, columns), axis=1), np.stack(np.unravel_index(outside, shape), axis=1))
        )
        stratum = np.floor(place.radius_px - SHRUNK_PX - distance[rows, columns]).astype(np.int64)  # step (g)
        stratum = np.concatenate((np.maximum(stratum, 0), np.full(outside.size, UNOCCULTED)))
        observed = frame.pixels[targets[:, 0], targets[:, 1]].astype(np.float64)
        diffracted = self.diffract.apply(true)
        summed = true if self.choices.added else diffracted
        return Equations(
            observed=observed,
            ring_sums=segment_sums(summed, targets, self.segments, threads=self.threads),
            unscattered=diffracted[targets[:, 0], targets[:, 1]].astype(np.float64),
            scale=self._scale(frame, observed, stratum),
            stratum=stratum,
        )  # step (h)

    def _scale(self, frame: Frame, observed: Vector, stratum: NDArray[np.int64]) -> Vector:
        """The number by which each equation is divided."""
        level = np.empty_like(observed)
        for here in (stratum == UNOCCULTED, stratum != UNOCCULTED):
            level[here] = max(float(observed[here].mean()), LEAST_LEVEL_DN_S) if here.any() else 1.0
        if self.choices.weighed_by_observed:
            return np.maximum(observed, LEAST_OF_MEAN * level)
        return np.sqrt(self.transit.noise.variance(level, frame.exposure_s))

    def _free_kernel(self, coefficients: Vector) -> Kernel:
        label = self.segments.label_map(self.grid)
        kernel = np.where(label >= 0, coefficients[np.maximum(label, 0)], 0.0)
        kernel[self.grid // 2, self.grid // 2] = 1 - kernel.sum()
        return np.asarray(kernel)


def _check_brightest_at_centre(kernel: Kernel, label: str) -> None:
    """Raise DataError "no-scatter" if the central pixel is not the maximum; such a PSF is not physical."""
    middle = (kernel.shape[0] // 2, kernel.shape[1] // 2)
    if kernel[middle] < kernel.max() * (1 - CENTRE_TOLERANCE):
        y, x = np.unravel_index(int(kernel.argmax()), kernel.shape)
        distance = np.hypot(y - middle[0], x - middle[1])
        raise DataError(
            "no-scatter",
            f"{label}: expected a PSF with its maximum at the centre; got {kernel[middle]:.3g} of the light there "
            f"and {kernel.max():.3g} in a pixel at a distance of {distance:.3g} px",
        )


def _power_law_kernel(law: Vector, size: int) -> Kernel:
    a, b, c = law
    kernel = a * (b + np.sqrt(squared_radii((size, size)))) ** -c
    kernel[size // 2, size // 2] = 0.0
    kernel[size // 2, size // 2] = 1 - kernel.sum()
    return np.asarray(kernel)


def _radii_of(segments: Segments) -> list[tuple[Vector, Vector]]:
    """For each segment, the distances of its pixels (px) and the number of pixels at each distance.

    A segment with more than 40 distances is divided into 40 rings; the mean distance of each ring is used.
    """
    squares, count = np.unique(
        squared_radii((segments.reach_grid_px, segments.reach_grid_px)), return_counts=True
    )
    radius = np.sqrt(squares)
    shell = np.searchsorted(segments.edges_px, radius, side="right") - 1
    out = []
    for k in range(segments.size):
        here = shell == k
        r, n = radius[here], count[here].astype(np.float64)
        if r.size > 40:
            ring = np.linspace(0, 40, r.size, endpoint=False).astype(int)
            total = np.bincount(ring, weights=n)
            r, n = np.bincount(ring, weights=n * r) / total, total
        out.append((r, n) if r.size else (np.array([segments.edges_px[k]]), np.zeros(1)))
    return out
