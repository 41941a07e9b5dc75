"""The error for an image whose PSF is not known. It names the PSFs that could fit, and the steps that the user can take
next ("ways").

This module imports no numerical library, so that the web process can import it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from psfcore.errors import DataError
from psfcore.instruments.files import PLATE_SCALE_TOLERANCE, instrument_names
from psfcore.instruments.model import load_instrument
from psfcore.instruments.without_file import Telescope, telescope_without_file

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
    {
        "way": "fit",
        "text": "fit the scatter to a transit of this telescope (images in which the Moon or a planet covers a part of "
        "the Sun): `heliopsf psf fit TRANSIT`. If heliopsf has no instrument file for it, the key "
        "known_psf of transit.json must name its diffraction PSF (docs/transits.md)",
    },
)
_NAMES = {"telescope": "telescope", "channel": "channel", "plate_scale": "pixel scale"}


def channel_of(instrument: str | None, wavelength_angstrom: float | None) -> str | None:
    """The channel: the wavelength in whole angstrom, such as 174.

    If the wavelength is not given, the wavelength of the instrument description is used. None if neither is known.
    """
    if wavelength_angstrom is None and instrument in instrument_names():
        wavelength_angstrom = load_instrument(instrument).wavelength_angstrom
    # A header card may contain any number.
    if wavelength_angstrom is None or not 0.5 <= wavelength_angstrom < 1e6:
        return None
    return str(round(wavelength_angstrom))


def unknown_instrument(header: Mapping[str, Any], psfs: Sequence[Mapping[str, Any]] = ()) -> DataError:
    """The error "no-psf-for-instrument" for an image with this header summary (`psfcore.fits.header.HeaderSummary` as a table).

    Its fields: `image` is the name of the telescope. `reason` says why heliopsf has no instrument file for a telescope that
    it recognises; it is None for other telescopes. `instruments` are the instruments whose PSF can be built, sorted by
    how well they agree with the image. `psfs` are the given PSFs, which could fit. `ways` are the steps that the
    user can take next. For an instrument, `same` names the properties that agree with the image; `told` also says which
    properties differ.
    """
    telescope = telescope_without_file(header)
    named = " ".join(str(header[key]) for key in ("telescop", "instrume", "detector") if header[key])
    instruments = [_instrument(name, header) for name in instrument_names()]
    instruments.sort(key=lambda one: (-len(one["same"]), one["wavelength_angstrom"]))
    could = [f"PSF {psf['id']} ({psf['name']})" for psf in psfs] + [
        f"instrument {one['name']}" for one in instruments if {"telescope", "channel"} <= set(one["same"])
    ]
    candidates = (
        f"These could suit the image: {', '.join(could)}" if could else "No known PSF suits the image"
    )
    return DataError(
        "no-psf-for-instrument",
        "expected an image of an instrument whose PSF is known, or a PSF in the request; got an image of "
        f"{_seen(named, telescope, header)} and no PSF. {_why(telescope)}"
        f"{candidates}. Name a PSF (psf in Python, psf_id in a request, --psf in a command), upload a PSF or an instrument "
        "file, or fit a PSF to a transit",
        {
            "image": telescope.name if telescope else named or "this telescope",
            "reason": telescope.reason if telescope else None,
            "instruments": instruments,
            "psfs": list(psfs),
            "ways": _ways(telescope),
        },
    )


def _seen(named: str, telescope: Telescope | None, header: Mapping[str, Any]) -> str:
    """The telescope and the channel of an image, for a message. named: the words of its header cards."""
    channel = channel_of(None, header["wavelnth"])
    cards = f"'{named or 'an unnamed instrument'}'"
    return (f"{telescope.name} ({cards})" if telescope else cards) + (
        f" at {channel} angstrom" if channel else ""
    )


def _why(telescope: Telescope | None) -> str:
    """The reason why a recognised telescope has no instrument file, and the recommended step; with a blank at the end."""
    if telescope is None:
        return ""
    recommended = next(iter(telescope.ways.values()), None)
    return f"heliopsf has no instrument file for it: {telescope.reason}. " + (
        f"{recommended}. " if recommended else ""
    )


def _ways(telescope: Telescope | None) -> list[dict[str, str]]:
    """The steps that the user can take next, each with what is known about this telescope."""
    known = {} if telescope is None else {str(way): sentence for way, sentence in telescope.ways.items()}
    return [
        one | {"text": f"{one['text']}. {known[one['way']]}"} if one["way"] in known else dict(one)
        for one in WAYS
    ]


def _instrument(name: str, header: Mapping[str, Any]) -> dict[str, Any]:
    known = load_instrument(name)
    scale = known.detector.plate_scale_arcsec
    channel = channel_of(name, None)
    same = same_as_image(name, channel, scale, header)
    return {
        "name": name,
        "wavelength_angstrom": known.wavelength_angstrom,
        "plate_scale_arcsec": scale,
        "same": same,
        "told": agreement_with_image(same, channel, scale, header),
    }


def same_as_image(
    instrument: str | None, channel: str | None, plate_scale_arcsec: float | None, header: Mapping[str, Any]
) -> list[str]:
    """The properties that a PSF and an image have in common, of "telescope", "channel" and "plate_scale"."""
    words = _words_of(header)
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


def agreement_with_image(
    same: Sequence[str], channel: str | None, plate_scale_arcsec: float | None, header: Mapping[str, Any]
) -> str:
    """A text that compares a PSF with an image, for example "same telescope, but another channel".

    same: the result of `same_as_image`.
    """
    wanted, image_scale = channel_of(None, header["wavelnth"]), header["cdelt1"]
    other = []
    if wanted and channel and channel != wanted:
        other.append(f"another channel ({channel}, not {wanted} Å)")
    if image_scale and plate_scale_arcsec and "plate_scale" not in same:
        other.append(f"another pixel scale ({plate_scale_arcsec:g}, not {abs(image_scale):g} arcsec)")
    parts = [f"same {' and '.join(_NAMES[one] for one in same)}"] if same else []
    return ", but ".join([*parts, *([" and ".join(other)] if other else [])])


def _words_of(header: Mapping[str, Any]) -> set[str]:
    return set().union(*(_words(header[key]) for key in ("telescop", "instrume", "detector")))


def _words(text: str | None) -> set[str]:
    """The words of a name that begin with a letter, such as "sdo" and "aia" of "SDO/AIA"."""
    return set(re.findall(r"(?<![a-z0-9])[a-z][a-z0-9]+", (text or "").lower()))
