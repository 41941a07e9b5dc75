"""PSFs that others published: the table `published_psfs.toml`. `psfcore.published_psfs` brings their files.

This module imports no numerical library, so that the web process can import it.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from importlib.resources import files

from psfcore.instruments.files import WAVELENGTH_TOLERANCE


@dataclass(frozen=True, kw_only=True)
class Published:
    """A published PSF.

    Attributes
    ----------
    channel
        Wavelength in angstrom, or the energy.
    contains
        The parts of the PSF.
    citation, doi
        Citation and DOI of the publication; None: no DOI is known.
    file
        Name of the published file, (size_px, size_px) px.
    addresses
        Addresses of the file; if one fails, the next one is asked. Empty: `place` says where to find the file.
    origins
        Schemes and hosts of the servers that may be asked, including those to which an answer redirects.
    instrument
        The instrument, as cards name it.
    cards
        Further cards that images must agree with.
    file_mib
        Size of the published file, MiB; None: unknown.
    sha256
        SHA-256 of the published file. None: the repository states a checksum at `checksum_address`; if this address is
        empty, no checksum is known.
    """

    name: str
    telescope: str
    channel: str
    contains: str
    citation: str
    doi: str | None = None
    version: str
    file: str
    size_px: int
    addresses: list[str]
    origins: list[str]
    place: str
    instrument: str
    plate_scale_arcsec: float
    wavelength_angstrom: float | None = None
    cards: dict[str, str] = field(default_factory=dict)
    file_mib: int | None = None
    sha256: str | None = None
    checksum_address: str = ""


_TABLE = tomllib.loads(files("psfcore").joinpath("published_psfs.toml").read_text("utf-8"))
PUBLISHED = {
    one["name"]: Published(**publication | one)
    for publication in _TABLE["publication"]
    for one in publication.pop("psfs")
}


def published_for(telescope: str, wavelength_angstrom: float | None) -> list[Published]:
    """The published PSFs of a telescope, such as "SDO/AIA", for images at this wavelength."""
    return [
        one
        for one in PUBLISHED.values()
        if one.telescope == telescope
        and (
            one.wavelength_angstrom is None
            or wavelength_angstrom is None
            or abs(wavelength_angstrom / one.wavelength_angstrom - 1) <= WAVELENGTH_TOLERANCE
        )
    ]
