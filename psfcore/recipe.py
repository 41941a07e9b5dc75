"""The recipe of a PSF that is built from an instrument file, and its identity.

The identity is the SHA-256 of everything that determines the PSF. The service, commands and Python functions use the
same identity, so they can share a built PSF. This module imports no numerical library.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass

REACH_GRID_PX = 2048  # light is counted over this grid: the full reach
BUILD_VERSION = 3  # raise this number when a change of the code changes the PSF of a recipe


def canonical_hash(content: Mapping[str, object]) -> str:
    """SHA-256 of a JSON object in canonical form (sorted keys, no spaces)."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Recipe:
    """How a PSF is built.

    Attributes
    ----------
    text
        The text of the instrument file.
    name
        The name of the shipped instrument file; None: the user wrote the file.
    mask_id
        SHA-256 of the file with the mask image of the mount.
    size
        Edge length of the PSF array, px.
    component
        The only component to build, in lower case; None: the total PSF.
    """

    text: str
    name: str | None = None
    mask_id: str | None = None
    size: int = REACH_GRID_PX
    component: str | None = None
    algorithm_version: int = BUILD_VERSION

    @property
    def file_sha256(self) -> str:
        """SHA-256 of the instrument file."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def identity(self) -> str:
        """Identity of the PSF: bytes of the instrument file, parameters, version of the algorithm."""
        return canonical_hash(
            {
                "kind": "psf-build",
                "instrument_file": self.file_sha256,
                "parameters": {"mask_id": self.mask_id, "size": self.size, "component": self.component},
                "algorithm_version": self.algorithm_version,
            }
        )

    @property
    def parameters(self) -> dict[str, object]:
        """The parameters that are set, as the provenance of the PSF records them."""
        every = {
            "instrument": self.name,
            "mask_id": self.mask_id,
            "size": self.size,
            "component": self.component,
        }
        return {name: value for name, value in every.items() if value is not None}
