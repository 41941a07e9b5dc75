"""The simulated PSF on fine pixels. Along each axis, FINE fine pixels cover one detector pixel.

    K[o] = mean over s of ( sum over t of k[FINE o + t - s] )                                            Eq. (1)
    s_fine(r) = a / FINE^2 / (b + r)^c          for r > 0                                                Eq. (2)

k is the fine kernel, and K is the kernel on detector pixels: the fraction of the light of a uniformly bright detector
pixel that reaches another detector pixel at the offset o. In Eq. (1), s are the fine pixels of the source pixel, and
t the fine pixels of the target pixel. s_fine is the fine scatter kernel. Its central pixel is set so that the central
pixel of the binned kernel is 1 - total. The binned scatter then follows the power law on detector pixels, except for
the curvature of the law within a pixel.

The simulation bins the light only at the detector.

| symbol | name | unit |
|---|---|---|
| a, b, c, total | parameters of the scatter: a `ScatterTruth`, called law | px^c, px, -, - |
| r | distance between fine pixels | detector px |
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from scipy.ndimage import convolve1d

from psfcore.build import build_psf
from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.diffraction.mesh_series import order_spacing_px, rotated_mesh_kernel
from psfcore.instruments.model import load_instrument
from psfcore.psf import Kernel
from psfcore.simulate.scatter_truth import ScatterTruth

FINE = 2
# The weights in Eq. (1) along one axis: the fraction of pairs (s, t) of fine pixels with each offset.
_TRIANGLE = 1 - np.abs(np.arange(1 - FINE, FINE)) / FINE
SYNTHETIC, INSTRUMENT = "synthetic", "hri_euv"
_ORDERS, _SPOT_PX = (
    40,
    0.45,
)  # of a synthetic mesh: number of orders in each direction, standard deviation of a spot
_LARGEST_BUILT_PX = 2048


@dataclass(frozen=True)
class Glass:
    """The known part of the PSF: the diffraction by a pupil and the orders of a mesh. Its sum is 1.

    The fields after `size_px` describe a synthetic pattern.

    Attributes
    ----------
    kind
        SYNTHETIC, or the name of an instrument whose mount and meshes are built.
    size_px
        Size of the array in detector pixels.
    core_px, wing_px
        The exponential scales of the core and of the wing; the core is far narrower than a pixel, as in a real
        telescope at this wavelength.
    wing_share, arm_share
        The fractions of the light in the wing and in the orders of the mesh.
    pitch_px
        The spacing of the orders.
    """

    kind: str
    size_px: int
    core_px: float = 0.2
    wing_px: float = 2.0
    wing_share: float = 0.1
    arm_share: float = 0.15
    pitch_px: float = 5.7

    def fine(self, turn_deg: float = 0.0, pitch_factor: float = 1.0) -> Kernel:
        """The fine kernel [y, x], sum 1, with the mesh rotated by turn_deg and its order spacing multiplied by
        pitch_factor.
        """
        size = FINE * self.size_px
        if self.kind == SYNTHETIC:
            kernel = self._drawn(size, turn_deg, pitch_factor)
        else:
            kernel = _built(self.kind, size, turn_deg, pitch_factor)
        return np.asarray(kernel / kernel.sum())

    def _drawn(self, size: int, turn_deg: float, pitch_factor: float) -> Kernel:
        """A synthetic pattern: a core with wings, and orders along two axes, which are Gaussian spots.

        The intensity of order n decreases with |n|.
        """
        d = (np.arange(size) - size // 2) / FINE
        r = np.hypot(d[None, :], d[:, None])
        core, wing = np.exp(-r / self.core_px), np.exp(-r / self.wing_px)
        centred = (1 - self.wing_share) * core / core.sum() + self.wing_share * wing / wing.sum()
        numbers = np.array([n for n in range(-_ORDERS, _ORDERS + 1) if n])
        light = 1 / (1 + numbers**2 / 9.0)
        way = numbers * self.pitch_px * pitch_factor
        cos, sin = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
        x, y = np.append(way * cos, -way * sin), np.append(way * sin, way * cos)
        along_x, along_y = (np.exp(-((d - at[:, None]) ** 2) / (2 * _SPOT_PX**2)) for at in (x, y))
        orders = along_y.T @ (np.append(light, light)[:, None] * along_x)
        orders /= 2 * light.sum() * 2 * np.pi * (_SPOT_PX * FINE) ** 2
        return np.asarray((1 - self.arm_share) * centred + self.arm_share * orders)


def _built(name: str, size: int, turn_deg: float, pitch_factor: float) -> Kernel:
    """The convolved patterns of mount, entrance mesh and filter-wheel mesh of an instrument, with a changed entrance
    mesh.

    The pattern of the entrance mesh is computed separately, so that only this mesh is rotated. This pattern already
    contains the blur by the pupil; the convolution adds this blur a second time. The known PSF of the case contains the
    same blur.
    """
    instrument = load_instrument(name)
    entrance = next(mesh for mesh in instrument.meshes if mesh.place == "entrance")
    pitch_um = entrance.pitch_um / pitch_factor
    spacing_px = order_spacing_px(
        wavelength_angstrom=instrument.wavelength_angstrom,
        distance_mm=instrument.mesh_distance_mm(entrance),
        pitch_um=pitch_um,
        pixel_pitch_um=instrument.detector.pixel_pitch_um / FINE,
    )
    orders = rotated_mesh_kernel(
        spacing_px,
        pitch_um=pitch_um,
        wire_um=entrance.wire_um / pitch_factor,
        windows=entrance.windows,
        angle_deg=entrance.angle_deg + turn_deg,
        size=size,
    )
    return linear_convolve(_pupil(name, size), orders, (size, size))


@cache
def _pupil(name: str, size: int) -> Kernel:
    """The diffraction PSF of an instrument without its entrance mesh, on fine pixels. The result is kept, because the
    computation takes seconds.
    """
    instrument = load_instrument(name)
    detector = instrument.detector
    pitch_um, scale_arcsec = detector.pixel_pitch_um / FINE, detector.plate_scale_arcsec / FINE
    detector = replace(detector, pixel_pitch_um=pitch_um, plate_scale_arcsec=scale_arcsec)
    fine, built = replace(instrument, detector=detector), min(size, _LARGEST_BUILT_PX)
    parts = [build_psf(fine, size=built, component=part).kernel for part in ("MOUNT", "FILTER_WHEEL")]
    return linear_convolve(parts[0], parts[1], (size, size))


@dataclass(frozen=True, eq=False)
class FineOptics:
    """A telescope: its scatter kernel and its diffraction PSF on fine pixels [y, x], each with the centre at [n // 2, n
    // 2].

    Attributes
    ----------
    law, glass
        The parameters of the scatter kernel and of the diffraction PSF; effects use them to compute changed kernels.
    """

    law: ScatterTruth
    glass: Glass
    scatter: Kernel
    diffraction: Kernel

    @cached_property
    def total(self) -> Kernel:
        """The fine total PSF; its array has the size of the scatter kernel."""
        n = self.scatter.shape[0]
        return linear_convolve(self.scatter, self.diffraction, (n, n))

    @cached_property
    def through(self) -> Convolver:
        """The convolution with the total PSF, for a fine field of half the size of the scatter kernel."""
        return Convolver(self.total, self.field, dtype=np.float64)

    @cached_property
    def more_scatter(self) -> Convolver:
        """The convolution with the change of the PSF if the scatter is doubled: light moves from the core to the
        wings.
        """
        moved, middle = self.scatter.copy(), self.scatter.shape[0] // 2
        moved[middle, middle] = 0.0
        moved[middle, middle] = self.scatter[middle, middle] - 1  # minus all scattered light, at any distance
        n = moved.shape[0]
        return Convolver(linear_convolve(moved, self.diffraction, (n, n)), self.field, dtype=np.float64)

    @property
    def field(self) -> tuple[int, int]:
        """The shape of the largest fine field that the kernels cover."""
        return self.scatter.shape[0] // 2, self.scatter.shape[1] // 2

    @property
    def offsets_px(self) -> tuple[Kernel, Kernel]:
        """X (1, n) and y (n, 1) of the fine pixels of the scatter kernel, in detector px from its centre."""
        d = (np.arange(self.scatter.shape[0]) - self.scatter.shape[0] // 2) / FINE
        return d[None, :], d[:, None]


def fine_optics(law: ScatterTruth, glass: Glass, size_px: int) -> FineOptics:
    """The telescope without any effect, with kernels that cover a field of size_px detector pixels."""
    n = 2 * FINE * size_px
    d = (np.arange(n) - n // 2) / FINE
    falloff = (law.b_px + np.hypot(d[:, None], d[None, :])) ** -law.c
    return FineOptics(law, glass, scaled_scatter(falloff, law, law.a / FINE**2), glass.fine())


def scaled_scatter(falloff: Kernel, law: ScatterTruth, amplitude: float) -> Kernel:
    """The fine scatter kernel of Eq. (2) with another falloff [y, x] in place of the power law.

    The central pixel is set so that the central pixel of the binned kernel is 1 - total.
    """
    scatter = amplitude * falloff
    middle = scatter.shape[0] // 2
    scatter[middle, middle] = 0.0
    within = scatter[middle - FINE + 1 : middle + FINE, middle - FINE + 1 : middle + FINE]
    scatter[middle, middle] = 1 - law.total - float(_TRIANGLE @ within @ _TRIANGLE)
    return scatter


def binned_kernel(fine: Kernel) -> Kernel:
    """Eq. (1): bin a fine kernel [y, x] of even size to detector pixels. Light is lost only at the edges of the
    array.
    """
    columns = convolve1d(fine, _TRIANGLE, axis=1, mode="constant")[:, ::FINE]
    return np.asarray(convolve1d(columns, _TRIANGLE, axis=0, mode="constant")[::FINE])


def binned_glass(glass: Glass) -> Kernel:
    """The known PSF on detector pixels, sum 1: the content of diffraction.fits of a transit."""
    kernel = binned_kernel(glass.fine())
    return np.asarray(kernel / kernel.sum())


def turned_offsets(optics: FineOptics, angle_deg: float) -> tuple[Kernel, Kernel]:
    """The offsets of the fine pixels along and across a direction, in detector px.

    Parameters
    ----------
    angle_deg
        The direction, from +x towards +y.
    """
    x, y = optics.offsets_px
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return x * cos + y * sin, y * cos - x * sin
