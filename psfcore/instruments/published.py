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

    channel: wavelength in angstrom, or the energy. contains: the parts of the PSF. citation, doi: of the publication;
    doi None: no DOI is known. file: name of the published file, (size_px, size_px) px. addresses: where it is, the next
    one is asked if one fails; empty: place says where to find it. origins: schemes and hosts of the servers that are
    asked, also those to which an answer leads. instrument: as cards name it. cards: further cards that images must
    agree with. file_mib: None if unknown. sha256: of the published file; None: the repository tells a checksum at
    checksum_address; if that is empty, none is known.
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
