"""The PSF on fine pixels: FINE of them along a detector pixel, boxed down only at the detector.

    K[o] = mean over fine pixels s of a source pixel, sum over fine pixels t of a target pixel, of k[FINE o + t - s]   Eq. (1)
    s_fine(r) = a / FINE^2 / (b + r)^c off the centre                                                    Eq. (2)

k is the fine kernel, K what an evenly lit detector pixel sends to another. The fine centre takes what makes the
boxed centre 1 - total, so that the boxed scatter is a law on detector pixels but for its curvature within
a pixel.

| symbol | name | unit |
|---|---|---|
| a, b, c, total | law: a ScatterTruth | px^c, px, -, - |
| r | distance between fine pixels | detector px |
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.build import build_psf
from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.diffraction.mesh_series import rotated_mesh_kernel
from psfcore.instruments.model import Instrument, load_instrument
from psfcore.simulate.scatter_truth import ScatterTruth

Kernel = NDArray[np.float64]
FINE = 2
SYNTHETIC, INSTRUMENT = "synthetic", "hri_euv"
_ORDERS = 40  # of a synthetic mesh, each way
_LARGEST_BUILT_PX = 2048


@dataclass(frozen=True)
class Glass:
    """The known part of the PSF: a pupil's pattern and a mesh's orders, sum 1 on size_px detector pixels.

    kind: SYNTHETIC or the name of an instrument whose mount and meshes are built. Of a synthetic one: the scales of
    its core, far below a pixel as a telescope's is at this wavelength, and of its wing; the light in the wing and in
    the mesh's orders, and the orders' spacing.
    """

    kind: str
    size_px: int
    core_px: float = 0.2
    wing_px: float = 2.0
    wing_share: float = 0.1
    arm_share: float = 0.15
    pitch_px: float = 5.7

    def fine(self, turn_deg: float = 0.0, pitch_factor: float = 1.0) -> Kernel:
        """Fine weights [y, x], sum 1, with the mesh turned and its orders' spacing times pitch_factor."""
        size = FINE * self.size_px
        if self.kind == SYNTHETIC:
            kernel = self._drawn(size, turn_deg, pitch_factor)
        else:
            kernel = _built(self.kind, size, turn_deg, pitch_factor)
        return np.asarray(kernel / kernel.sum())

    def _drawn(self, size: int, turn_deg: float, pitch_factor: float) -> Kernel:
        """A core with wings, and orders along two axes that fall off with their number."""
        d = (np.arange(size) - size // 2) / FINE
        x, y = d[None, :], d[:, None]
        core, wing = (np.exp(-np.hypot(x, y) / scale) for scale in (self.core_px, self.wing_px))
        cos, sin = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
        orders = np.zeros((size, size))
        numbers = np.array([n for n in range(-_ORDERS, _ORDERS + 1) if n])
        light = 1 / (1 + numbers**2 / 9.0)
        for n, weight in zip(numbers, light / (2 * light.sum()), strict=True):
            at = n * self.pitch_px * pitch_factor
            for order_x, order_y in ((at * cos, at * sin), (-at * sin, at * cos)):
                _add_spot(orders, order_x, order_y, weight)
        centred = (1 - self.wing_share) * core / core.sum() + self.wing_share * wing / wing.sum()
        return np.asarray((1 - self.arm_share) * centred + self.arm_share * orders)


def _add_spot(plane: Kernel, x_px: float, y_px: float, light: float) -> None:
    """A Gaussian of 0.45 px at an offset from the centre, in the place of an order."""
    size = plane.shape[0]
    column, row = (round(at * FINE) + size // 2 for at in (x_px, y_px))
    reach = 3 * FINE
    rows = np.arange(max(0, row - reach), min(size, row + reach + 1))
    columns = np.arange(max(0, column - reach), min(size, column + reach + 1))
    if rows.size and columns.size:
        dy, dx = ((at - size // 2) / FINE for at in (rows, columns))
        spot = np.exp(-((dy[:, None] - y_px) ** 2 + (dx[None, :] - x_px) ** 2) / (2 * 0.45**2))
        plane[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += (
            light * spot / (2 * np.pi * (0.45 * FINE) ** 2)
        )


def _built(name: str, size: int, turn_deg: float, pitch_factor: float) -> Kernel:
    """Mount, entrance mesh and filter-wheel mesh of an instrument convolved; its entrance mesh may be off.

    The mesh in front is taken as a pattern of its own, which blurs its orders by the pupil once more: known to
    whoever gets the file, and it lets the mesh be turned against the rest.
    """
    instrument = load_instrument(name)
    entrance = next(mesh for mesh in instrument.meshes if mesh.place == "entrance")
    orders = rotated_mesh_kernel(
        wavelength_angstrom=instrument.wavelength_angstrom,
        distance_mm=instrument.mesh_distance_mm(entrance),
        pitch_um=entrance.pitch_um / pitch_factor,
        wire_um=entrance.wire_um / pitch_factor,
        windows=entrance.windows,
        pixel_pitch_um=instrument.detector.pixel_pitch_um / FINE,
        angle_deg=entrance.angle_deg + turn_deg,
        size=size,
    )
    return linear_convolve(_pupil(name, size), orders, (size, size))


@cache
def _pupil(name: str, size: int) -> Kernel:
    """What of an instrument's diffraction is not its entrance mesh, on fine pixels: seconds, so it is kept."""
    fine = _with_fine_pixels(load_instrument(name))
    built = min(size, _LARGEST_BUILT_PX)
    parts = [build_psf(fine, size=built, component=part).kernel for part in ("MOUNT", "FILTER_WHEEL")]
    return linear_convolve(parts[0], parts[1], (size, size))


def _with_fine_pixels(instrument: Instrument) -> Instrument:
    detector = instrument.detector
    changes = {
        "pixel_pitch_um": detector.pixel_pitch_um / FINE,
        "plate_scale_arcsec": detector.plate_scale_arcsec / FINE,
    }
    return instrument.model_copy(update={"detector": detector.model_copy(update=changes)})


@dataclass(frozen=True, eq=False)
class FineOptics:
    """A telescope: fine scatter and fine diffraction, kernels [y, x] with centre at [n // 2, n // 2].

    law, glass: what they were made of, for effects that make them anew.
    """

    law: ScatterTruth
    glass: Glass
    scatter: Kernel
    diffraction: Kernel

    @cached_property
    def total(self) -> Kernel:
        """Fine total PSF on the scatter's array."""
        n = self.scatter.shape[0]
        return linear_convolve(self.scatter, self.diffraction, (n, n))

    @cached_property
    def through(self) -> Convolver:
        """The total PSF on a fine field of half the scatter's array."""
        return Convolver(self.total, self.field, dtype=np.float64)

    @cached_property
    def more_scatter(self) -> Convolver:
        """What scattering all of the scattered light once more would add: light to the wings, out of the core."""
        moved, middle = self.scatter.copy(), self.scatter.shape[0] // 2
        moved[middle, middle] = 0.0
        moved[middle, middle] = (
            self.scatter[middle, middle] - 1
        )  # all the light that is scattered, to any distance
        n = moved.shape[0]
        return Convolver(linear_convolve(moved, self.diffraction, (n, n)), self.field, dtype=np.float64)

    @property
    def field(self) -> tuple[int, int]:
        """Shape of the fine field that the kernels can serve."""
        return self.scatter.shape[0] // 2, self.scatter.shape[1] // 2

    @property
    def offsets_px(self) -> tuple[Kernel, Kernel]:
        """x (1, n) and y (n, 1) of each fine pixel of the scatter's array, detector px from its centre."""
        d = (np.arange(self.scatter.shape[0]) - self.scatter.shape[0] // 2) / FINE
        return d[None, :], d[:, None]


def fine_optics(law: ScatterTruth, glass: Glass, size_px: int) -> FineOptics:
    """The telescope without any effect, as far as a field of size_px can see."""
    n = 2 * FINE * size_px
    d = (np.arange(n) - n // 2) / FINE
    falloff = (law.b_px + np.hypot(d[:, None], d[None, :])) ** -law.c
    return FineOptics(law, glass, scaled_scatter(falloff, law, law.a / FINE**2), glass.fine())


def scaled_scatter(falloff: Kernel, law: ScatterTruth, amplitude: float) -> Kernel:
    """Eq. (2) of a falloff [y, x], and the centre that makes the boxed one 1 - total."""
    scatter = amplitude * falloff
    middle = scatter.shape[0] // 2
    scatter[middle, middle] = 0.0
    within = scatter[middle - FINE + 1 : middle + FINE, middle - FINE + 1 : middle + FINE]
    scatter[middle, middle] = 1 - law.total - float((within * np.outer(_triangle(), _triangle())).sum())
    return scatter


def boxed_kernel(fine: Kernel) -> Kernel:
    """Eq. (1): what the detector's own pixels know of a fine kernel [y, x] of even size; sum kept but for edges."""
    n = fine.shape[0]
    columns = sum(
        weight * _shifted(fine, shift, 1)[:, ::FINE]
        for shift, weight in zip(range(1 - FINE, FINE), _triangle(), strict=True)
    )
    rows = sum(
        weight * _shifted(np.asarray(columns), shift, 0)[::FINE]
        for shift, weight in zip(range(1 - FINE, FINE), _triangle(), strict=True)
    )
    return np.asarray(rows).reshape(n // FINE, n // FINE)


def boxed_glass(glass: Glass) -> Kernel:
    """The known PSF as a transit's folder has it: detector pixels, sum 1."""
    kernel = boxed_kernel(glass.fine())
    return np.asarray(kernel / kernel.sum())


def _triangle() -> NDArray[np.float64]:
    """Eq. (1) along one axis: how often a fine offset joins two fine pixels of two given detector pixels."""
    return np.asarray(1 - np.abs(np.arange(1 - FINE, FINE)) / FINE)


def _shifted(plane: Kernel, by: int, axis: int) -> Kernel:
    """Element n becomes n + by, 0 beyond the edge."""
    moved = np.roll(plane, -by, axis=axis)
    lost = [slice(None), slice(None)]
    lost[axis] = slice(-by, None) if by > 0 else slice(0, -by)
    if by:
        moved[tuple(lost)] = 0.0
    return moved


def turned_offsets(optics: FineOptics, angle_deg: float) -> tuple[Kernel, Kernel]:
    """Offsets along and across an angle (from +x towards +y), detector px."""
    x, y = optics.offsets_px
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return x * cos + y * sin, y * cos - x * sin


def small_kernel(weights: Kernel) -> Kernel:
    """A kernel [y, x] scaled to sum 1."""
    return np.asarray(weights / weights.sum())
