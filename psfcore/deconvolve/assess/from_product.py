"""Read a row of the contact sheet from a product: the changes that a deconvolution by the service made in an image.

The task ``deconvolve`` computed the numbers and stored them in the product's details. The product's QUALITY plane marks
the suspected pixels. This module does not deconvolve; it only bins both images to thumbnails.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess.artefacts import Artefacts
from psfcore.deconvolve.assess.changes import Changes, Range, Structure
from psfcore.deconvolve.assess.contact_sheet import THUMBNAIL_PX, Treated
from psfcore.deconvolve.assess.quality import QualityBit
from psfcore.drawing.plots import binned
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import optional_text
from psfcore.fits.images import read_planes
from psfcore.fits.observation import read_observation

DATE_KEYS = ("DATE-BEG", "DATE-OBS", "T_OBS")


def changes_in_product(
    name: str, before: str | Path, product: str | Path, details: dict[str, Any], limits: FitsLimits
) -> Treated:
    """Make the row of one image. ``before``, ``product``: the FITS files of the image and of its product.

    details: the product's details, with "changes", "steps_done" and "stopped_because". Raises the errors of
    ``read_observation``.
    """
    image, after = read_observation(before, limits), read_observation(product, limits)
    suspected = (read_planes(product)["QUALITY"] & QualityBit.ARTEFACT) > 0
    step = max(1, -(-max(image.pixels.shape) // THUMBNAIL_PX))
    return Treated(
        name=name,
        taken=optional_text(image.header, *DATE_KEYS),
        psf=f"{optional_text(after.header, 'PSFNAME')} {optional_text(after.header, 'PSFVERS')}",
        found=changes_from_json(details["changes"], suspected),
        steps_done=details["steps_done"],
        stopped_because=details["stopped_because"],
        before=binned(image.pixels, step),
        after=binned(after.pixels, step),
        suspected=np.unique(np.argwhere(suspected) // step, axis=0),
    )


def changes_from_json(figures: dict[str, Any], suspected: NDArray[np.bool_]) -> Changes:
    """Make a ``Changes`` from the numbers that ``Changes.as_json`` wrote and the plane of suspected pixels [y, x]."""
    artefacts = figures["artefacts"]
    return Changes(
        **figures
        | {
            "structures": tuple(Structure(**row) for row in figures["structures"]),
            "ranges": tuple(Range(**row) for row in figures["ranges"]),
            "artefacts": Artefacts(suspected, artefacts["signs"], artefacts["sources"], artefacts["score"]),
        }
    )
