"""The JSON documents that the catalogue stores and that its readers look into: one type for each."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import TypeAdapter
from typing_extensions import TypedDict

from psfcore.fits.header import HeaderJson

_HEADER = TypeAdapter(HeaderJson)


class NoiseJson(TypedDict):
    """The noise figures of a transit."""

    photon_gain_dn: float
    read_noise_dn: float


class PointingJson(TypedDict):
    """A pointing of a transit, and the number of its images."""

    fov: int
    images: int


class MemberJson(TypedDict):
    """A file of a transit's archive."""

    name: str
    bytes: int


class TransitJson(TypedDict):
    """The summary of an uploaded transit."""

    archive: str
    instrument: str | None
    images: int
    pointings: list[PointingJson]
    noise: NoiseJson | None
    known_psf: str | None
    files: list[MemberJson]
    unpacked_bytes: int
    pixels: int


class PositionJson(TypedDict):
    """How far the files of a bulk run are listed, see ``workers.bulk.listing.SearchPosition``."""

    pattern: int
    names: list[str]


def header_json(summary: Mapping[str, object]) -> HeaderJson:
    """The fields of a summary of a header, checked."""
    return _HEADER.validate_python(summary)
