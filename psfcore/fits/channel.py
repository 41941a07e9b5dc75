"""Compare the telescope, the channel, the filter and the pixels of an image with those of a PSF.

This module compares the instrument that the instrument files know, the wavelength, and the cards TELESCOP, INSTRUME,
DETECTOR and FILTER. It compares only values that both the image and the PSF give. The order of the words in a card is
ignored, and one text may have more words than the other, as SDO and SDO/AIA. Wavelengths count as equal if they differ
by at most 1 %, because headers round the wavelength. The channels of AIA, EUI and similar telescopes differ by more.

This module imports no numerical library.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, Self

from psfcore.errors import DataError
from psfcore.fits.cards import Cards, optional_text
from psfcore.fits.frame import frame_of
from psfcore.fits.header import known_instrument, wavelength_angstrom
from psfcore.instruments.files import (
    PLATE_SCALE_TOLERANCE,
    WAVELENGTH_TOLERANCE,
    instrument_names,
    match_table,
)
from psfcore.instruments.model import Instrument, load_instrument

_TO_ALLOW = "set other_channel (--other-channel)"


class Origin(Protocol):
    """The properties of a PSF that are compared with an image header. `psfcore.psf.Psf` has these properties."""

    @property
    def name(self) -> str:
        """Its name, for messages."""

    @property
    def instrument(self) -> str | None:
        """The name of its instrument."""

    @property
    def wavelength_angstrom(self) -> float | None:
        """Its wavelength; None: that of the instrument."""

    @property
    def plate_scale_arcsec(self) -> float | None:
        """The plate scale of its pixels, arcsec/px."""

    @property
    def cards(self) -> Mapping[str, str]:
        """The cards of the images for which it is valid."""


@dataclass(frozen=True)
class PsfOrigin:
    """The properties of a PSF that are known without its weights; for `cards` see `psfcore.psf.Psf`."""

    name: str
    instrument: str | None
    wavelength_angstrom: float | None
    plate_scale_arcsec: float | None
    cards: Mapping[str, str]

    @classmethod
    def of_instrument(cls, instrument: Instrument) -> Self:
        """The origin of the PSF that is built from an instrument file."""
        scale = instrument.detector.plate_scale_arcsec
        return cls(instrument.name, instrument.name, instrument.wavelength_angstrom, scale, {})


def check_channel(psf: Origin, header: Cards, *, other_channel: bool = False) -> str | None:
    """Compare a PSF with an image that has this header. Returns a warning, or None if both are of the same channel.

    The warning does not name the PSF: it becomes a part of the product, which must not depend on the name of a file.
    Raises DataError "channel-mismatch" if the PSF is of another telescope, channel or filter than the image, unless
    ``other_channel`` is true.

    Parameters
    ----------
    other_channel
        Whether the PSF may be of another telescope, channel or filter than the image.
    """
    differences = channel_differences(psf, header)
    if differences and not other_channel:
        raise DataError(
            "channel-mismatch",
            f"expected an image of the telescope, channel and filter of PSF {psf.name}; {'; '.join(differences)}: name "
            f"a PSF of the image's channel, or {_TO_ALLOW} to use this PSF",
            {"psf": psf.name, "differences": differences},
        )
    if differences:
        return f"the PSF is of another channel than the image: {'; '.join(differences)}"
    silent = [name for name, angstrom in _wavelengths(psf, header).items() if not angstrom]
    words = " and ".join(silent)
    return (
        f"the channels of image and PSF were not compared: {words} without wavelength (WAVELNTH)"
        if silent
        else None
    )


def channel_differences(psf: Origin, header: Cards) -> list[str]:
    """The differences between the PSF and an image with this header; one text for each difference."""
    differences = []
    if (instrument := _other_instrument(psf, header)) is not None:
        differences.append(f"the image is of {instrument}, the PSF of {psf.instrument}")
    psf_angstrom, image_angstrom = _wavelengths(psf, header).values()
    if image_angstrom and psf_angstrom and abs(image_angstrom / psf_angstrom - 1) > WAVELENGTH_TOLERANCE:
        differences.append(
            f"the image is of {image_angstrom:g} angstrom, the PSF of {psf_angstrom:g} angstrom"
        )
    for key, of_psf in psf.cards.items():
        of_image = optional_text(header, key)
        if of_image is not None and not same_words(of_image, of_psf):
            differences.append(f"the image has {key} {of_image!r}, the PSF {of_psf!r}")
    return differences


def _other_instrument(psf: Origin, header: Cards) -> str | None:
    """The instrument of the image if it is certainly not the instrument of the PSF; otherwise None."""
    if psf.instrument not in instrument_names():
        return None
    instrument = known_instrument(header)
    if instrument is not None:
        return None if instrument == psf.instrument else instrument
    # The wavelength is compared separately. An instrument file without [match] cannot say which images are of its
    # instrument.
    matches = {key: text for key, text in match_table(psf.instrument).items() if isinstance(text, str)}
    cards = {key: optional_text(header, key) for key in ("TELESCOP", "OBSRVTRY", "INSTRUME", "DETECTOR")}
    compared = [same_words(text, matches[key]) for key, text in cards.items() if text and key in matches]
    same = not matches or (compared and all(compared))
    return None if same else " ".join(text for text in cards.values() if text) or None


def _wavelengths(psf: Origin, header: Cards) -> dict[str, float | None]:
    """Wavelengths in angstrom of the PSF and the image: as they give it, or else of their instruments; None if neither
    gives it.
    """
    given = {
        "PSF": (psf.wavelength_angstrom, psf.instrument),
        "image": (wavelength_angstrom(header), known_instrument(header)),
    }
    return {
        name: load_instrument(instrument).wavelength_angstrom
        if angstrom is None and instrument in instrument_names()
        else angstrom
        for name, (angstrom, instrument) in given.items()
    }


def same_words(one: str, other: str) -> bool:
    """Whether one of two texts has all words of the other."""
    first, second = (set(re.findall(r"[a-z0-9.]+", text.lower())) for text in (one, other))
    return first <= second or second <= first


def binning_factor(psf: Origin, header: Cards) -> int:
    """The number of PSF pixels in one image pixel, along each axis.

    The factor is 1 if the plate scales agree to 1 %, or if one of them is not known. If the plate scale of the image is
    a whole multiple of the plate scale of the PSF, the same on both axes, the factor is this multiple. This requires
    that the image is from the PSF's instrument, or that the PSF names no instrument. Otherwise the multiple may be a
    coincidence: for example, a pixel of FSI is as wide as nine pixels of HRI_EUV. Raises DataError
    "plate-scale-mismatch".
    """
    if psf.plate_scale_arcsec is None:
        return 1
    scales = frame_of(header).scale_arcsec
    factors = {_factor(scale / psf.plate_scale_arcsec) for scale in scales if scale is not None}
    if factors <= {1}:
        return 1
    whole = factors.pop() if len(factors) == 1 else None
    if whole is not None and psf.instrument in (None, known_instrument(header)):
        return whole
    text = " x ".join("unknown" if scale is None else f"{scale:g}" for scale in scales)
    advice = (
        "use a PSF of the image's pixels"
        if whole is None
        else f"rebin the PSF with `heliopsf psf rebin PSF --factor {whole} -o FILE`, and use FILE as the PSF"
    )
    raise DataError(
        "plate-scale-mismatch",
        f"expected {psf.plate_scale_arcsec:g} arcsec/px, the plate scale of PSF {psf.name}, or binned images of its "
        f"instrument; got CDELT1 x CDELT2 = {text} arcsec/px: {advice}",
        {"psf": psf.name, "psf_arcsec": psf.plate_scale_arcsec, "image_arcsec": text, "factor": whole},
    )


def _factor(ratio: float) -> int | None:
    """The whole number that agrees with the ratio of two plate scales to 1 %; None if there is no such number."""
    whole = round(ratio)
    return whole if whole >= 1 and abs(ratio / whole - 1) <= PLATE_SCALE_TOLERANCE else None
