"""A deconvolution in a few lines, from the details of its product: image and PSF, what changed, and the noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from psfcore.instruments.psf_statements import offer, title

LOOK_FROM = 1.0  # a person should inspect images with this artefact score or a higher one


def summary_lines(details: Mapping[str, Any]) -> list[str]:
    """The lines that summarise a product, from its `psfcore.deconvolve.run.Product.details`."""
    psf, noise, region = details["psf"], details["noise"], details["region"]
    lines = [
        f"{details['image']}, {title(psf['name'], psf['version'], psf['status'])}",
        *([f"caveats of the PSF: {'; '.join(psf['assumed'])}"] if psf["assumed"] else []),
        f"{steps_done(details)}: flux {percent(details['flux_change_pct'], 3)}, brightest 1 % of pixels "
        f"{percent(details['bright_change_pct'])}, darkest 1 % {percent(details['dark_change_pct'])}",
    ]
    if (doubt := artefact_doubt(details)) is not None:
        lines.append(
            f"artefacts: {doubt}; compare the pixels with a bit in QUALITY before and after; if they are artefacts, "
            "use fewer steps or another PSF"
        )
    if region is not None:
        lines.append(
            f"region {region['box']}, rim {region['rim_px']} px: {region_error(region.get('error_pct'))}"
        )
    if noise is not None:
        lines.append(f"errors from the noise: {noise['text']}")
    if psf.get("published"):  # products of earlier versions have no such entry
        lines.append(f"better: {offer(psf['published'])}")
    return lines


def artefact_doubt(details: Mapping[str, Any]) -> str | None:
    """That a deconvolution may have made artefacts; None: its artefact score is below `LOOK_FROM`."""
    score = details["changes"]["artefacts"]["score"]
    if score < LOOK_FROM:
        return None
    return (
        f"the artefact score is {score:.3g}, which is {LOOK_FROM:g} or more: the deconvolution may have made "
        "artefacts"
    )


def region_error(error_pct: float | None) -> str:
    """How far the result of a region may differ from the result of the whole image. `error_pct` is in percent of the
    mean of the region; it is None for a product of an earlier version, whose header gives the error in the unit of the
    image alone.
    """
    if error_pct is None:
        return "differs from the same pixels of the whole image by at most the card DCNVBERR"
    if not error_pct:
        return "does not differ from the same pixels of the whole image"
    return (
        f"differs from the same pixels of the whole image by at most {error_pct:.2g} % of the mean of the region "
        "(estimated bound)"
    )


def steps_done(details: Mapping[str, object]) -> str:
    """The number of steps, and why there were no more, if the request allowed more."""
    because, steps = str(details["stopped_because"]), details["steps_done"]
    stopped = "" if because.startswith("all ") else f" ({because})"
    return f"{steps} step{'' if steps == 1 else 's'}{stopped}"


def percent(value: float | None, digits: int = 1) -> str:
    """A relative change as text. `value` is in percent; None if the reference contains no light."""
    return "n/a (no light)" if value is None else f"{value:+.{digits}f} %"
