"""Far-field diffraction by the entrance pupil, summed over detector pixels.

Hofmeister et al., The point-spread function of HRI_EUV, section "Fraunhofer propagation". The phase factors
that cancel in |E|^2 are left out, and the focal length f replaces the distance z:

    E(q) = sum over cells i of c_i exp(-2 pi i q . i / n),   dx = lambda f / (n p)                  Eq. (1)
    P_j = 1/S^2 sum over s, t = 0 .. S-1 of |E(j + (o_s, o_t))|^2,   o_s = (s + 1/2) / S - 1/2      Eq. (2)
    S >= 2 D p / (lambda f), and at least 14                                                       Eq. (3)

The paper transforms the whole padded mask at once. Here each pair (s, t) of positions within the pixel needs one
n x n transform. Because exp(-2 pi i j . i / n) has the period n in i, the cells are first multiplied by
exp(-2 pi i o . i / n) and added modulo n ("folded"): along x for all rows, then along y. Only the requested pixels of
each transform are kept. With Eq. (3) the sum over all n x n pixels equals the sum of the squares of the mask
(Parseval).

Departure from the paper: c is the open share of a cell, which is the mean of the transmission over the area of the
cell. Therefore Eq. (1) gives E times sinc(x / n) sinc(y / n), and the pattern is divided by the square of this factor.
Light beyond the n x n pixels wraps around to the opposite side. At the position x, the amplitude of the wrapped light
is (x / (n - x))^2 of the correct amplitude: 11 % at n / 4, 1 % at n / 11. The pupil of HRI_EUV sends 0.13 % of its
light beyond the inner 2048 px. With n = 4096, the wrapped light is 1e-5 of all light.

Eq. (2) is a sum, not an integral over the pixel. The sum conserves the energy, but single weights are not exact: for
the open disc of HRI_EUV the weight of the central pixel is too low by 3e-4.

The mask is real, so P(-q) = P(q). If the mask is symmetric in x or in y, P is symmetric in both. If the mask also
equals its transpose, an eighth of the transforms is enough. The symmetries of the mask M are tested with a random
vector r (Freivalds): M r must equal the product of the mirrored M with r, and M r must equal r M. A mask that is
symmetric in both axes is transformed by `mirrored`, in about a quarter of the time.

| symbol | name | unit |
|---|---|---|
| lambda | wavelength_angstrom | Angstrom |
| f | focal_length_mm | mm |
| p | pixel_pitch_um | um |
| D | pupil.width_mm | mm |
| S | samples per pixel and axis, even | - |
| n | period: the transform has n x n pixels, and the inner size x size pixels are kept | px |
| c | mask.rows, open share of the cells | - |
| dx | mask.cell_mm | mm |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.convolver import transform_axis
from psfcore.diffraction.mirrored import MirroredTransforms, SampleOffset, can_transform, passes
from psfcore.diffraction.pupil import MaskGrid, Pupil
from psfcore.instruments.model import MM_PER_ANGSTROM, MM_PER_UM

STRIP_ROWS = 16
SURVEY_CELLS = 4096  # cells across the pupil when its area and symmetry are determined
FEWEST_SAMPLES = 14
SPECTRA_BYTES = 700 * 2**20  # memory for the transforms along x that are kept at the same time
_SYMMETRY_TOLERANCE_CELLS = 1e-2
_SYMMETRY_SEED = 174

NO_SYMMETRY, MIRROR, MIRROR_AND_TRANSPOSE = "none", "mirror", "mirror and transpose"

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class FarField:
    """Share of the pupil's light in each pixel [y, x], centre at [n // 2, n // 2], and how it was computed.

    The pattern sums to less than 1: the remaining light is beyond the grid.

    Attributes
    ----------
    open_area_mm2
        The open area of the pupil.
    samples
        The number of samples, S of Eq. (3).
    symmetry
        The symmetry of the mask: "none", "mirror" or "mirror and transpose".
    """

    pattern: NDArray[np.float64]
    open_area_mm2: float
    samples: int
    symmetry: str


def samples_per_pixel(
    width_mm: float, *, wavelength_angstrom: float, focal_length_mm: float, pixel_pitch_um: float
) -> int:
    """The smallest even S that satisfies Eq. (3)."""
    resolved_mm = wavelength_angstrom * MM_PER_ANGSTROM * focal_length_mm / (pixel_pitch_um * MM_PER_UM)
    return max(FEWEST_SAMPLES, 2 * math.ceil(width_mm / resolved_mm - 1e-9))


def far_field(
    pupil: Pupil,
    *,
    wavelength_angstrom: float,
    focal_length_mm: float,
    pixel_pitch_um: float,
    size: int,
    period: int | None = None,
    threads: int = 1,
    progress: Progress | None = None,
) -> FarField:
    """The far field of a pupil, Eq. (2), with a pattern of shape (size, size).

    Parameters
    ----------
    period
        The period n, at least `size`, both even or both odd; default: size.
    progress
        Function that is called with (done, of) after each transform.
    """
    n = period or size
    optics = {
        "wavelength_angstrom": wavelength_angstrom,
        "focal_length_mm": focal_length_mm,
        "pixel_pitch_um": pixel_pitch_um,
    }
    samples = samples_per_pixel(pupil.width_mm, **optics)
    cell_mm = wavelength_angstrom * MM_PER_ANGSTROM * focal_length_mm / (n * pixel_pitch_um * MM_PER_UM)
    mask = MaskGrid(pupil, cell_mm)
    with ThreadPoolExecutor(max_workers=threads) as pool:
        survey = _survey(MaskGrid(pupil, pupil.width_mm / SURVEY_CELLS), pool)
        places = _places(samples, survey.symmetry)
        transforms: MirroredTransforms | _Transforms
        if survey.mirror_x and survey.mirror_y and can_transform(n):
            transforms = MirroredTransforms(mask, period=n, size=size, pool=pool, threads=threads)
        else:
            transforms = _Transforms(mask, survey, samples // 2, n, size, pool, threads)
        summed = transforms.summed(places, progress or (lambda done, of: None))
    pattern = _completed(summed, survey.symmetry)
    pattern /= float(n) ** 2 * samples**2 * survey.open_area_mm2 / cell_mm**2
    sinc = np.sinc((np.arange(size) - size // 2) / n)
    pattern /= sinc[:, None] ** 2
    pattern /= sinc[None, :] ** 2
    return FarField(pattern, survey.open_area_mm2, samples, survey.symmetry)


@dataclass(frozen=True)
class _Survey:
    """Area and symmetry of the mask.

    Attributes
    ----------
    mirror_x, mirror_y
        Whether the mask equals its mirror image in x, and in y.
    """

    open_area_mm2: float
    symmetry: str
    mirror_x: bool
    mirror_y: bool


def _survey(mask: MaskGrid, pool: ThreadPoolExecutor) -> _Survey:
    """The open area of the mask, and its symmetry, tested with a random vector.

    The cells of this mask may be larger or smaller than the cells of the transform. No detail of the pupil is lost,
    because each cell holds the open share of its area.
    """
    r = np.random.default_rng(_SYMMETRY_SEED).random(mask.cells)
    right = np.stack([r, r[::-1]], axis=1)

    def multiply(first: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        strip = mask.rows(first, min(first + STRIP_ROWS, mask.cells)).astype(np.float64)
        return strip @ right, r[first : first + len(strip)] @ strip, float(strip.sum())

    mask.rows(0, 1)  # compile the kernels in this thread, whose listener tells the user
    after, before, open_cells = [], np.zeros(mask.cells), 0.0
    for strip_after, strip_before, strip_sum in pool.map(multiply, range(0, mask.cells, STRIP_ROWS)):
        after.append(strip_after)
        before += strip_before
        open_cells += strip_sum
    by_row, by_mirrored_row = np.concatenate(after).T  # M r, M r[::-1]
    area_mm2 = open_cells * mask.cell_mm**2
    # If M is mirrored in y, its product with r is (M r)[::-1].
    mirror_x, mirror_y, transpose = (
        float(np.abs(by_row - other).max()) < _SYMMETRY_TOLERANCE_CELLS
        for other in (by_mirrored_row, by_row[::-1], before)
    )
    mirrored = MIRROR_AND_TRANSPOSE if transpose else MIRROR
    return _Survey(area_mm2, mirrored if mirror_x or mirror_y else NO_SYMMETRY, mirror_x, mirror_y)


class _Transforms:
    """Computes the sum of |E|^2 over samples, for any mask: a transform of Eq. (2) for each place.

    The result has the shape (size, size).

    Parameters
    ----------
    offsets
        The number of different offsets in x of all places.
    """

    def __init__(
        self,
        mask: MaskGrid,
        survey: _Survey,
        offsets: int,
        period: int,
        size: int,
        pool: ThreadPoolExecutor,
        threads: int,
    ) -> None:
        self.mask, self.period = mask, period
        self.kept = slice(period // 2 - size // 2, period // 2 - size // 2 + size)
        self.pool, self.threads = pool, threads
        # If the mask is symmetric in y, half of its rows are enough.
        rows = mask.cells // 2 if survey.mirror_y else mask.cells
        # One pass over the mask computes the spectra of several offsets. SPECTRA_BYTES limits their number.
        together = max(1, min(offsets, SPECTRA_BYTES // (8 * rows * size)))
        self.spectra = np.empty((together, rows, size), dtype=np.complex64)
        self.field = np.empty((period, size), dtype=np.complex64)
        self.total = np.zeros((size, size))

    def summed(self, places: Sequence[SampleOffset], progress: Progress) -> NDArray[np.float64]:
        """The sum of |E|^2 over the places, each multiplied by its weight. progress(done, of)."""
        done = 0
        for here, of_pass in passes(places, len(self.spectra)):
            self._transform_along_x(here)
            for place in of_pass:
                self._transform_along_y(self.spectra[here.index(place.offset_x)], place.offset_y)
                self._add(place.weight)
                done += 1
                progress(done, len(places))
        return self.total

    def _transform_along_x(self, offsets: Sequence[float]) -> None:
        """Compute spectra[y, j] of all rows, for several offsets in x."""
        phases = [self._phases(offset) for offset in offsets]

        def transform(block: slice) -> None:
            strip = np.empty((STRIP_ROWS, self.mask.cells), dtype=np.float32)
            folded = np.empty((STRIP_ROWS, self.period), dtype=np.complex64)
            for first in range(block.start, block.stop, STRIP_ROWS):
                stop = min(first + STRIP_ROWS, block.stop)
                rows, part = self.mask.rows(first, stop, out=strip), folded[: stop - first]
                for spectrum, (within, of_period) in zip(self.spectra, phases, strict=False):
                    _fold_strip(rows, within, of_period, part)
                    spectrum[first:stop] = transform_axis(part, axis=1)[:, self.kept]

        list(self.pool.map(transform, _blocks(self.spectra.shape[1], self.threads)))

    def _transform_along_y(self, spectrum: NDArray[np.complex64], offset: float) -> None:
        """Compute field[j_y, j_x] for one offset in y, for all j_y of the period."""
        within, of_period = self._phases(offset)

        def fold(block: slice) -> None:
            _fold_block(spectrum, self.mask.cells, within, of_period, self.field, block.start, block.stop)

        list(self.pool.map(fold, _blocks(self.period, self.threads)))
        self.field = transform_axis(self.field, axis=0, threads=self.threads)

    def _phases(self, offset: float) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """exp(-2 pi i turns (m + k n) / n) as a product of two factors: the first for each m, the second for each k.

        turns: o_s - n // 2. Because of the term n // 2, the centre of the pattern is at [n // 2], and no shift is
        needed.
        """
        turns, n = offset - self.period // 2, self.period
        within = np.exp(-2j * np.pi * turns * np.arange(n) / n)
        of_period = np.exp(-2j * np.pi * turns * np.arange(math.ceil(self.mask.cells / n)))
        return within.astype(np.complex64), of_period.astype(np.complex64)

    def _add(self, weight: float) -> None:
        field = self.field[self.kept]
        blocks = _blocks(len(self.total), self.threads)
        list(self.pool.map(lambda block: _add_intensity(field[block], self.total[block], weight), blocks))


def _places(samples: int, symmetry: str) -> list[SampleOffset]:
    """The positions (s, t) that must be computed, in ascending order, with their weights.

    The symmetry of the mask decides whether t takes all values, the first half, or the values up to s. In the last case
    the transpose of the sum is added at the end. Positions with s = t would then count twice, so they get half the
    weight.
    """
    half, transpose = samples // 2, symmetry == MIRROR_AND_TRANSPOSE
    offsets = [(place + 0.5) / samples - 0.5 for place in range(samples)]  # o_s of Eq. (2)
    return [
        SampleOffset(offsets[s], offsets[t], 0.5 if transpose and s == t else 1.0)
        for s in range(half)
        for t in range({NO_SYMMETRY: samples, MIRROR: half, MIRROR_AND_TRANSPOSE: s + 1}[symmetry])
    ]


def _completed(total: NDArray[np.float64], symmetry: str) -> NDArray[np.float64]:
    """Add the intensities for the positions (s, t) that were left out.

    They are mirror images of the computed intensities. If the mask equals its transpose, they also include the
    transpose of the computed intensities.
    """
    n = len(total)
    mirror = (2 * (n // 2) - np.arange(n)) % n
    if symmetry == MIRROR_AND_TRANSPOSE:
        total = total + total.T
    if symmetry == NO_SYMMETRY:
        return np.asarray(total + total[np.ix_(mirror, mirror)])
    total = total + total[mirror]
    return np.asarray(total + total[:, mirror])


def _blocks(size: int, threads: int) -> list[slice]:
    step = math.ceil(size / (4 * threads))
    return [slice(first, min(first + step, size)) for first in range(0, size, step)]


@compiled(fastmath=True)
def _fold_strip(strip, within, of_period, folded):  # type: ignore[no-untyped-def]  # compiled
    """folded[y, m] = sum over k of c[y, m + k n] exp(-2 pi i turns (m + k n) / n)."""
    rows, cells = strip.shape
    size = len(within)
    real, imaginary = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
    for y in range(rows):
        real[:] = 0
        imaginary[:] = 0
        for k in range(len(of_period)):
            a, b = of_period[k].real, of_period[k].imag
            part = strip[y, k * size : min((k + 1) * size, cells)]
            for m in range(len(part)):
                real[m] += a * part[m]
                imaginary[m] += b * part[m]
        for m in range(size):
            folded[y, m] = within[m] * complex(real[m], imaginary[m])


@compiled(fastmath=True)
def _fold_block(spectra, cells, within, of_period, field, start, stop):  # type: ignore[no-untyped-def]  # compiled
    """field[m] = sum over k of spectra[m + k n] exp(-2 pi i turns (m + k n) / n).

    Rows of spectra that were not computed are mirror images of computed rows.
    """
    rows, columns = spectra.shape
    period = len(field)
    for m in range(start, stop):
        field[m, :] = 0
        for k in range(len(of_period)):
            row = m + k * period
            if row < cells:
                factor = within[m] * of_period[k]
                source = spectra[row if row < rows else cells - 1 - row]
                for x in range(columns):
                    field[m, x] += factor * source[x]


@compiled(fastmath=True)
def _add_intensity(field: NDArray[np.complex128], total: NDArray[np.float64], weight: float) -> None:
    rows, columns = field.shape
    for y in range(rows):
        for x in range(columns):
            total[y, x] += weight * (field[y, x].real ** 2 + field[y, x].imag ** 2)
