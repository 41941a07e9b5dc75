"""An instrument as its TOML file describes it, checked key by key.

Units stand in the keys. Angles are in degrees from +x of the detector towards +y.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from psfcore.errors import DataError
from psfcore.instruments.files import instrument_path

_MOST_DOTS = 64  # in one stretch of a file without brackets, commas or line ends

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
# Lengths and angles are multiplied and divided with each other: within these bounds, which no telescope from X-rays to
# the far infrared comes near to in the unit of its key, none of that overflows or comes to 0.
_LEAST, _MOST = 1e-9, 1e9
Size = Annotated[float, Field(ge=_LEAST, le=_MOST, allow_inf_nan=False)]
SizeOrNone = Annotated[float, Field(ge=0, le=_MOST, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Share = Annotated[float, Field(gt=0, lt=1)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class GainMode(_Frozen):
    """What a readout mode does to a photon. ``basis`` says how far the figures can be trusted."""

    saturation_dn: Positive | None = None
    photon_gain_dn: Positive | None = None
    read_noise_dn: Positive | None = None
    basis: Literal["published", "measured", "assumed"]


class Detector(_Frozen):
    """The sensor. ``gain_modes`` is keyed by the mode as GAINCOMB spells it."""

    pixel_pitch_um: Size
    pixels: Count
    readout_pixels: Count
    plate_scale_arcsec: Size
    gain_modes: dict[str, GainMode] = {}


class Aperture(_Frozen):
    """The entrance pupil: a disc, or a ring where the centre is obscured."""

    diameter_mm: Size
    obscuration_diameter_mm: SizeOrNone = 0.0

    @model_validator(mode="after")
    def _ring(self) -> Aperture:
        if self.obscuration_diameter_mm >= self.diameter_mm:
            raise ValueError(f"obscuration_diameter_mm must be less than diameter_mm {self.diameter_mm}")
        return self


class Line(_Frozen):
    """A wavelength of the bandpass and its share of the light (shares are normalised to their sum)."""

    wavelength_angstrom: Size
    weight: Positive


class Mirror(_Frozen):
    """A conic mirror: sag r^2 / (R (1 + sqrt(1 - (1 + K) r^2 / R^2)))."""

    name: str
    radius_mm: Size
    conic: Number
    diameter_mm: Size
    figure: Literal["concave", "convex"]


class Distances(_Frozen):
    """Distances along the light's way, as the drawings give them."""

    aperture_to_primary_mm: Size
    primary_to_secondary_mm: Size
    secondary_to_filter_wheel_mm: Size
    filter_wheel_to_detector_mm: Size


class Mesh(_Frozen):
    """A square mesh that carries a filter.

    ``windows`` is how many the light of one field point passes in each direction, as the paper counts them.
    ``share``: where a telescope has several meshes at one place that each see a part of the light, the part.
    """

    name: str
    place: Literal["entrance", "filter_wheel"]
    pitch_um: Size
    wire_um: Size
    windows: Count
    angle_deg: Number = 0.0
    share: Annotated[float, Field(gt=0, le=1)] = 1.0

    @model_validator(mode="after")
    def _wire_fits(self) -> Mesh:
        if self.wire_um >= self.pitch_um:
            raise ValueError(f"wire_um {self.wire_um} must be less than pitch_um {self.pitch_um}")
        return self


class Rays(_Frozen):
    """Straight bars from the hub (or the centre) to the rim, at equal angles."""

    count: Count
    width_mm: Size
    first_angle_deg: Number = 0.0


class Ring(_Frozen):
    """A circular bar; the radius is that of its middle."""

    radius_mm: Size
    width_mm: Size


class Polygon(_Frozen):
    """An opaque polygon, corners (x, y) in mm from the centre of the aperture."""

    corners_mm: Annotated[tuple[tuple[Number, Number], ...], Field(min_length=3)]


class MaskImage(_Frozen):
    """A mask as FITS or PNG: 0 is opaque and the largest value open, centred on the aperture.

    ``file`` is the name of a file beside the instrument file.
    """

    file: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*\.(png|fits|fits\.gz)$")]
    width_mm: Size


class Mount(_Frozen):
    """What holds the entrance filter. ``basis`` must say where it comes from."""

    basis: Literal["drawing", "assumed"]
    rays: tuple[Rays, ...] = ()
    rings: tuple[Ring, ...] = ()
    hub_diameter_mm: SizeOrNone = 0.0
    polygons: tuple[Polygon, ...] = ()
    mask_image: MaskImage | None = None


class Scatter(_Frozen):
    """Softened power law a / (b + r)^c whose sum over r > 0 on the full reach is ``total``."""

    b_px: Positive
    c: Positive
    total: Share
    basis: Literal["published", "fitted", "inferred"]


class Instrument(_Frozen):
    """All that a PSF is built from."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,39}$")]
    version: Annotated[str, Field(pattern=r"^\d+\.\d+\.\d+$")]
    status: Literal["draft", "released"]
    wavelength_angstrom: Size
    bandpass: tuple[Line, ...] = ()
    focal_length_mm: Size
    match: dict[str, str] = {}
    aperture: Aperture
    mirrors: tuple[Mirror, ...] = ()
    distances: Distances | None = None
    meshes: tuple[Mesh, ...] = ()
    mount: Mount | None = None
    detector: Detector
    scatter: Scatter | None = None

    @property
    def lines(self) -> tuple[Line, ...]:
        """The bandpass, or the one wavelength; weights sum to 1."""
        lines = self.bandpass or (Line(wavelength_angstrom=self.wavelength_angstrom, weight=1.0),)
        total = sum(line.weight for line in lines)
        return tuple(line.model_copy(update={"weight": line.weight / total}) for line in lines)

    def mesh_distance_mm(self, mesh: Mesh) -> float:
        """Distance over which a mesh diffracts: the focal length at the entrance, else that to the detector.

        Raises DataError "bad-instrument-file" where the file gives no distances.
        """
        if mesh.place == "entrance":
            return self.focal_length_mm
        if self.distances is None:
            raise DataError(
                "bad-instrument-file",
                f"{self.name}: distances: expected them, since mesh {mesh.name} is at the filter wheel; got none",
            )
        return self.distances.filter_wheel_to_detector_mm


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Read an instrument by its name, or from a TOML file given as a Path or as a string in .toml.

    Raises DataError "unknown-instrument" or "bad-instrument-file" (one line that names the key).
    """
    is_file = isinstance(name_or_path, Path) or name_or_path.endswith(".toml")
    path = Path(name_or_path) if is_file else instrument_path(str(name_or_path))
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise DataError("bad-instrument-file", f"{path.name}: expected TOML in UTF-8; {reason}") from None
    return parse_instrument(text, path.name)


def parse_instrument(text: str, label: str) -> Instrument:
    """An instrument from the text of its TOML file; ``label`` names it in errors.

    Raises DataError "bad-instrument-file" (one line that names the key, what was expected and what came).
    """
    try:
        return Instrument.model_validate(_parse_toml(text))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "file"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        problem = f"{label}: {key}: {first['msg']}; got {first['input']!r:.80}{more}"
        raise DataError("bad-instrument-file", problem) from None
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        # Integers of thousands of digits, and lists in lists in lists, end as the latter two.
        deep = isinstance(error, RecursionError)
        reason = "values nested less deeply" if deep else " ".join(str(error).split())
        raise DataError("bad-instrument-file", f"{label}: expected TOML; {reason:.200}") from None


def _parse_toml(text: str) -> dict[str, Any]:
    # The parser's time goes with the square of a dotted key's length: 64 kB of "a.a.a" would take half a minute.
    for stretch in re.split(r"[^\w\"'. \t-]", text):
        if stretch.count(".") > _MOST_DOTS:
            raise ValueError(f"keys of at most {_MOST_DOTS} parts; got {stretch.strip()[:40]!r} ...")
    return tomllib.loads(text)
