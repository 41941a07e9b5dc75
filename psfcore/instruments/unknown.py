"""The error for an image whose PSF is not known. It names the PSFs that could fit, and the steps that the user can take
next ("ways"). For telescopes that heliopsf recognises, but for which it has no instrument file, it gives the reason.

docs/instruments.md lists the sources. This module imports no numerical library, so that the web process can import it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypedDict

from psfcore.errors import DataError
from psfcore.instruments.files import PLATE_SCALE_TOLERANCE, WAVELENGTH_TOLERANCE, instrument_names
from psfcore.instruments.model import load_instrument
from psfcore.instruments.observation import Observation
from psfcore.instruments.psf_statements import published_text

WAYS = (
    {
        "way": "name",
        "text": "name a PSF: psf_id in the request, --psf ID on the command line; `heliopsf psf build --instrument "
        "NAME -o PSF.fits` makes the PSF of an instrument above, and prints its id",
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


Card = Literal["telescop", "instrume", "detector"]
Way = Literal["name", "upload", "fit"]  # the steps that `WAYS` describes

_NO_SOURCE = (
    "no public source that we could read gives the pitch and the wire width of its meshes, or the parameters of its "
    "diffuse scatter"
)
_ASK = "ask the authors for it as a FITS image, and upload it"


class Suited(TypedDict):
    """A PSF or an instrument that could suit an image: the properties that agree, and a text that compares all."""

    name: str
    same: list[str]
    told: str


class SuitedPsf(Suited):
    """A PSF of the catalogue that could suit an image."""

    id: str
    version: str
    status: str
    instrument: str | None
    channel: str | None


class SuitedInstrument(Suited):
    """An instrument whose PSF can be built and could suit an image."""

    wavelength_angstrom: float
    plate_scale_arcsec: float


@dataclass(frozen=True)
class Telescope:
    """A telescope without an instrument file.

    Attributes
    ----------
    cards
        An image is of this telescope if its header agrees with one of these tables. A table holds fields of the header
        summary (`psfcore.fits.header.HeaderSummary`), and the text with which each of them begins, in any case.
    angstrom
        The wavelengths of the images that the entry describes; empty: all wavelengths.
    reason
        The reason why there is no instrument file.
    ways
        Sentences about the steps with which a publication or a file helps; the recommended step comes first.
    """

    name: str
    cards: tuple[Mapping[Card, str], ...]
    reason: str
    ways: Mapping[Way, str]
    angstrom: tuple[float, ...] = ()

    def took(self, header: Observation) -> bool:
        """Whether the image with this header summary is of this telescope."""
        wavelength = header["wavelnth"] or 0.0
        if self.angstrom and all(abs(wavelength / one - 1) > WAVELENGTH_TOLERANCE for one in self.angstrom):
            return False
        return any(
            all((header[key] or "").strip().upper().startswith(text.upper()) for key, text in table.items())
            for table in self.cards
        )


TELESCOPES = (
    Telescope(
        name="TRACE",
        cards=({"instrume": "TRACE"}, {"telescop": "TRACE"}),
        reason="the instrument files describe its channels at 171, 195 and 284 angstrom alone",
        ways={
            "fit": "TRACE observed the transit of Venus of 2004; heliopsf can fit the scatter to such images"
        },
    ),
    Telescope(
        name="SOHO/EIT",
        # Reprocessed files have no INSTRUME. Other instruments of SOHO have other wavelengths, or none.
        cards=({"telescop": "SOHO"}, {"instrume": "EIT"}),
        reason=_NO_SOURCE,
        ways={
            "upload": "We found no file of its PSF. SolarSoft's eit_degrid removes the shadow of the grid near the "
            "detector: use it first, and then a PSF of your own"
        },
        angstrom=(171.0, 195.0, 284.0, 304.0),
    ),
    Telescope(
        name="PROBA2/SWAP",
        cards=({"instrume": "SWAP"},),
        reason=_NO_SOURCE,
        ways={"upload": "Seaton et al. (2013, arXiv:1309.1345) derived a PSF from images of SWAP: " + _ASK},
    ),
    Telescope(
        name="GOES/SUVI",
        # NOAA's level 2 files have both cards. Level 1b files have no DETECTOR, and the satellite as TELESCOP.
        cards=({"instrume": "GOES-R Series Solar Ultraviolet Imager"}, {"detector": "SUVI"}),
        reason=_NO_SOURCE,
        ways={"fit": "We found no published PSF of SUVI"},
    ),
    Telescope(
        name="Hinode/XRT",
        # The X-ray telescope of Swift also has INSTRUME = 'XRT'.
        cards=({"telescop": "HINODE", "instrume": "XRT"},),
        reason="an instrument file describes pupils and meshes, but not mirrors that reflect X-rays at grazing "
        "incidence",
        ways={
            "upload": "Use a PSF whose energy suits the filters of the image",
            "fit": "In images of the transit of Venus of 2012, the PSF at 560 eV removes 5 % of the light in the disc "
            "of Venus; heliopsf can fit the remaining scatter to these images",
        },
    ),
    Telescope(
        name="EUI/FSI",
        cards=({"detector": "FSI"}, {"telescop": "SOLO/EUI/FSI"}),
        reason="its meshes are those of HRI_EUV (Hofmeister et al.), but no public source that we could read gives its "
        "entrance pupil or the parameters of its diffuse scatter",
        ways={
            "upload": "If you know the entrance pupil of FSI, write an instrument file with the meshes of hri_euv.toml",
            "fit": "Mercury is too small for the pixels of FSI (Hofmeister et al.): use images with a larger occulter",
        },
    ),
    Telescope(
        name="EUI/HRI_LYA",
        cards=({"detector": "HRI_LYA"}, {"telescop": "SOLO/EUI/HRI_LYA"}),
        reason="limitations of the instrument prevented the analysis that Hofmeister et al. made for HRI_EUV",
        ways={},
    ),
    Telescope(
        name="SDO/AIA",
        cards=({"telescop": "SDO/AIA"},),
        reason="the sources of the AIA files describe the seven EUV channels alone",
        ways={
            "fit": "AIA observed the transit of Venus of 2012, for example at 1600 angstrom; heliopsf can fit the "
            "scatter to such images"
        },
        angstrom=(1600.0, 1700.0, 4500.0),
    ),
)


def telescope_without_file(header: Observation) -> Telescope | None:
    """The telescope without an instrument file that took the image with this header summary, or None."""
    return next((one for one in TELESCOPES if one.took(header)), None)


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


def unknown_instrument(header: Observation, psfs: Sequence[SuitedPsf] = ()) -> DataError:
    """The error "no-psf-for-instrument" for an image with this header summary (`psfcore.fits.header.HeaderSummary` as a
    table).

    Its fields: `image` is the name of the telescope. `reason` says why heliopsf has no instrument file for a telescope
    that it recognises, or which cards the header lacks; otherwise it is None. `instruments` are the instruments whose
    PSF can be built, sorted by how well they agree with the image. `psfs` are the given PSFs, which could fit. `ways`
    are the steps that the user can take next. For an instrument, `same` names the properties that agree with the image;
    `told` also says which properties differ.
    """
    telescope = telescope_without_file(header)
    named = " ".join(str(header[key]) for key in ("telescop", "instrume", "detector") if header[key])
    instruments = [_instrument(name, header) for name in instrument_names()]
    instruments.sort(key=lambda one: (-len(one["same"]), one["wavelength_angstrom"]))
    could = [f"PSF {psf['id']} ({psf['name']})" for psf in psfs] + [
        f"instrument {one['name']}" for one in instruments if {"telescope", "channel"} <= set(one["same"])
    ]
    reason = telescope.reason if telescope else _lacking(named, instruments, header)
    candidates = f"These could suit the image: {', '.join(could)}. " if could else ""
    why = _why(telescope, reason, header["wavelnth"])
    return DataError(
        "no-psf-for-instrument",
        f"expected a telescope whose PSF is known, or a PSF; got an image of {_seen(named, telescope, header)}. "
        f"{why}{candidates}Give a PSF (psf in Python, psf_id in a request, --psf in a command), "
        "or fit one to a transit",
        {
            "image": telescope.name if telescope else named or "this image",
            "reason": reason,
            "instruments": instruments,
            "psfs": list(psfs),
            "ways": _ways(telescope, header["wavelnth"]),
        },
    )


def _seen(named: str, telescope: Telescope | None, header: Observation) -> str:
    """The telescope and the channel of an image, for a message.

    Parameters
    ----------
    named
        The words of the header cards of the image.
    """
    channel = channel_of(None, header["wavelnth"])
    cards = f"'{named}'" if named else "an unnamed instrument"
    return (f"{telescope.name} ({cards})" if telescope else cards) + (
        f" at {channel} angstrom" if channel else ""
    )


def _lacking(named: str, instruments: Sequence[SuitedInstrument], header: Observation) -> str | None:
    """The cards without which the telescope or the channel of an image is not known; None if they are there."""
    if not named:
        return "its header names no telescope (cards TELESCOP, INSTRUME)"
    if header["wavelnth"] is not None or not any("telescope" in one["same"] for one in instruments):
        return None
    cards = header.get("cards")  # only summaries of files have them
    named_cards = cards if isinstance(cards, dict) else {}
    given = "".join(
        f"; got {key} = {named_cards[key]!r:.40}" for key in ("WAVELNTH", "WAVEUNIT") if key in named_cards
    )
    return (
        "its header gives no wavelength that can be read: expected a number in the card WAVELNTH, and its unit, "
        f"such as angstrom or nm, in WAVEUNIT{given}"
    )


def known_steps(telescope: Telescope, wavelength_angstrom: float | None) -> dict[str, str]:
    """The sentences about the steps that help with an image of this telescope, with its published PSFs."""
    published = published_text(telescope.name, wavelength_angstrom)
    upload = ". ".join(filter(None, (published, telescope.ways.get("upload"))))
    return ({"upload": upload} if published else {}) | {
        str(way): upload if way == "upload" else sentence for way, sentence in telescope.ways.items()
    }


def _why(telescope: Telescope | None, reason: str | None, wavelength_angstrom: float | None) -> str:
    """The reason why the PSF is not known, and the recommended step; with a blank at the end."""
    if telescope is None:
        return f"{reason[:1].upper()}{reason[1:]}. " if reason else ""
    recommended = next(iter(known_steps(telescope, wavelength_angstrom).values()), None)
    return f"heliopsf has no instrument file for it: {telescope.reason}. " + (
        f"{recommended}. " if recommended else ""
    )


def _ways(telescope: Telescope | None, wavelength_angstrom: float | None) -> list[dict[str, str]]:
    """The steps that the user can take next, each with what is known about this telescope."""
    sentences = {} if telescope is None else known_steps(telescope, wavelength_angstrom)
    return [
        one | {"text": f"{one['text']}. {sentences[one['way']]}", "known": sentences[one["way"]]}
        if one["way"] in sentences
        else dict(one)
        for one in WAYS
    ]


def _instrument(name: str, header: Observation) -> SuitedInstrument:
    instrument = load_instrument(name)
    scale = instrument.detector.plate_scale_arcsec
    channel = channel_of(None, instrument.wavelength_angstrom)
    same, comparison = agreement(name, channel, scale, header)
    return {
        "name": name,
        "wavelength_angstrom": instrument.wavelength_angstrom,
        "plate_scale_arcsec": scale,
        "same": same,
        "told": comparison,
    }


def agreement(
    instrument: str | None, channel: str | None, plate_scale_arcsec: float | None, header: Observation
) -> tuple[list[str], str]:
    """The properties that a PSF and an image have in common, of "telescope", "channel" and "plate_scale"; and a text
    that compares both, for example "same telescope, but another channel".
    """
    of_image, image_scale = channel_of(None, header["wavelnth"]), header["cdelt1"]
    words = set().union(*(_words(header[key]) for key in ("telescop", "instrume", "detector")))
    same, other = [], []
    if words & _words(instrument):
        same.append("telescope")
    if channel is not None and channel == of_image:
        same.append("channel")
    elif of_image and channel:
        other.append(f"another channel ({channel}, not {of_image} Å)")
    if image_scale and plate_scale_arcsec:
        if abs(abs(image_scale) / plate_scale_arcsec - 1) <= PLATE_SCALE_TOLERANCE:
            same.append("plate_scale")
        else:
            other.append(f"another pixel scale ({plate_scale_arcsec:g}, not {abs(image_scale):g} arcsec)")
    parts = [f"same {' and '.join(_NAMES[one] for one in same)}"] if same else []
    return same, ", but ".join([*parts, *([" and ".join(other)] if other else [])])


def _words(text: str | None) -> set[str]:
    """The words of a name that begin with a letter, such as "sdo" and "aia" of "SDO/AIA"."""
    return set(re.findall(r"(?<![a-z0-9])[a-z][a-z0-9]+", (text or "").lower()))
