"""How good a PSF is: the light that it puts into the occulter, beside the light observed there.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Accuracy and robustness" and "Evaluation". With H
a total PSF on the field, y an image and D its pixels that are fully dark:

    x = H^-1 y,   s = H (1 - D) x                              Eq. (1)
    PE = (s - y) / mean over D of y, a pixel of D at a time    Eq. (2)
    residual = mean over D of PE                               Eq. (3)

Departures from the paper: its formula of the PE divides by the sum over the occulted pixels, its prose and figures
need the mean, which is used here; only what is fully dark is blanked; the scene is reconstructed linearly. The
residual at the centre is the mean PE within CENTRE_PX: its denominator is that of the whole disc too, because the
mean of a dozen pixels of a dozen photons each, as a denominator, would push errors up by their noise squared.

Noise is that of the image's photons and readout, carried through Eq. (1): exactly where it is a standard error of a
mean (`noise_transfer`), and by drawing more noise at the intensity observed, and simulated in D, for single pixels.
That of the PSF is not among it.

| symbol | name | unit |
|---|---|---|
| y, s | observed, simulated | DN/s |
| D | dark: rows and columns | - |
| PE | pe_pct | % |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.evaluation.frame import FrameEvaluation, Slice, at_centre
from psfcore.evaluation.superposed import Superposed, Superposition
from psfcore.noise import Noise
from psfcore.scatter.inversion import LEAST_DARK_PIXELS, Progress, dark_pixels
from psfcore.scatter.noise_transfer import noise_covariance
from psfcore.scatter.optics import Optics, Pixels, pick, put
from psfcore.transit.occulter import DOUBT_SIGMAS, FoundPlace, find_occulter
from psfcore.transit.transit import Frame, Kernel, Transit

Vector = NDArray[np.float64]
Plane = NDArray[np.float64]

LEAST_DEPTH = 0.2  # less than the inversion's: a PSF without scatter expects far more to be missing than is
SLICE_HALF_PX = 20
SLICES_A_POINTING = 3
DRAWS = 4
UNDO_STEPS = 6
_SCENES_KEPT = 24


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A PSF, or one a fold, on all images of a transit. left_out: images that took no part, with the reason."""

    transit: Transit
    frames: tuple[FrameEvaluation, ...]
    left_out: dict[str, str]
    superposed: Superposed


def evaluate(
    transit: Transit,
    psf_for_frame: Callable[[int], Kernel],
    *,
    draws: int = DRAWS,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Evaluation:
    """Simulate the light in every occulter of a transit and compare it with what was observed.

    psf_for_frame: the total PSF [y, x] for a frame's index, centre at [n // 2, n // 2]; frames that are given the
    same array share its preparation. An image's neighbours in time, which show where its occulter is, are
    reconstructed with its own PSF too, so that a fold's images never meet another fold's PSF. draws: of noise, for
    what noise alone does to the superposed maps; from `seed`.

    Raises DataError "no-occulter" where no image has one that can be looked at.
    """
    kernels = [psf_for_frame(n) for n in range(len(transit.frames))]
    superposition = Superposition(max(frame.place.radius_px for frame in transit.frames), draws)
    sliced = _sliced(transit.frames)
    done: dict[int, FrameEvaluation] = {}
    left_out: dict[str, str] = {}
    for indices in _sharing(kernels):
        look = _Look(transit, kernels[indices[0]], threads)
        for n in indices:
            progress("evaluating", len(done) + len(left_out), len(kernels))
            frame = transit.frames[n]
            found, dark = look.find(n)
            reason = _reason(frame, found, dark)
            if reason is not None:
                left_out[frame.file] = reason
                continue
            simulated = look.simulated(n, dark)
            done[n] = _compared(look, n, found, dark, simulated, sliced=n in sliced)
            rng = np.random.default_rng([seed, n])
            noise = [look.noise_alone(n, dark, simulated, rng) for _ in range(draws)]
            share = 100 / done[n].observed_dn_s
            superposition.add(found.place, dark, done[n].pe_pct, [share * r for r in noise])
    if not done:
        reasons = "; ".join(f"{file}: {why}" for file, why in list(left_out.items())[:3])
        raise DataError("no-occulter", f"expected an image with an occulter in it; got none ({reasons})")
    frames = tuple(done[n] for n in sorted(done))
    return Evaluation(transit, frames, left_out, superposition.superposed())


def _sharing(kernels: Sequence[Kernel]) -> list[list[int]]:
    """Indices of the frames that share a kernel, in the order of their first."""
    groups: dict[int, list[int]] = {}
    for n, kernel in enumerate(kernels):
        groups.setdefault(id(kernel), []).append(n)
    return list(groups.values())


def _sliced(frames: Sequence[Frame]) -> set[int]:
    """Frames whose slices are kept: SLICES_A_POINTING spread evenly over the images of each pointing."""
    chosen: set[int] = set()
    for pointing in {frame.pointing for frame in frames}:
        here = [n for n, frame in enumerate(frames) if frame.pointing == pointing]
        middles = (np.arange(SLICES_A_POINTING) + 0.5) / SLICES_A_POINTING * len(here)
        chosen.update(here[int(at)] for at in middles)
    return chosen


class _Look:
    """The frames of a transit as seen with one PSF."""

    def __init__(self, transit: Transit, kernel: Kernel, threads: int) -> None:
        self.transit, self.kernel = transit, kernel
        self.optics = Optics(kernel, transit.shape, threads=threads)
        self._scenes = _Scenes(transit, self.optics)

    def find(self, n: int) -> tuple[FoundPlace, Pixels]:
        """Where the occulter of frame n is, and which pixels are fully dark."""
        frames = self.transit.frames
        places = [frame.place for frame in frames]
        found = find_occulter(n, frames, self._scenes, places, self.kernel, self.transit.noise)
        return found, dark_pixels(frames[n], found)

    def simulated(self, n: int, dark: Pixels) -> NDArray[np.float32]:
        """s of Eq. (1), [y, x]."""
        scene = self._scenes[n].copy()
        scene[dark] = 0.0
        return self.optics.field(self.optics.see(self.optics.lanes(scene)))

    def noise_alone(
        self, n: int, dark: Pixels, simulated: NDArray[np.float32], rng: np.random.Generator
    ) -> Vector:
        """One more draw of a frame's noise through Eq. (1): s - y in D, DN/s, where the PSF is right."""
        frame, optics = self.transit.frames[n], self.optics
        expected = frame.pixels.astype(np.float64)
        expected[dark] = simulated[dark]
        expected = np.maximum(expected, 0.0)
        drawn = self.transit.noise.observe(expected, frame.exposure_s, rng) - expected
        scene = optics.undo_once(optics.lanes(drawn))
        put(scene, dark, 0.0)
        return pick(optics.see(scene), dark) - drawn[dark]


class _Scenes(Sequence[NDArray[np.float32]]):
    """Reconstructed frames [y, x], each when it is asked for; the last few are kept."""

    def __init__(self, transit: Transit, optics: Optics) -> None:
        self._transit, self._optics = transit, optics
        self._kept: dict[int, NDArray[np.float32]] = {}

    def __len__(self) -> int:
        return len(self._transit.frames)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        scene = self._kept.pop(index, None)
        if scene is None:
            observed = self._optics.lanes(self._transit.frames[index].pixels)
            scene = self._optics.field(self._optics.undo(observed, steps=UNDO_STEPS))
            if len(self._kept) >= _SCENES_KEPT:
                self._kept.pop(next(iter(self._kept)))
        self._kept[index] = scene  # last asked for, last to go
        return scene


def _reason(frame: Frame, found: FoundPlace, dark: Pixels) -> str | None:
    """Why an image takes no part, or None."""
    where = f"({frame.place.x_px:g}, {frame.place.y_px:g}) px"
    if not found.within_reach or found.depth + DOUBT_SIGMAS * found.depth_sigma < LEAST_DEPTH:
        return f"expected an occulter at {where}; found none there"
    if dark[0].size < LEAST_DARK_PIXELS:
        return f"expected at least {LEAST_DARK_PIXELS} fully dark pixels; got {dark[0].size}"
    observed = float(frame.pixels[dark].mean(dtype=np.float64))
    if observed <= 0:
        return f"expected some light in the occulter at {where}; got {observed:.3g} DN/s in the mean"
    return None


def _compared(
    look: _Look,
    n: int,
    found: FoundPlace,
    dark: Pixels,
    simulated: NDArray[np.float32],
    *,
    sliced: bool,
) -> FrameEvaluation:
    frame = look.transit.frames[n]
    noise, centre_noise = _standard_errors(look.optics, frame, dark, found, look.transit.noise)
    along_x, along_y = _slices(frame, found, dark, simulated) if sliced else (None, None)
    return FrameEvaluation(
        index=n,
        file=frame.file,
        fov=frame.pointing,
        time_s=frame.time_s,
        found=found,
        dark=dark,
        observed=frame.pixels[dark].astype(np.float64),
        simulated=simulated[dark].astype(np.float64),
        noise_dn_s=noise,
        centre_noise_dn_s=centre_noise,
        along_x=along_x,
        along_y=along_y,
    )


def _standard_errors(
    optics: Optics, frame: Frame, dark: Pixels, found: FoundPlace, noise: Noise
) -> tuple[float, float]:
    """Of the mean of s - y over the dark pixels, and over those at the centre (nan where there is none)."""
    at = at_centre(dark, found)
    templates = [np.full(at.size, 1 / at.size), at / max(int(np.count_nonzero(at)), 1)]
    disc, centre = np.sqrt(np.diag(noise_covariance(optics, frame, dark, templates, noise)))
    return float(disc), float(centre) if at.any() else float("nan")


def _slices(
    frame: Frame, found: FoundPlace, dark: Pixels, simulated: NDArray[np.float32]
) -> tuple[Slice, Slice]:
    """The row and the column nearest to the occulter's centre, cut to the field."""
    is_dark = np.zeros(simulated.shape, bool)
    is_dark[dark] = True
    y, x = round(found.place.y_px), round(found.place.x_px)
    row = (y, slice(max(0, x - SLICE_HALF_PX), x + SLICE_HALF_PX + 1))
    column = (slice(max(0, y - SLICE_HALF_PX), y + SLICE_HALF_PX + 1), x)

    def along(at: tuple[int | slice, int | slice], start: int, centre_px: float) -> Slice:
        observed: Vector = frame.pixels[at].astype(np.float64)
        offset = start + np.arange(observed.size) - centre_px
        return Slice(np.asarray(offset, np.float64), observed, simulated[at].astype(np.float64), is_dark[at])

    return (
        along(row, row[1].start, found.place.x_px),
        along(column, column[0].start, found.place.y_px),
    )
