"""Telescopes that heliopsf recognises, but for which it has no instrument file: the reason, and what the user can do.

docs/instruments.md lists the sources. This module imports no numerical library, so that the web process can import it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from psfcore.instruments.files import WAVELENGTH_TOLERANCE

Way = Literal["name", "upload", "fit"]  # the steps that `psfcore.instruments.unknown.WAYS` describes

_NO_SOURCE = (
    "no public source that we could read gives the pitch and the wire width of its meshes, or the parameters of its "
    "diffuse scatter"
)
_ASK = "ask the authors for it as a FITS image, and upload it"


@dataclass(frozen=True)
class Telescope:
    """A telescope without an instrument file.

    cards: an image is of this telescope if its header agrees with one of these tables. A table holds fields of the header
    summary (`psfcore.fits.header.HeaderSummary`), and the text with which each of them begins, in any case.
    angstrom: the wavelengths of the images that the entry describes; empty: all wavelengths. reason: why there is no
    file. ways: sentences about the steps with which a publication or a file helps; the recommended step comes first.
    """

    name: str
    cards: tuple[Mapping[str, str], ...]
    reason: str
    ways: Mapping[Way, str]
    angstrom: tuple[float, ...] = ()

    def took(self, header: Mapping[str, Any]) -> bool:
        """Whether the image with this header summary is of this telescope."""
        if self.angstrom and not any(_same_channel(header["wavelnth"], one) for one in self.angstrom):
            return False
        return any(all(_begins(header[key], text) for key, text in table.items()) for table in self.cards)


TELESCOPES = (
    Telescope(
        name="TRACE",
        cards=({"instrume": "TRACE"}, {"telescop": "TRACE"}),
        reason=_NO_SOURCE,
        ways={
            "fit": "DeForest et al. (2009, ApJ 690, 1264) derived a PSF at 171 angstrom from the transit of Venus of 2004; "
            "heliopsf can fit the scatter to the same images",
            "upload": "Gburek et al. (2006, Solar Physics 239, 531) and DeForest et al. (2009) derived a PSF at 171 angstrom: "
            + _ASK,
        },
    ),
    Telescope(
        name="STEREO/EUVI",
        cards=({"detector": "EUVI"},),
        reason=_NO_SOURCE,
        ways={
            "upload": "The SolarSoft package euvdeconpak has the PSFs of Shearer et al. (2012, ApJ 749, L8) as FITS images, "
            "for example psf_171_A_2048.fts for STEREO-A at 171 angstrom: upload the PSF of the spacecraft and channel of "
            "the image",
            "fit": "Shearer et al. (2012) used the transit of the Moon of 2007 for EUVI on STEREO-B",
        },
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
        ways={"fit": "We found no published PSF of SUVI, so we recommend this step"},
    ),
    Telescope(
        name="Hinode/XRT",
        # The X-ray telescope of Swift also has INSTRUME = 'XRT'.
        cards=({"telescop": "HINODE", "instrume": "XRT"},),
        reason="an instrument file describes pupils and meshes, but not mirrors that reflect X-rays at grazing incidence",
        ways={
            "upload": "SolarSoft has PSFs of XRT as FITS images in hinode/xrt/idl/util: XRT20170324_151721.0.PSF560.fits at "
            "560 eV and XRT20170324_161721.0.PSF1000.fits at 1 keV; upload the PSF whose energy suits the filters of the "
            "image",
            "fit": "In images of the transit of Venus of 2012, the PSF at 560 eV removes 5 % of the light in the disc of Venus; "
            "heliopsf can fit the remaining scatter to these images",
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
            "fit": "AIA observed the transit of Venus of 2012, for example at 1600 angstrom; heliopsf can fit the scatter to "
            "such images",
        },
        angstrom=(1600.0, 1700.0, 4500.0),
    ),
)


def telescope_without_file(header: Mapping[str, Any]) -> Telescope | None:
    """The telescope without an instrument file that took the image with this header summary, or None."""
    return next((one for one in TELESCOPES if one.took(header)), None)


def _begins(card: str | None, text: str) -> bool:
    return card is not None and card.strip().upper().startswith(text.upper())


def _same_channel(wavelength_angstrom: float | None, of_channel: float) -> bool:
    return (
        wavelength_angstrom is not None and abs(wavelength_angstrom / of_channel - 1) <= WAVELENGTH_TOLERANCE
    )
