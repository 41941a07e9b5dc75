"""An instrument as its TOML file describes it, checked key by key."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from psfcore.errors import DataError
from psfcore.instruments.files import instrument_path

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Detector(_Frozen):
    """The sensor. `saturation_dn` maps a gain mode, as GAINCOMB spells it, to its level in DN."""

    pixel_pitch_um: Positive
    pixels: Count
    readout_pixels: Count
    plate_scale_arcsec: Positive
    saturation_dn: dict[str, Positive] = {}


class Mesh(_Frozen):
    """A square mesh that carries a filter: wires along rows and columns of the detector."""

    name: str
    pitch_um: Positive
    wire_um: Positive
    windows: Count
    distance_mm: Positive

    @model_validator(mode="after")
    def _wire_fits(self) -> Mesh:
        if self.wire_um >= self.pitch_um:
            raise ValueError(f"wire_um {self.wire_um} must be less than pitch_um {self.pitch_um}")
        return self


class Scatter(_Frozen):
    """Softened power law a / (b + r)^c whose sum over r > 0 on the full reach is `total`."""

    b_px: Positive
    c: Positive
    total: Annotated[float, Field(gt=0, lt=1)]
    basis: Literal["published", "fitted", "inferred"]


class Instrument(_Frozen):
    """All that a PSF is built from."""

    name: str
    version: str
    status: Literal["draft", "released"]
    wavelength_angstrom: Positive
    focal_length_mm: Positive
    aperture_diameter_mm: Positive
    match: dict[str, str] = {}
    detector: Detector
    meshes: Annotated[tuple[Mesh, ...], Field(min_length=1)]
    scatter: Scatter


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Read an instrument by its name, or from a TOML file given as a Path or as a string in .toml.

    Raises DataError "unknown-instrument" or "bad-instrument-file" (one line that names the key).
    """
    is_file = isinstance(name_or_path, Path) or name_or_path.endswith(".toml")
    path = Path(name_or_path) if is_file else instrument_path(str(name_or_path))
    try:
        return Instrument.model_validate(tomllib.loads(path.read_text("utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "file"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        problem = f"{path.name}: {key}: {first['msg']}; got {first['input']!r:.80}{more}"
        raise DataError("bad-instrument-file", problem) from None
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise DataError("bad-instrument-file", f"{path.name}: expected TOML; {reason}") from None
