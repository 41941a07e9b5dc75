"""The error for an image whose PSF is not known. It tells what can be done: which PSFs could fit, and the three ways on."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from psfcore.instruments.model import load_instrument
from psfcore.plate_scale import PLATE_SCALE_TOLERANCE
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import PsfRow
from workers.versions.series import TOTAL, UPLOADED, channel_of
from workers.versions.status import PsfStatus

MOST_NAMED = 20
MOST_SEARCHED = 500
WAYS = (
    {
        "way": "name",
        "text": "name a PSF: psf_id in the request, --psf ID on the command line; `heliopsf psf build --instrument NAME -o "
        "PSF.fits` makes the PSF of an instrument above, and prints its id",
    },
    {
        "way": "upload",
        "text": "bring your own: upload a PSF (`heliopsf psf upload FILE`, or --psf FILE), or write an instrument file "
        "(docs/instruments.md) and build its PSF (`heliopsf psf build --instrument FILE.toml`)",
    },
    {"way": "fit", "text": "fit the scatter to a transit of this telescope: `heliopsf psf fit TRANSIT`"},
)


def no_psf(catalogue: Catalogue, header: Mapping[str, Any], owner: str) -> DataError:
    """The error "no-psf-for-instrument" for an image with this header summary.

    Its fields: `instruments` that can be built, `psfs` of the catalogue that could fit, and `ways` on. For both lists,
    `same` says what agrees with the image.
    """
    named = " ".join(str(header[key]) for key in ("telescop", "instrume", "detector") if header[key])
    channel = channel_of(None, header["wavelnth"])
    seen = f"'{named or 'an unnamed instrument'}'" + (f" at {channel} angstrom" if channel else "")
    instruments = [_instrument(name, header) for name in instrument_names()]
    psfs = list(_candidates(catalogue, header, owner))
    could = [f"PSF {psf['id']} ({psf['name']})" for psf in psfs] + [
        f"instrument {one['name']}" for one in instruments if {"telescope", "channel"} <= set(one["same"])
    ]
    return DataError(
        "no-psf-for-instrument",
        f"expected an image of an instrument whose PSF is known, or a PSF in the request; got an image of {seen} and no "
        f"PSF. Could fit: {', '.join(could) or 'none that is known here'}. Name a PSF (psf_id in a request, --psf in a command), upload a PSF or an instrument "
        "file, or fit a PSF to a transit",
        {"instruments": instruments, "psfs": psfs, "ways": list(WAYS)},
    )


def _instrument(name: str, header: Mapping[str, Any]) -> dict[str, Any]:
    known = load_instrument(name)
    scale = known.detector.plate_scale_arcsec
    same = _same(name, channel_of(name, None), scale, header)
    return {
        "name": name,
        "wavelength_angstrom": known.wavelength_angstrom,
        "plate_scale_arcsec": scale,
        "same": same,
    }


def _candidates(catalogue: Catalogue, header: Mapping[str, Any], owner: str) -> Iterator[dict[str, Any]]:
    """PSFs of the same telescope or plate scale, newest first, without those of another channel: at most MOST_NAMED."""
    wanted = channel_of(None, header["wavelnth"])
    found = 0
    for row in catalogue.psfs.page(PsfFilter(), owner, limit=MOST_SEARCHED):
        same = _same(row.instrument, row.channel, row.details.get("plate_scale_arcsec"), header)
        other_channel = wanted is not None and row.channel is not None and row.channel != wanted
        if not _usable(row) or other_channel or not {"telescope", "plate_scale"} & set(same):
            continue
        yield {
            "id": row.id,
            "name": row.name,
            "version": row.version,
            "status": row.status,
            "instrument": row.instrument,
            "channel": row.channel,
            "same": same,
        }
        found += 1
        if found == MOST_NAMED:
            return


def _usable(row: PsfRow) -> bool:
    return row.kind in (TOTAL, UPLOADED) and row.status != PsfStatus.DEPRECATED


def _same(
    instrument: str | None, channel: str | None, plate_scale_arcsec: float | None, header: Mapping[str, Any]
) -> list[str]:
    """What a PSF shares with an image: "telescope", "channel", "plate_scale"."""
    words = set().union(*(_words(header[key]) for key in ("telescop", "instrume", "detector")))
    wanted = channel_of(None, header["wavelnth"])
    image_scale = header["cdelt1"]
    same = []
    if words & _words(instrument):
        same.append("telescope")
    if channel is not None and channel == wanted:
        same.append("channel")
    if image_scale and plate_scale_arcsec:
        ratio = abs(image_scale) / plate_scale_arcsec
        if abs(ratio - 1) <= PLATE_SCALE_TOLERANCE:
            same.append("plate_scale")
    return same


def _words(text: str | None) -> set[str]:
    """The words of a name that begin with a letter, such as "sdo" and "aia" of "SDO/AIA"."""
    return set(re.findall(r"(?<![a-z0-9])[a-z][a-z0-9]+", (text or "").lower()))


def buildable() -> tuple[str, ...]:
    """The names of the instruments whose PSF the service can build from a shipped instrument file."""
    return instrument_names()
