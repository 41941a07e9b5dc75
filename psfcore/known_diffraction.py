"""The diffraction PSF for a transit whose transit.json names no file of it."""

from __future__ import annotations

from psfcore.build import Kernel, build_psf
from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from psfcore.instruments.model import load_instrument


def known_diffraction(instrument: str | None, *, threads: int = 1) -> Kernel:
    """Weights [y, x] of the diffraction PSF of a known instrument. Raises DataError "no-known-psf" for others."""
    if instrument not in instrument_names():
        known = ", ".join(instrument_names())
        raise DataError(
            "no-known-psf",
            f'expected "known_psf" in transit.json, or an instrument with a known diffraction PSF ({known}); '
            f"got {instrument or 'neither'}",
        )
    return build_psf(load_instrument(instrument), component="DIFFRACTION", threads=threads).kernel
