"""The cards and the lines of HISTORY that say how an image was deconvolved."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from psfcore import software_version
from psfcore.deconvolve.result import Deconvolved
from psfcore.image import Saturation


@dataclass(frozen=True)
class UsedPsf:
    """The PSF of a deconvolution, as cards name it."""

    id: str
    name: str
    version: str
    status: str


def deconvolution_cards(
    psf: UsedPsf,
    result: Deconvolved,
    *,
    saturation: Saturation | None,
    amplification: float | None,
    warnings: Iterable[str] = (),
) -> dict[str, tuple[str | int | float, str]]:
    """The cards that say how an image was deconvolved.

    saturation: the saturation of the input. amplification: the noise amplification, if known. warnings: the codes of the
    warnings, the most harmful first; HISTORY has the sentences.
    """
    # A hash fills the whole card, so cards with a hash have no comment.
    cards: dict[str, tuple[str | int | float, str]] = {
        "PSFID": (psf.id, ""),
        "PSFVERS": (psf.version, "PSF version"),
        "PSFNAME": (psf.name, "PSF name"),
        "PSFSTAT": (psf.status, "PSF status"),
        "DCNVMETH": (result.method, "deconvolution method"),
        "DCNVITER": (result.steps_done, "deconvolution steps done"),
        "DCNVSTOP": (result.stopped_because, "why the iteration stopped"),
        "DCNVEDGE": (result.edges, "assumed scene beyond the edges"),
        "DCNVBAND": (result.edge_band_px, "[px] width of band affected by DCNVEDGE"),
        "SWHELIO": (software_version(), "heliopsf version"),
    }
    if result.of_box is not None:
        cards["DCNVBOX"] = (str(result.of_box.box), "[px] box of the input, x0:x1,y0:y1 from 0")
        cards["DCNVRIM"] = (result.of_box.rim_px, "[px] width of the rim that was also used")
        cards["DCNVBERR"] = (result.of_box.error, "bound of the difference from whole image")
    if saturation is not None and saturation.found is not None and saturation.level is not None:
        cards["DCNVSATL"] = (saturation.level, "saturation level, in the unit of the image")
        cards["DCNVSATF"] = (saturation.found, "where the saturation level was found")
    if amplification is not None:
        cards["DCNVAMPL"] = (amplification, "noise of result / noise of input")
    for number, code in enumerate(warnings, start=1):
        cards[f"DCNVWRN{number}"] = (code, "warning, see HISTORY")
    return cards


def deconvolution_history(psf: UsedPsf, result: Deconvolved, warnings: Mapping[str, str]) -> list[str]:
    """The lines of HISTORY that say how an image was deconvolved. warnings: sentences by their codes."""
    return [
        f"heliopsf {software_version()}: {result.method}, {result.steps_done} steps, "
        f"edges {result.edges}, PSF {psf.name} {psf.version} ({psf.status})",
        *_of_box(result),
        *(f"WARNING ({code}): {message}" for code, message in warnings.items()),
    ]


def _of_box(result: Deconvolved) -> list[str]:
    found = result.of_box
    if found is None:
        return []
    return [
        f"box {found.box} of the input alone, with a rim of {found.rim_px} px: differs from the same box of the whole image by "
        f"at most {found.error:.3g} (estimated bound, in the unit of the image)"
    ]
