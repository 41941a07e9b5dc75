"""The diffraction of a whole telescope: entrance pupil and filter-wheel meshes, component by component.

Hofmeister et al., The point-spread function of HRI_EUV, section "Implementation", the simplified-combined solution. The
pattern of the entrance pupil (aperture, mount and entrance mesh in one mask) is a Fraunhofer transform; the pattern of
the filter-wheel mesh is an analytic series. Both patterns are convolved with each other. The patterns of the spectral
lines of the bandpass are multiplied by the weights of the lines and added.

One rule decides how each component of the entrance is computed, and the provenance records the decision:

- The mask is transformed if at most 32 samples per pixel are needed (fraunhofer, Eq. (3)). Otherwise the pattern of
  the aperture is analytic (an Airy pattern, or that of the edges of a sector or polygon), and a mount is left out.
- The transformed mask contains the entrance meshes if all of them are square, cover the whole pupil and are parallel to
  the pixels. Otherwise each mesh is an analytic series, rotated by the angle of the mesh. The series of meshes side by
  side are multiplied by their shares and added. The result is convolved with the pattern of the aperture and its mount.

| symbol | name |
|---|---|
| S | samples, per pixel and axis |
| P | patterns: the share of a point's light in each pixel [y, x], centre at [n // 2, n // 2] |
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Kernel
from psfcore.convolution.convolver import linear_convolve
from psfcore.diffraction.fraunhofer import Progress, far_field, samples_per_pixel
from psfcore.diffraction.mesh_series import (
    hexagonal_mesh_kernel,
    mesh_line,
    order_spacing_px,
    rotated_mesh_kernel,
)
from psfcore.diffraction.open_aperture import airy_kernel, edge_kernel
from psfcore.diffraction.pupil import entrance_pupil
from psfcore.instruments.model import Instrument, Mesh, Mount
from psfcore.instruments.workload import MOST_MASK_SAMPLES, PERIOD_PX, windows_of

STEPS_A_PUPIL = 20  # steps of progress for each component
AIRY, ENTRANCE_MESH, MOUNT, ENTRANCE = "AIRY", "ENTRANCE_MESH", "MOUNT", "ENTRANCE"
FILTER_WHEEL, DIFFRACTION = "FILTER_WHEEL", "DIFFRACTION"


@dataclass(frozen=True)
class Route:
    """Which components of the entrance the transformed mask contains. str() gives this decision and the reason for
    it.
    """

    samples: int
    mask: bool
    meshes_in_mask: bool
    mount: bool
    round: bool

    def __str__(self) -> str:
        if not self.mask:
            too_many = f"{self.samples} samples a pixel are more than {MOST_MASK_SAMPLES}"
            pattern = "Airy pattern" if self.round else "pattern of the edges"
            return f"{too_many}: analytic {pattern}, entrance meshes as series, no mount"
        meshes = "in it" if self.meshes_in_mask else "as series"
        return f"Fraunhofer transform of the mask, {self.samples} samples a pixel, entrance meshes {meshes}"


@dataclass
class Patterns:
    """The pattern of each component (the share of all light in each pixel), and notes on how it was computed."""

    kernels: dict[str, Kernel] = field(default_factory=dict)
    notes: dict[str, object] = field(default_factory=dict)


def route_of(instrument: Instrument) -> Route:
    """Apply the rule of this module. The number of samples is the largest number that a line of the bandpass needs."""
    samples = max(
        samples_per_pixel(
            instrument.aperture.diameter_mm,
            wavelength_angstrom=line.wavelength_angstrom,
            focal_length_mm=instrument.focal_length_mm,
            pixel_pitch_um=instrument.detector.pixel_pitch_um,
        )
        for line in instrument.spectral_lines
    )
    mask = samples <= MOST_MASK_SAMPLES
    plain = all(
        mesh.share == 1 and mesh.angle_deg % 90 == 0 and mesh.openings == "square"
        for mesh in _meshes(instrument, "entrance")
    )
    return Route(
        samples=samples,
        mask=mask,
        meshes_in_mask=mask and plain,
        mount=mask and instrument.mount is not None,
        round=instrument.aperture.round,
    )


def available_parts(instrument: Instrument) -> tuple[str, ...]:
    """Names of the components of this instrument, in the order in which they are computed."""
    route = route_of(instrument)
    has = {
        ENTRANCE_MESH: bool(_meshes(instrument, "entrance")),
        MOUNT: route.mount,
        FILTER_WHEEL: bool(_meshes(instrument, "filter_wheel")),
    }
    names = (AIRY, ENTRANCE_MESH, MOUNT, ENTRANCE, FILTER_WHEEL, DIFFRACTION)
    return tuple(name for name in names if has.get(name, True))


def needed_parts(names: Iterable[str], available: Iterable[str], *, meshes_in_mask: bool) -> set[str]:
    """The components that must be computed to obtain the components of these names.

    Parameters
    ----------
    available
        All components of the instrument.
    """
    needed, there = set(names), set(available)
    if DIFFRACTION in needed:
        needed |= {ENTRANCE, FILTER_WHEEL} & there
    if ENTRANCE in needed and not (meshes_in_mask and {ENTRANCE_MESH, MOUNT} <= there):
        needed |= {ENTRANCE_MESH, MOUNT} & there or {AIRY}
    if ENTRANCE_MESH in needed and not meshes_in_mask:
        needed.add(AIRY)
    return needed & there


def diffraction_patterns(
    instrument: Instrument,
    *,
    size: int,
    names: Iterable[str],
    mount_image: NDArray[np.floating] | None = None,
    threads: int = 1,
    progress: Progress | None = None,
) -> Patterns:
    """Compute the components of these names, shape (size, size), not normalised.

    The patterns of the spectral lines are multiplied by the weights of the lines and added.

    Parameters
    ----------
    mount_image
        Pixels [y, x] of the mount's mask image, if the instrument has one.
    progress
        Function that is called with (done, of).
    """
    route, available = route_of(instrument), available_parts(instrument)
    needed = needed_parts(names, available, meshes_in_mask=route.meshes_in_mask)
    patterns = Patterns(notes={"entrance_route": str(route)})
    lines = instrument.spectral_lines
    steps = len(lines) * len(needed) * STEPS_A_PUPIL
    before = 0

    def report(done: int, of: int) -> None:
        if progress is not None:
            progress(before + STEPS_A_PUPIL * done // of, steps)

    for line in lines:
        work = _OneWavelength(
            instrument, route, line.wavelength_angstrom, size, mount_image, threads, patterns.notes
        )
        for name in (part for part in available if part in needed):
            report(0, 1)
            work.kernels[name] = work.kernel(name, report)
            report(1, 1)
            before += STEPS_A_PUPIL
        for name, one in work.kernels.items():
            kernel = line.weight * one if len(lines) > 1 else one
            patterns.kernels[name] = patterns.kernels[name] + kernel if name in patterns.kernels else kernel
    return patterns


@dataclass
class _OneWavelength:
    """All components at one wavelength, each computed from the aperture or from earlier components."""

    instrument: Instrument
    route: Route
    wavelength_angstrom: float
    size: int
    mount_image: NDArray[np.floating] | None
    threads: int
    notes: dict[str, object]
    kernels: dict[str, Kernel] = field(default_factory=dict)

    def kernel(self, name: str, progress: Progress) -> Kernel:
        """One component. The components from which it is computed must exist in `kernels`."""
        there, in_mask = self.kernels, self.route.meshes_in_mask
        meshes, mount = _meshes(self.instrument, "entrance"), self.instrument.mount
        if name == AIRY:
            return self._aperture(progress)
        if name == ENTRANCE_MESH and in_mask:
            return self._far_field(name, meshes, None, progress)
        if name == ENTRANCE_MESH:
            return self._convolved(there[AIRY], self._series("entrance"))
        if name == MOUNT:
            return self._far_field(name, (), mount, progress)
        if name == FILTER_WHEEL:
            return self._series("filter_wheel")
        if name == DIFFRACTION:
            wheel = there.get(FILTER_WHEEL)
            return there[ENTRANCE] if wheel is None else self._convolved(there[ENTRANCE], wheel)
        # The whole entrance pupil. If it has no mesh or no mount, its pattern has been computed already.
        if not (meshes and self.route.mount):
            return there[ENTRANCE_MESH if meshes else MOUNT if self.route.mount else AIRY]
        if in_mask:
            return self._far_field(name, meshes, mount, progress)
        return self._convolved(there[MOUNT], self._series("entrance"))

    def _aperture(self, progress: Progress) -> Kernel:
        """The pattern of the open aperture."""
        aperture = self.instrument.aperture
        if self.route.mask and not aperture.round:
            return self._far_field(AIRY, (), None, progress)
        wavelength_angstrom, focal_length_mm = self.wavelength_angstrom, self.instrument.focal_length_mm
        pixel_pitch_um = self.instrument.detector.pixel_pitch_um
        if not aperture.round:
            return edge_kernel(
                aperture,
                wavelength_angstrom=wavelength_angstrom,
                focal_length_mm=focal_length_mm,
                pixel_pitch_um=pixel_pitch_um,
                size=self.size,
            )
        return airy_kernel(
            diameter_mm=aperture.diameter_mm,
            obscuration_diameter_mm=aperture.obscuration_diameter_mm,
            wavelength_angstrom=wavelength_angstrom,
            focal_length_mm=focal_length_mm,
            pixel_pitch_um=pixel_pitch_um,
            size=self.size,
        )

    def _far_field(
        self, name: str, meshes: tuple[Mesh, ...], mount: Mount | None, progress: Progress
    ) -> Kernel:
        far = far_field(
            entrance_pupil(
                self.instrument.aperture, mount=mount, mount_image=self.mount_image, meshes=meshes
            ),
            wavelength_angstrom=self.wavelength_angstrom,
            focal_length_mm=self.instrument.focal_length_mm,
            pixel_pitch_um=self.instrument.detector.pixel_pitch_um,
            size=self.size,
            period=max(self.size, PERIOD_PX),
            threads=self.threads,
            progress=progress,
        )
        self.notes[name.lower()] = {
            "open_area_mm2": far.open_area_mm2,
            "symmetry": far.symmetry,
            "light_beyond_grid": 1 - float(far.pattern.sum()),
        }
        return far.pattern

    def _series(self, place: str) -> Kernel:
        """The pattern of all meshes at the entrance, or of all meshes at the filter wheel.

        The patterns of meshes that all light crosses are convolved with each other. The patterns of meshes side by side
        are multiplied by the shares of the meshes and added.
        """
        whole = [mesh for mesh in _meshes(self.instrument, place) if mesh.share == 1]
        shared = [mesh for mesh in _meshes(self.instrument, place) if mesh.share < 1]
        kernels = [self._mesh(mesh) for mesh in whole]
        if shared:
            mixed = np.zeros((self.size, self.size))
            for mesh in shared:
                mixed += mesh.share * self._mesh(mesh)
            mixed[self.size // 2, self.size // 2] += max(0.0, 1 - sum(mesh.share for mesh in shared))
            kernels.append(mixed)
        combined = kernels[0]
        for kernel in kernels[1:]:
            combined = self._convolved(combined, kernel)
        return combined

    def _mesh(self, mesh: Mesh) -> Kernel:
        spacing_px = order_spacing_px(
            wavelength_angstrom=self.wavelength_angstrom,
            distance_mm=self.instrument.mesh_distance_mm(mesh),
            pitch_um=mesh.pitch_um,
            pixel_pitch_um=self.instrument.detector.pixel_pitch_um,
        )
        windows = windows_of(mesh)
        if mesh.openings == "square" and mesh.angle_deg % 90 == 0:
            line = mesh_line(
                spacing_px, pitch_um=mesh.pitch_um, wire_um=mesh.wire_um, windows=windows, size=self.size
            )
            return np.outer(line, line)
        kernel = rotated_mesh_kernel if mesh.openings == "square" else hexagonal_mesh_kernel
        return kernel(
            spacing_px,
            angle_deg=mesh.angle_deg,
            pitch_um=mesh.pitch_um,
            wire_um=mesh.wire_um,
            windows=windows,
            size=self.size,
        )

    def _convolved(self, a: Kernel, b: Kernel) -> Kernel:
        return linear_convolve(a, b, (self.size, self.size), threads=self.threads)


def _meshes(instrument: Instrument, place: str) -> tuple[Mesh, ...]:
    return tuple(mesh for mesh in instrument.meshes if mesh.place == place)
