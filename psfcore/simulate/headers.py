"""The header keywords of a simulated image: those that real images of the imitated instrument have.

HRI_EUV images get the keywords of level 2 files of EUI. AIA images get the keywords of level 1 files, without
DETECTOR and gain modes. Images of another instrument get three kinds of keywords: those by which
the TOML file of the instrument recognises its images, the wavelength, and the plate scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

from psfcore.fits.images import CardValue
from psfcore.instruments.model import Instrument
from psfcore.simulate.plan import Shot

_START = datetime(2023, 1, 3, 3, 42)
_TEXTS_OF_HRI = {"TELESCOP": "SOLO/EUI/HRI_EUV", "INSTRUME": "EUI", "DETECTOR": "HRI_EUV"}
_TELESCOPES_OF_AIA = {94: 4, 131: 1, 171: 3, 193: 2, 211: 2, 304: 4, 335: 1}  # Lemen et al. (2012)
_COMMENTS = {
    "ORIGIN": "not an observation",
    "TELESCOP": "telescope imitated",
    "INSTRUME": "instrument imitated",
    "DETECTOR": "detector imitated",
    "WAVEUNIT": "unit of WAVELNTH",
    "WAVELNTH": "[Angstrom] wavelength",
    "CDELT1": "[arcsec] pixel scale along axis 1",
    "CDELT2": "[arcsec] pixel scale along axis 2",
    "DATE-BEG": "[UTC] start of exposure, made up",
    "DATE-OBS": "[UTC] start of exposure, made up",
    "XPOSURE": "[s] exposure time",
    "EXPTIME": "[s] exposure time",
    "GAINCOMB": "gain mode imitated",
    "BUNIT": "unit of the pixels",
    "SATURATE": "[DN] level at which pixels clip",
    "FOV": "pointing",
    "PSFSUM": "this file is a PSF: sum of its weights",
    "MARGIN": "[pixel] width beyond the field on each side",
}


@dataclass(frozen=True)
class Imitated:
    """The instrument that simulated headers imitate.

    name: the instrument's name in transit.json. texts: keywords that identify the instrument, with their values.
    wavelength_angstrom: a whole number, the value of WAVELNTH. date_key, exposure_key: the keywords of the start and of
    the exposure time. has_gain_modes: whether GAINCOMB is written.
    """

    name: str
    texts: dict[str, str]
    wavelength_angstrom: int
    plate_scale_arcsec: float
    date_key: str = "DATE-BEG"
    exposure_key: str = "XPOSURE"
    has_gain_modes: bool = True

    def values(self) -> dict[str, CardValue]:
        """The keywords that every file of the transit has."""
        return {
            "ORIGIN": "SIMULATED by heliopsf",
            **self.texts,
            "WAVELNTH": self.wavelength_angstrom,
            "CDELT1": self.plate_scale_arcsec,
            "CDELT2": self.plate_scale_arcsec,
        }

    def shot_values(self, shot: Shot, unit: str) -> dict[str, CardValue]:
        """The keywords of one image whose pixels are in `unit`."""
        begin = (_START + timedelta(seconds=shot.time_s)).isoformat(timespec="milliseconds")
        values = self.values() | {self.date_key: begin, self.exposure_key: shot.exposure_s}
        if self.has_gain_modes:
            values["GAINCOMB"] = shot.gain_mode
        return values | {"BUNIT": unit}


HRI_EUV = Imitated("hri_euv", _TEXTS_OF_HRI, 174, 0.492)


def imitated(instrument: Instrument) -> Imitated:
    """The keywords with which headers imitate `instrument`."""
    if instrument.name == HRI_EUV.name:
        return HRI_EUV
    channel = round(instrument.wavelength_angstrom)
    is_aia = instrument.name.startswith("aia_") and channel in _TELESCOPES_OF_AIA
    texts = {key: text for key, text in instrument.match.items() if isinstance(text, str)}
    if is_aia:
        number = _TELESCOPES_OF_AIA[channel]
        texts = {"TELESCOP": "SDO/AIA", "INSTRUME": f"AIA_{number}", "WAVEUNIT": "angstrom"}
    return Imitated(
        name=instrument.name,
        texts=texts,
        wavelength_angstrom=channel,
        plate_scale_arcsec=instrument.detector.plate_scale_arcsec,
        date_key="DATE-OBS" if is_aia else "DATE-BEG",
        exposure_key="EXPTIME" if is_aia else "XPOSURE",
        has_gain_modes=not is_aia,
    )


def commented(values: dict[str, CardValue]) -> dict[str, tuple[CardValue, str]]:
    """Add the comment of each keyword."""
    return {key: (value, _COMMENTS.get(key, "instrument imitated")) for key, value in values.items()}
