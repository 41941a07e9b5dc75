"""Computes a PSF from an instrument description.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Implementation" and "The combined PSF":
the diffraction patterns of the pupil and of the meshes are convolved with each other. The result is convolved with
the diffuse scatter.

Light is counted over the full reach, a grid of 2048 px, on which every kernel sums to 1. Each kernel is computed on
this grid and cut to the requested size. A larger kernel, up to 4096 px, is computed on a grid of its own size and
scaled so that its inner 2048 px sum to 1. Its outer pixels then contain the light beyond the full reach, and its sum
exceeds 1. The inner 2048 px equal the PSF of 2048 px, except for one difference: on the larger grid, a convolution also
moves light from beyond the reach into the reach. For the diffraction of HRI_EUV this is 1e-5 of all light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from psfcore import software_version
from psfcore.convolution.convolver import linear_convolve
from psfcore.diffraction.combined import DIFFRACTION, available_parts, diffraction_patterns
from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from psfcore.instruments.model import Instrument, load_instrument, parse_instrument
from psfcore.instruments.psf_statements import bases_of, version_text
from psfcore.instruments.workload import LARGEST_SIZE_PX, check_workload
from psfcore.psf import REACH_GRID_PX, Psf, crop_centred
from psfcore.recipe import Recipe
from psfcore.scatter.power_law import amplitude_for_total, described_kernel

SMALLEST_SIZE_PX = 64
SCATTER = "SCATTER"
Kernel = NDArray[np.float64]
Progress = Callable[[int, int], None]


def build_psf(
    instrument: Instrument,
    *,
    size: int = REACH_GRID_PX,
    component: str | None = None,
    parts: bool = True,
    mount_image: NDArray[np.floating] | None = None,
    progress: Progress | None = None,
    threads: int = 1,
) -> Psf:
    """Compute the total PSF of `instrument`, with its components; its shape is (size, size).

    - `size`: an even number from 64 to 4096, px.
    - `component`: the only component to build, such as "DIFFRACTION"; the result is then a PSF without components.
    - `parts`: if it is False, only what the total PSF needs is computed, and the PSF has no components. Its kernel is
      the same as with True, bit for bit.
    - `mount_image`: pixels of the mount's mask image [y, x], row 0 at the lowest y (see `psfcore.fits.images`).
    - `progress` is called with (step, steps); it may raise to stop the work.

    Raises DataError "bad-size", "unknown-component" or "bad-mount", and "bad-instrument-file" if the instrument needs
    arrays that are too large.
    """
    if size % 2 or not SMALLEST_SIZE_PX <= size <= LARGEST_SIZE_PX:
        expected = f"an even size of {SMALLEST_SIZE_PX} to {LARGEST_SIZE_PX} px"
        raise DataError("bad-size", f"expected {expected}; got {size}")
    check_workload(instrument, instrument.name)
    available = available_parts(instrument) + (() if instrument.scatter is None else (SCATTER,))
    if component not in (None, *available):
        raise DataError("unknown-component", f"expected one of {', '.join(available)}; got {component!r}")
    names = available if component is None else (component,)
    if component is None and not parts:
        names = tuple(name for name in names if name in (DIFFRACTION, SCATTER))
    grid = max(size, REACH_GRID_PX)
    patterns = diffraction_patterns(
        instrument,
        size=grid,
        names=names,
        mount_image=mount_image,
        threads=threads,
        progress=None if progress is None else lambda done, of: progress(900 * done // of, 1000),
    )
    past_reach: dict[str, float] = {}
    provenance = _provenance(instrument, patterns.notes, past_reach)
    kernels: dict[str, Kernel] = {}
    for name in (name for name in names if name in patterns.kernels):
        kernels[name], past_reach[name.lower()] = _on_full_reach(patterns.kernels.pop(name))
    del patterns
    law = instrument.scatter
    if law is not None and SCATTER in names:
        kernels[SCATTER] = described_kernel(law, grid)
    if component is not None:
        kernel, kernels = kernels[component], {}
        provenance["component"] = component
    elif law is None:
        kernel = kernels[DIFFRACTION]
    else:
        total = linear_convolve(kernels[SCATTER], kernels[DIFFRACTION], (grid, grid), threads=threads)
        kernel, past_reach["total"] = _on_full_reach(total)
    if progress is not None:
        progress(1000, 1000)
    shape = (size, size)
    return Psf(
        kernel=crop_centred(kernel, shape),
        name=instrument.name,
        version=version_text(instrument.version, instrument.status),
        instrument=instrument.name,
        status=instrument.status,
        plate_scale_arcsec=instrument.detector.plate_scale_arcsec,
        wavelength_angstrom=instrument.wavelength_angstrom,
        components={name: crop_centred(part, shape) for name, part in kernels.items()} if parts else {},
        provenance=provenance,
        turn_deg=instrument.turn_deg,
    )


def build_recipe(
    recipe: Recipe,
    *,
    parts: bool = True,
    mount_image: NDArray[np.floating] | None = None,
    progress: Progress | None = None,
    threads: int = 1,
) -> Psf:
    """Compute the PSF of a recipe. Its version and its provenance name the recipe.

    Raises the errors of `build_psf` and of `parse_instrument`.

    Parameters
    ----------
    parts
        Whether to compute the components too, see `build_psf`.
    """
    instrument = parse_instrument(recipe.text, recipe.name or "instrument_file")
    psf = build_psf(
        instrument,
        size=recipe.size,
        component=recipe.component and recipe.component.upper(),
        parts=parts,
        mount_image=mount_image,
        threads=threads,
        progress=progress,
    )
    return replace(
        psf,
        version=version_text(instrument.version, instrument.status, recipe.identity),
        provenance={
            **psf.provenance,
            "psf_id": recipe.identity,
            "instrument_file_sha256": recipe.file_sha256,
            "parameters": recipe.parameters,
            "algorithm_version": recipe.algorithm_version,
            "software_version": software_version(),
        },
    )


def _on_full_reach(kernel: Kernel) -> tuple[Kernel, float]:
    """Scale the weights so that they sum to 1 on the full reach; also return the share of the light beyond the
    reach.
    """
    # Where there is no light, a Fourier transform gives values of about +-1e-17.
    positive = np.maximum(kernel, 0.0)
    inner = float(crop_centred(positive, (REACH_GRID_PX, REACH_GRID_PX)).sum())
    return positive / inner, 1 - inner


def _provenance(
    instrument: Instrument, notes: dict[str, object], past_reach: dict[str, float]
) -> dict[str, object]:
    law, bases = instrument.scatter, bases_of(instrument)
    model = "simplified-combined: entrance pupil convolved with filter-wheel mesh series"
    shape = "a softened power law"
    if law is not None and law.b_px is None:
        shape = f"{len(law.laws)} power laws" if law.laws else f"a table of {len(law.table)} radii"
    about: dict[str, object] = {
        "model": model if law is None else f"{model}, and with {shape}",
        "mount_basis": bases["mount_basis"],
        "lines": [[line.wavelength_angstrom, line.weight] for line in instrument.spectral_lines],
        "past_reach": past_reach,
        **notes,
    }
    about |= bases
    if law is not None:
        about |= {
            "scatter_b_px": law.b_px,
            "scatter_c": law.c,
            "scatter_total": law.total,
        }
        if law.b_px is not None and law.c is not None:
            about["scatter_a"] = amplitude_for_total(law.b_px, law.c, law.total)
    return about


def known_diffraction(instrument: str | None, *, threads: int = 1) -> Kernel:
    """The diffraction PSF of a known instrument, as weights [y, x], for a transit whose transit.json names no PSF file.

    Raises DataError "no-known-psf" if the instrument is not known.
    """
    description = load_instrument(check_known(instrument))
    return build_psf(description, component="DIFFRACTION", threads=threads).kernel


def check_known(instrument: str | None) -> str:
    """The name of a known instrument. Raises DataError "no-known-psf" if the instrument is not known."""
    if instrument not in instrument_names():
        names = ", ".join(instrument_names())
        raise DataError(
            "no-known-psf",
            f'expected "known_psf" in transit.json, or an instrument with a known diffraction PSF ({names}); '
            f"got {instrument or 'neither'}",
        )
    return instrument
