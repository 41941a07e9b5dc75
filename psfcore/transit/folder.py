"""Read a transit from its folder: transit.json, its images one after the other, and the known part of the PSF.

All headers are read first, so that a missing file or a wrong shape is reported at once. Reading the pixels takes
minutes. Pixels are kept as float32: 126 images of 2048 px take 2.1 GiB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np

from psfcore.errors import DataError, together
from psfcore.files import sha256_of
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.frame import plate_scale_arcsec
from psfcore.fits.header import HeaderSummary, instant, read_summary
from psfcore.fits.images import read_plane
from psfcore.fits.observation import read_observation
from psfcore.noise import Noise
from psfcore.psf import CENTRE_TOLERANCE
from psfcore.transit.archive import checked_folder
from psfcore.transit.manifest import MANIFEST_NAME, ImageEntry, TransitManifest
from psfcore.transit.prepare import Exposure, Prepared, exposure_of, prepare
from psfcore.transit.transit import Kernel, Place, Transit, check_reaches_in

KNOWN_PSF_SUM_TOLERANCE = 1e-3
SMALLEST_KNOWN_PSF_PX = 16
LARGEST_RADIUS_SHARE = 0.25  # largest radius of an occulter, as a fraction of the smaller side of an image
_NEGATIVE_TOLERANCE = 1e-6  # fraction of the peak: rounding can make weights negative by this amount

Progress = Callable[[int, int], None]
Item = TypeVar("Item")
Result = TypeVar("Result")
KernelSource = Kernel | Callable[[str | None, tuple[int, int]], Kernel]


def read_transit(
    folder: str | Path,
    limits: FitsLimits,
    *,
    progress: Progress | None = None,
    diffraction: KernelSource | None = None,
    noise: Noise | None = None,
    saturation_dn: float | None = None,
) -> Transit:
    """Read the transit in a folder; options and errors as in ``read_prepared``, but no counts are returned."""
    return read_prepared(
        folder, limits, progress=progress, diffraction=diffraction, noise=noise, saturation_dn=saturation_dn
    )[0]


def read_prepared(
    folder: str | Path,
    limits: FitsLimits,
    *,
    progress: Progress | None = None,
    diffraction: KernelSource | None = None,
    noise: Noise | None = None,
    saturation_dn: float | None = None,
) -> tuple[Transit, Prepared]:
    """Read the transit in a folder, in DN/s, with frames in time order; also return the counts of saturated and filled
    pixels.

    Times come from DATE-BEG or DATE-OBS. If one image has neither, all images keep the order of transit.json, with one
    second between them.

    Raises DataError: "transit-shapes", "occulter-outside", "occulter-too-large", "no-noise-figures", "no-known-psf",
    "known-psf-..." (see ``checked_kernel``), the errors of ``checked_folder``, the errors of ``read_observation`` with
    the name of the file, and the errors of ``prepare``. Raises HeaderError for faults of a header. If several images
    have faults, one error names all of them.

    Parameters
    ----------
    progress
        Function progress(done, of) that is called after each image.
    diffraction
        Weights [y, x], or a function of (name of the instrument or None, shape of the images) that returns them; used
        if transit.json has no known_psf.
    noise
        Noise of the camera in place of the noise figures of transit.json.
    saturation_dn
        Saturation level of one exposure in DN; default: as in `psfcore.fits.observation.read_observation`.
    """
    folder = Path(folder)
    manifest = checked_folder(folder).manifest
    noise = noise or _noise(manifest)

    def summary(image: ImageEntry) -> HeaderSummary:
        with _naming(image.file):
            return read_summary(folder / image.file, limits)

    headers = _each(summary, manifest.images)
    _each(lambda n: _check_frame(n, manifest.images, headers), range(len(headers)))
    instrument = manifest.instrument or next((h.instrument for h in headers if h.instrument), None)
    kernel = _known_psf(folder, manifest, limits, diffraction, instrument, headers[0].shape)
    starts_s = times_s(headers)
    order = sorted(
        range(len(headers)), key=lambda n: starts_s[n]
    )  # stable: equal times stay in the order of transit.json

    def exposure(done: int) -> tuple[Exposure, float | None]:
        n = order[done]
        entry = manifest.images[n]
        try:
            with _naming(entry.file):
                image = read_observation(folder / entry.file, limits, saturation_dn=saturation_dn)
        finally:
            if progress is not None:
                progress(done + 1, len(order))
        place, mode = Place(entry.x, entry.y, entry.r), headers[n].gain_mode
        read = exposure_of(
            image,
            file=entry.file,
            pointing=entry.pointing,
            place=place,
            time_s=starts_s[n],
            gain_mode=mode,
        )
        return read, plate_scale_arcsec(image.header)

    exposures = _each(exposure, range(len(order)))
    frames, prepared = prepare([each for each, _ in exposures])
    transit = Transit(
        frames=frames,
        diffraction=kernel,
        noise=noise,
        instrument=instrument,
        plate_scale_arcsec=next((scale for _, scale in exposures if scale is not None), None),
        sha256={name: sha256_of(folder / name) for name in (MANIFEST_NAME, *manifest.files)},
    )
    return transit, prepared


# --- images -----------------------------------------------------------------------------------------------


def _each(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The results of a function for all items. Raises one DataError that has the messages of all items."""
    results: list[Result] = []
    faults: list[DataError] = []
    for item in items:
        try:
            results.append(function(item))
        except DataError as fault:
            faults.append(fault)
    if faults:
        raise together(faults)
    return results


@contextmanager
def _naming(file: str) -> Iterator[None]:
    """Put the name of the file before the message of an error."""
    try:
        yield
    except DataError as error:
        raise type(error)(error.code, f"{file}: {error.message}") from None


def _check_frame(n: int, images: Sequence[ImageEntry], headers: Sequence[HeaderSummary]) -> None:
    """Raise DataError if the shape or the occulter of an image is wrong."""
    image, (ny, nx), first = images[n], headers[n].shape, headers[0].shape
    label = f"images[{n}] ({image.file})"
    if (ny, nx) != first:
        size = f"{first[1]} x {first[0]} px, the size of {images[0].file}"
        raise DataError(
            "transit-shapes", f"{label}: expected {size}; got {nx} x {ny} px: cut all images to one size"
        )
    largest = LARGEST_RADIUS_SHARE * min(ny, nx)
    if image.r > largest:
        message = f"expected a radius r of at most {largest:g} px in images of {nx} x {ny} px"
        raise DataError(
            "occulter-too-large", f"{label}: {message}; got {image.r:g} px: correct r in {MANIFEST_NAME}"
        )
    check_reaches_in(Place(image.x, image.y, image.r), (ny, nx), label)


def times_s(headers: Sequence[HeaderSummary]) -> list[float]:
    """Start of each image in seconds after the first image; if one image has no readable date, the index of each
    image.
    """
    starts = [None if header.date_obs is None else instant(header.date_obs) for header in headers]
    dates = [start for start in starts if start is not None]
    if len(dates) < len(starts):
        return [float(index) for index in range(len(headers))]
    first = min(dates)
    return [(start - first).total_seconds() for start in dates]


# --- noise and the known PSF ------------------------------------------------------------------------------


def _noise(manifest: TransitManifest) -> Noise:
    if manifest.noise is None:
        raise DataError(
            "no-noise-figures",
            f'expected "noise": {{"photon_gain_dn": ..., "read_noise_dn": ...}} in {MANIFEST_NAME}, or both '
            "figures in the request (DN per detected photon, rms read noise in DN); got neither",
        )
    return manifest.noise.noise()


def _known_psf(
    folder: Path,
    manifest: TransitManifest,
    limits: FitsLimits,
    fallback: KernelSource | None,
    instrument: str | None,
    shape: tuple[int, int],
) -> Kernel:
    if manifest.known_psf is not None:
        with _naming(manifest.known_psf):
            kernel = read_plane(folder / manifest.known_psf, limits)
        return checked_kernel(kernel, manifest.known_psf)
    if fallback is None:
        expected = (
            f'expected "known_psf" in {MANIFEST_NAME}, or an instrument whose diffraction can be computed'
        )
        raise DataError("no-known-psf", f"{expected}; got neither")
    return checked_kernel(fallback(instrument, shape) if callable(fallback) else fallback, "diffraction")


def checked_kernel(kernel: Kernel, label: str) -> Kernel:
    """Check the known part of a PSF [y, x], centre at [ny // 2, nx // 2], and normalise it to sum 1.

    A sum that differs from 1 by at most KNOWN_PSF_SUM_TOLERANCE counts as rounding.

    Raises DataError "known-psf-small", "known-psf-nonfinite", "known-psf-negative", "known-psf-sum",
    "known-psf-not-centred".

    Parameters
    ----------
    label
        The name of the PSF in errors.
    """
    if kernel.ndim != 2 or min(kernel.shape) < SMALLEST_KNOWN_PSF_PX:
        message = f"expected at least {SMALLEST_KNOWN_PSF_PX} px on each side"
        raise DataError("known-psf-small", f"{label}: {message}; got shape {kernel.shape}")
    if not np.isfinite(kernel).all():
        bad = int(np.count_nonzero(~np.isfinite(kernel)))
        raise DataError(
            "known-psf-nonfinite",
            f"{label}: expected finite weights; got {bad} NaN or infinite ones: replace them, for example by 0",
        )
    smallest, largest = float(kernel.min()), float(kernel.max())
    if smallest < -_NEGATIVE_TOLERANCE * max(largest, 0.0):
        message = f"expected weights >= 0; got a smallest weight of {smallest:.3g}"
        raise DataError("known-psf-negative", f"{label}: {message}: give a PSF without negative weights")
    total = float(kernel.sum(dtype=np.float64))
    if abs(total - 1) > KNOWN_PSF_SUM_TOLERANCE:
        message = "expected weights that sum to 1 on their array"
        raise DataError(
            "known-psf-sum", f"{label}: {message}; got a sum of {total:.6g}: divide the weights by their sum"
        )
    centre = (kernel.shape[0] // 2, kernel.shape[1] // 2)
    if kernel[centre] < largest * (1 - CENTRE_TOLERANCE):
        peak = tuple(int(p) for p in np.unravel_index(int(kernel.argmax()), kernel.shape))
        message = f"expected the peak at [y, x] = {centre}"
        raise DataError("known-psf-not-centred", f"{label}: {message}; got the peak at {peak}: shift the PSF")
    weights = np.maximum(kernel, 0.0, dtype=np.float64)
    return np.ascontiguousarray(weights / weights.sum())
