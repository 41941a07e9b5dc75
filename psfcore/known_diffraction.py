"""The diffraction PSF for a transit whose transit.json does not name a file with this PSF."""

from __future__ import annotations

from psfcore.build import Kernel, build_psf
from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from psfcore.instruments.model import load_instrument


def known_diffraction(instrument: str | None, *, threads: int = 1) -> Kernel:
    """The diffraction PSF of a known instrument, as weights [y, x].

    Raises DataError "no-known-psf" if the instrument is not known.
    """
    known = load_instrument(check_known(instrument))
    return build_psf(known, component="DIFFRACTION", threads=threads).kernel


def check_known(instrument: str | None) -> str:
    """The name of a known instrument. Raises DataError "no-known-psf" if the instrument is not known."""
    if instrument not in instrument_names():
        known = ", ".join(instrument_names())
        raise DataError(
            "no-known-psf",
            f'expected "known_psf" in transit.json, or an instrument with a known diffraction PSF ({known}); '
            f"got {instrument or 'neither'}",
        )
    return instrument
