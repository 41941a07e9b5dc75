"""Variants of a channel: PSFs of one channel for several filter positions or plate scales.

The channel of a PSF may name a variant after a hyphen: `174-open_2` is for images of 174 angstrom whose card FILTER,
EC_FW1_ or EC_FW2_ is "Open 2", `174-0.984arcsec` for images of that plate scale, and `174-open_2-0.984arcsec` for images with both. So each variant
is a series of its own. An image belongs to the variant of which all properties agree with its header; if several
variants agree, to the one with the most properties; if none agrees, to the channel without a variant.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from psfcore.errors import DataError
from psfcore.fits.cards import optional_text
from psfcore.fits.frame import plate_scale_arcsec
from psfcore.fits.header import FILTER_CARDS
from psfcore.instruments.files import PLATE_SCALE_TOLERANCE
from workers.versions.series import word

SEPARATOR = "-"  # a word of a header card never contains it
_SCALE = re.compile(r"(\d+(?:\.\d+)?)arcsec")


def without_variant(channel: str) -> str:
    """The channel alone: `174` of `174-open_2`."""
    return channel.partition(SEPARATOR)[0]


def is_variant_of(channel: str, plain: str) -> bool:
    """Whether a channel is a variant of the channel ``plain``."""
    return channel.startswith(f"{plain}{SEPARATOR}") and len(channel) > len(plain) + 1


def variant_for(cards: Mapping[str, Any], channels: Iterable[str]) -> str | None:
    """The channel, of these variants, to which an image belongs; None if no variant agrees with the image.

    cards: header cards of the image. Raises ``DataError`` "several-variants-fit" if two variants agree equally well.
    """
    agreeing = [channel for channel in channels if _agrees(cards, _properties(channel))]
    most = max((len(_properties(channel)) for channel in agreeing), default=0)
    best = sorted(channel for channel in agreeing if len(_properties(channel)) == most)
    if len(best) > 1:
        raise DataError(
            "several-variants-fit",
            f"expected one variant of the channel that agrees with the filter and plate scale of the image; got {', '.join(best)}: "
            "name the PSF in the request, or certify a PSF for a variant with both properties",
        )
    return best[0] if best else None


def _properties(channel: str) -> list[str]:
    return channel.split(SEPARATOR)[1:]


def _agrees(cards: Mapping[str, Any], properties: list[str]) -> bool:
    return all(_has(cards, one) for one in properties)


def _has(cards: Mapping[str, Any], wanted: str) -> bool:
    """Whether an image has a property of a variant: a plate scale, or a filter."""
    scale = _SCALE.fullmatch(wanted)
    if scale is None:
        return wanted in {word(optional_text(cards, card)) for card in FILTER_CARDS}
    found = [plate_scale_arcsec(cards, axis) for axis in (1, 2)]
    known = [one for one in found if one is not None]
    return bool(known) and all(abs(one / float(scale[1]) - 1) <= PLATE_SCALE_TOLERANCE for one in known)
