"""A PSF from an instrument description.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Implementation" and "The combined PSF":
the meshes' patterns are convolved with each other, the result with the diffuse scatter. All convolutions
are linear and done on the full reach of 2048 px, on which each result is normalised.

Departure: the mount and the pupil's edge are not modelled, so less light is diffracted than the paper's
26.4 %; such a PSF is a draft and its version says so.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.diffraction.mesh_series import mesh_kernel, mesh_line
from psfcore.errors import DataError
from psfcore.fourier import linear_convolve
from psfcore.instruments.model import Instrument, Mesh
from psfcore.psf import REACH_GRID_PX, Psf, crop_centred
from psfcore.scatter.power_law import amplitude_for_total, scatter_kernel

SMALLEST_SIZE_PX = 64
Progress = Callable[[int, int], None]


def build_psf(
    instrument: Instrument,
    *,
    size: int = REACH_GRID_PX,
    progress: Progress | None = None,
    threads: int = 1,
) -> Psf:
    """Total PSF of `instrument` on (size, size), an even size of 64 to 2048 px, with its components.

    Raises DataError "bad-size".
    """
    _check_size(size)
    report = progress or _silent
    report(0, 3)
    diffraction = diffraction_kernel(instrument, threads=threads)
    report(1, 3)
    law = instrument.scatter
    scatter = scatter_kernel(law.b_px, law.c, law.total, REACH_GRID_PX)
    report(2, 3)
    total, lost = _on_full_reach(linear_convolve(scatter, diffraction, scatter.shape, threads=threads))
    report(3, 3)
    shape = (size, size)
    return Psf(
        kernel=crop_centred(total, shape),
        name=instrument.name,
        version=f"{instrument.version}-draft",
        instrument=instrument.name,
        status="draft",
        plate_scale_arcsec=instrument.detector.plate_scale_arcsec,
        wavelength_angstrom=instrument.wavelength_angstrom,
        components={
            "DIFFRACTION": crop_centred(diffraction, shape),
            "SCATTER": crop_centred(scatter, shape),
        },
        provenance=_provenance(instrument, lost),
    )


def diffraction_kernel(instrument: Instrument, *, threads: int = 1) -> NDArray[np.float64]:
    """All meshes' patterns convolved, on the full reach (2048, 2048), sum 1."""
    lines = [_line(mesh, instrument) for mesh in instrument.meshes]
    combined = lines[0][None, :]
    for line in lines[1:]:
        # Patterns are separable, so convolving their lines is convolving them.
        combined, _ = _on_full_reach(
            linear_convolve(combined, line[None, :], (1, REACH_GRID_PX), threads=threads)
        )
    return mesh_kernel(combined[0], combined[0])


def _line(mesh: Mesh, instrument: Instrument) -> NDArray[np.float64]:
    return mesh_line(
        wavelength_angstrom=instrument.wavelength_angstrom,
        distance_mm=mesh.distance_mm,
        pitch_um=mesh.pitch_um,
        wire_um=mesh.wire_um,
        windows=mesh.windows,
        pixel_pitch_um=instrument.detector.pixel_pitch_um,
        size=REACH_GRID_PX,
    )


def _on_full_reach(kernel: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Weights >= 0 that sum to 1, and the share of the light that had fallen past the reach."""
    positive = np.maximum(kernel, 0.0)  # transforms leave +-1e-17 where there is no light
    total = float(positive.sum())
    return positive / total, 1 - total


def _provenance(instrument: Instrument, lost: float) -> dict[str, Any]:
    law = instrument.scatter
    return {
        "model": "mesh series convolved with softened power law; mount and pupil edge not modelled",
        "scatter_basis": law.basis,
        "scatter_b_px": law.b_px,
        "scatter_c": law.c,
        "scatter_total": law.total,
        "scatter_a": amplitude_for_total(law.b_px, law.c, law.total),
        "past_reach_before_normalising": lost,
    }


def _check_size(size: int) -> None:
    if size % 2 or not SMALLEST_SIZE_PX <= size <= REACH_GRID_PX:
        wanted = f"an even size of {SMALLEST_SIZE_PX} to {REACH_GRID_PX} px"
        raise DataError("bad-size", f"expected {wanted}; got {size}")


def _silent(done: int, of: int) -> None:
    """No one listens."""
