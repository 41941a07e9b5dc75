"""The instrument file (TOML): its tables and keys, checked key by key.

Every key names its unit. Angles are in degrees from +x of the detector towards +y. docs/instruments.md is the
reference.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import field, is_dataclass, replace
from decimal import Decimal
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args, get_type_hints

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
    with_config,
)
from pydantic.dataclasses import dataclass
from pydantic_core import ErrorDetails
from typing_extensions import TypedDict

from psfcore.errors import MOST_TOLD, DataError
from psfcore.instruments.files import instrument_path, parse_toml

MM_PER_ANGSTROM, MM_PER_UM, UM_PER_ANGSTROM, UM_PER_MM = 1e-7, 1e-3, 1e-4, 1e3


def _no_text(value: object) -> object:
    """Refuse a text and a boolean, which pydantic would convert to a whole number."""
    if isinstance(value, str | bool):
        raise ValueError("expected a whole number")
    return value


# The schemas of the tables are built when the first instrument is read, because that takes longer than the import.
_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False, defer_build=True)
Number = Annotated[float, Field(strict=True)]
Whole = Annotated[int, BeforeValidator(_no_text)]
Positive = Annotated[Number, Field(gt=0)]
# The software multiplies and divides lengths. Within these limits no product or quotient overflows or becomes 0. All
# telescopes from X-rays to the far infrared are well within these limits, in the units of the keys.
_LEAST, _MOST = 1e-9, 1e9
Size = Annotated[Number, Field(ge=_LEAST, le=_MOST)]
SizeOrNone = Annotated[Number, Field(ge=0, le=_MOST)]
Coordinate = Annotated[Number, Field(ge=-_MOST, le=_MOST)]
Count = Annotated[Whole, Field(ge=1, le=100_000)]
# The numbers of parts of an instrument. Memory and time of a PSF grow with them; the shipped instruments have at most 3
# meshes of 551 windows, 8 rays, 2 rings and 1 spectral line.
MOST_BYTES = 65_536
MOST_LINES, MOST_MIRRORS, MOST_MESHES, MOST_WINDOWS = 64, 16, 16, 10_000
MOST_RAYS, MOST_RINGS, MOST_POLYGONS, MOST_CORNERS = 256, 64, 64, 1024
MOST_KEYS = 64
MOST_LAWS, MOST_ROWS = 8, 1024
Windows = Annotated[Whole, Field(ge=1, le=MOST_WINDOWS)]
Name = Annotated[str, Field(max_length=80)]
Share = Annotated[Number, Field(gt=0, lt=1)]


@with_config(_CONFIG)
class Match(TypedDict, total=False):
    """The cards of the images of an instrument."""

    TELESCOP: Name
    OBSRVTRY: Name
    INSTRUME: Name
    DETECTOR: Name
    FILTER: Name
    EC_FW1_: Name
    EC_FW2_: Name
    WAVELNTH: Size
    CDELT1: Size


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class GainMode:
    """Saturation and noise of one readout mode.

    Attributes
    ----------
    basis
        The origin of the numbers.
    """

    saturation_dn: Positive | None = None
    photon_gain_dn: Positive | None = None
    read_noise_dn: Positive | None = None
    basis: Literal["published", "measured", "assumed"]


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Detector:
    """The sensor. The keys of ``gain_modes`` are the values of the header keyword GAINCOMB."""

    pixel_pitch_um: Size
    pixels: Count
    readout_pixels: Count
    plate_scale_arcsec: Size
    gain_modes: Annotated[dict[Name, GainMode], Field(max_length=MOST_KEYS)] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Sector:
    """The part of a disc or ring from the direction ``first_angle_deg`` through ``opening_deg`` towards +y."""

    first_angle_deg: Number
    opening_deg: Annotated[Number, Field(ge=1, le=359)]


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Aperture:
    """The entrance pupil: a disc, a ring (the centre is obscured), a sector of one of these, or a polygon.

    Attributes
    ----------
    corners_mm
        The corners (x, y) of the polygon from the optical axis, all within the circle of ``diameter_mm``.
    """

    diameter_mm: Size
    obscuration_diameter_mm: SizeOrNone = 0.0
    sector: Sector | None = None
    corners_mm: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Field(max_length=MOST_CORNERS)] = ()

    @property
    def round(self) -> bool:
        """Whether the pupil is a whole disc or ring, whose pattern depends on the radius alone."""
        return self.sector is None and not self.corners_mm

    @model_validator(mode="after")
    def _polygon_is_one(self) -> Self:
        if not self.corners_mm:
            return self
        if self.sector is not None or self.obscuration_diameter_mm:
            raise ValueError(
                "expected corners_mm alone, or a disc or ring with or without a sector; got corners_mm with another "
                "shape: describe opaque parts of a polygon in [mount]"
            )
        farthest = max(math.hypot(x, y) for x, y in self.corners_mm)
        if farthest > self.diameter_mm / 2 * (1 + 1e-9):
            raise ValueError(
                f"expected corners_mm within {self.diameter_mm / 2} mm of the axis; got a corner at {farthest:.6g} mm"
            )
        if abs(signed_area(self.corners_mm)) < 1e-6 * self.diameter_mm**2:
            raise ValueError(
                "expected corners_mm that enclose an area; got almost none: list them around the pupil"
            )
        return self

    @model_validator(mode="after")
    def _obscuration_is_smaller(self) -> Self:
        if self.obscuration_diameter_mm >= self.diameter_mm:
            raise ValueError(
                f"expected obscuration_diameter_mm less than diameter_mm ({self.diameter_mm}); "
                f"got {self.obscuration_diameter_mm}"
            )
        return self


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class SpectralLine:
    """A spectral line of the bandpass and its share of the light; the shares are normalised to sum 1."""

    wavelength_angstrom: Size
    weight: Size


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Mirror:
    """A conic mirror. Its sag is r^2 / (R (1 + sqrt(1 - (1 + K) r^2 / R^2)))."""

    name: Name
    radius_mm: Size
    conic: Number
    diameter_mm: Size
    figure: Literal["concave", "convex"]


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Distances:
    """Distances along the optical path, as the drawings give them."""

    aperture_to_primary_mm: Size
    primary_to_secondary_mm: Size
    secondary_to_filter_wheel_mm: Size
    filter_wheel_to_detector_mm: Size


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Mesh:
    """A mesh with square or hexagonal openings that supports a filter.

    Attributes
    ----------
    pitch_um
        The distance from the centre of an opening to the centre of the next opening.
    angle_deg
        The direction from the centre of an opening to the centre of the next opening; in a square mesh, the wires have
        this direction and the direction across it.
    windows
        Number of windows of the diffraction series in each direction. At the entrance, this is the diameter of the
        aperture divided by the pitch; at the filter wheel, the number of windows that the light crosses.
    share
        The fraction of the light that crosses this mesh, if several meshes are mounted side by side.
    basis
        "assumed" if any number of the mesh is assumed; each use of the PSF then says so.
    """

    name: Name
    place: Literal["entrance", "filter_wheel"]
    pitch_um: Size
    wire_um: Size
    windows: Windows
    angle_deg: Number = 0.0
    openings: Literal["square", "hexagonal"] = "square"
    basis: Literal["published", "assumed"] = "published"
    share: Annotated[Number, Field(gt=0, le=1)] = 1.0

    @model_validator(mode="after")
    def _wires_are_thinner_than_the_pitch(self) -> Self:
        if self.wire_um >= self.pitch_um:
            raise ValueError(f"expected wire_um less than pitch_um ({self.pitch_um}); got {self.wire_um}")
        return self


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Rays:
    """Straight bars from the hub (or the centre) to the rim, at equal angles."""

    count: Annotated[Whole, Field(ge=1, le=MOST_RAYS)]
    width_mm: Size
    first_angle_deg: Number = 0.0


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Ring:
    """A circular bar; ``radius_mm`` is the radius of its centre line."""

    radius_mm: Size
    width_mm: Size


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Polygon:
    """An opaque polygon with corners (x, y) in mm from the centre of the aperture."""

    corners_mm: Annotated[
        tuple[tuple[Coordinate, Coordinate], ...], Field(min_length=3, max_length=MOST_CORNERS)
    ]


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class MaskImage:
    """A mask as a FITS or PNG image centred on the aperture: 0 is opaque, the largest value is open.

    ``file`` is the name of a file in the folder of the instrument file.
    """

    file: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*\.(png|fits|fits\.gz)$")]
    width_mm: Size


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Mount:
    """The mount of the entrance filter.

    Attributes
    ----------
    basis
        The origin of the description of the mount.
    """

    basis: Literal["drawing", "assumed"]
    rays: Annotated[tuple[Rays, ...], Field(max_length=MOST_RAYS)] = ()
    rings: Annotated[tuple[Ring, ...], Field(max_length=MOST_RINGS)] = ()
    hub_diameter_mm: SizeOrNone = 0.0
    polygons: Annotated[tuple[Polygon, ...], Field(max_length=MOST_POLYGONS)] = ()
    mask_image: MaskImage | None = None

    @model_validator(mode="after")
    def _parts_are_limited(self) -> Self:
        for most, got, parts in (
            (MOST_RAYS, self.ray_count, "rays"),
            (MOST_CORNERS, self.corner_count, "corners of polygons"),
        ):
            if got > most:
                raise ValueError(f"expected at most {most} {parts} in all; got {got}")
        return self

    @property
    def ray_count(self) -> int:
        """Number of rays of all groups."""
        return sum(rays.count for rays in self.rays)

    @property
    def corner_count(self) -> int:
        """Number of corners of all polygons."""
        return sum(len(polygon.corners_mm) for polygon in self.polygons)


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class PowerLaw:
    """One of several softened power laws 1 / (b + r)^c; the shares are normalised to sum 1."""

    b_px: Positive
    c: Positive
    share: Size


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Scatter:
    """Diffuse scatter. Its shape is one softened power law, the sum of several, or a table of (radius in px, weight).

    ``total`` is its sum over r > 0 on the full reach.
    """

    total: Share
    basis: Literal["published", "fitted", "inferred"]
    b_px: Positive | None = None
    c: Positive | None = None
    laws: Annotated[tuple[PowerLaw, ...], Field(max_length=MOST_LAWS)] = ()
    table: Annotated[tuple[tuple[Size, Size], ...], Field(max_length=MOST_ROWS)] = ()

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        law = (self.b_px is not None) + (self.c is not None)
        if law == 1 or bool(law) + bool(self.laws) + bool(self.table) != 1:
            keys = [key for key in ("b_px", "c", "laws", "table") if getattr(self, key)]
            raise ValueError(
                f"expected one shape: b_px and c, or laws, or table; got {' and '.join(keys) or 'none of them'}"
            )
        radii = [radius for radius, _ in self.table]
        if radii and (len(radii) < 2 or any(b <= a for a, b in pairwise(radii))):
            raise ValueError(
                "table: expected at least two rows [radius_px, weight] with growing radii; got others"
            )
        return self

    @property
    def power_laws(self) -> tuple[PowerLaw, ...]:
        """The power laws with shares that sum to 1; empty if the shape is a table."""
        if self.b_px is not None and self.c is not None:
            return (PowerLaw(b_px=self.b_px, c=self.c, share=1.0),)
        whole = sum(law.share for law in self.laws)
        return tuple(replace(law, share=law.share / whole) for law in self.laws)


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class Instrument:
    """An instrument: all quantities from which a PSF is computed.

    Attributes
    ----------
    turn_deg
        The angle from the +x axis of the detector to the +x axis of the images, degrees. The angles and corners of a
        read instrument are those on the images.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,39}$")]
    version: Annotated[str, Field(pattern=r"^\d+\.\d+\.\d+$")]
    status: Literal["draft", "released"]
    wavelength_angstrom: Size
    bandpass: Annotated[tuple[SpectralLine, ...], Field(max_length=MOST_LINES)] = ()
    focal_length_mm: Size
    turn_deg: Number = 0.0
    match: Match = field(default_factory=Match)
    aperture: Aperture
    mirrors: Annotated[tuple[Mirror, ...], Field(max_length=MOST_MIRRORS)] = ()
    distances: Distances | None = None
    meshes: Annotated[tuple[Mesh, ...], Field(max_length=MOST_MESHES)] = ()
    mount: Mount | None = None
    detector: Detector
    scatter: Scatter | None = None

    @model_validator(mode="after")
    def _values_fit_together(self) -> Self:
        total = sum(line.weight for line in self.bandpass)
        for k, line in enumerate(self.bandpass):
            if line.weight < _LEAST * total:
                raise ValueError(
                    f"bandpass.{k}.weight: expected at least {_LEAST:g} of the sum of all weights; got {line.weight}"
                )
        if self.turn_deg and self.mount is not None and self.mount.mask_image is not None:
            raise ValueError(f"turn_deg: expected 0, because a mask image is not turned; got {self.turn_deg}")
        return self

    def on_images(self) -> Instrument:
        """The instrument as images that are turned by ``turn_deg`` show it: a direction on them is smaller by this
        angle.
        """
        if not self.turn_deg:
            return self
        meshes = tuple(replace(mesh, angle_deg=mesh.angle_deg - self.turn_deg) for mesh in self.meshes)
        mount = self.mount
        if mount is not None:
            rays = tuple(
                replace(one, first_angle_deg=one.first_angle_deg - self.turn_deg) for one in mount.rays
            )
            polygons = tuple(
                replace(one, corners_mm=_turned(one.corners_mm, -self.turn_deg)) for one in mount.polygons
            )
            mount = replace(mount, rays=rays, polygons=polygons)
        aperture, sector = self.aperture, self.aperture.sector
        if sector is not None:
            aperture = replace(
                aperture, sector=replace(sector, first_angle_deg=sector.first_angle_deg - self.turn_deg)
            )
        if aperture.corners_mm:
            aperture = replace(aperture, corners_mm=_turned(aperture.corners_mm, -self.turn_deg))
        return replace(self, aperture=aperture, meshes=meshes, mount=mount)

    def gain_mode(self, name: str | None) -> GainMode | None:
        """The readout mode that the card GAINCOMB names, in upper or lower case; None if the file does not have it."""
        modes = {key.lower(): mode for key, mode in self.detector.gain_modes.items()}
        return modes.get((name or "").lower())

    @property
    def spectral_lines(self) -> tuple[SpectralLine, ...]:
        """The bandpass, or the one wavelength; the weights sum to 1."""
        lines = self.bandpass or (SpectralLine(wavelength_angstrom=self.wavelength_angstrom, weight=1.0),)
        total = sum(line.weight for line in lines)
        return tuple(replace(line, weight=line.weight / total) for line in lines)

    def mesh_distance_mm(self, mesh: Mesh) -> float:
        """Diffraction distance of a mesh: the focal length at the entrance, otherwise the distance to the detector.

        Raises DataError "bad-instrument-file" if the file gives no distances.
        """
        if mesh.place == "entrance":
            return self.focal_length_mm
        if self.distances is None:
            raise DataError(
                "bad-instrument-file",
                f"{self.name}: distances: expected this table, because mesh {mesh.name!r} is at the filter wheel; got "
                "none",
            )
        return self.distances.filter_wheel_to_detector_mm


def signed_area(corners: Sequence[tuple[float, float]]) -> float:
    """The area of a polygon with these corners (x, y), in the square of their unit; above 0 if they run from +x to
    +y.
    """
    following = (*corners[1:], corners[0])
    return sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(corners, following, strict=True)) / 2


def _turned(corners: tuple[tuple[float, float], ...], angle_deg: float) -> tuple[tuple[float, float], ...]:
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return tuple((cosine * x - sine * y, sine * x + cosine * y) for x, y in corners)


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Read an instrument by its name, or from a TOML file given as a Path or as a string that ends in .toml.

    Raises DataError "unknown-instrument", "no-such-file", or "bad-instrument-file" (a line for each wrong key).
    """
    is_file = isinstance(name_or_path, Path) or name_or_path.endswith(".toml")
    path = Path(name_or_path) if is_file else instrument_path(str(name_or_path))
    return parse_instrument(read_instrument_text(path), path.name)


def read_instrument_text(path: Path) -> str:
    """Read an instrument file, but at most one character more than the limit, so that `parse_instrument` can refuse it.

    Raises DataError "no-such-file", "bad-instrument-file".
    """
    try:
        with path.open("rb") as file:
            return file.read(MOST_BYTES + 1).decode("utf-8")
    except FileNotFoundError:
        raise DataError(
            "no-such-file", f"expected an instrument file; got '{path}', and there is none"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise DataError("bad-instrument-file", f"{path.name}: expected TOML in UTF-8; {reason}") from None


def parse_instrument(text: str, label: str) -> Instrument:
    """Read an instrument from the text of its TOML file; ``label`` names the file in errors.

    Raises DataError "bad-instrument-file": a line with the key, the expected and the given value of each fault.
    """
    if len(text) > MOST_BYTES:
        raise DataError("bad-instrument-file", f"{label}: expected at most {MOST_BYTES} characters; got more")
    try:
        instrument: Instrument = _FILE.validate_python(parse_toml(text))
    except ValidationError as error:
        raise DataError("bad-instrument-file", f"{label}: {_fault_lines(error)}") from None
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        # An integer of thousands of digits raises ValueError; deeply nested lists raise RecursionError.
        deep = isinstance(error, RecursionError)
        reason = "too many levels of nesting" if deep else " ".join(str(error).split())
        raise DataError("bad-instrument-file", f"{label}: expected TOML; {reason:.200}") from None
    return instrument.on_images()


_FILE: TypeAdapter[Instrument] = TypeAdapter(Instrument)
_UNKNOWN = ("unexpected_keyword_argument", "extra_forbidden")
# What was expected, by the type of pydantic's error.
_EXPECTED = {
    "missing": "this key",
    "float_type": "a finite number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing_size": "a whole number of at most 19 digits",
    "greater_than": "a number above {gt}",
    "greater_than_equal": "a number of at least {ge}",
    "less_than_equal": "a number of at most {le}",
    "less_than": "a number below {lt}",
    "string_type": "a text",
    "string_too_long": "at most {max_length} characters",
    "string_pattern_mismatch": "a text of the form {pattern}",
    "literal_error": "one of {expected}",
    "tuple_type": "a list",
    "too_short": "at least {min_length} entries",
    "too_long": "at most {max_length} entries",
    "dict_type": "a table",
    "dataclass_type": "a table",
}


def _fault_lines(error: ValidationError) -> str:
    """All faults, each in a line. A key that is missing because it is misspelt is one fault, not two."""
    faults = sorted(error.errors(include_url=False), key=lambda one: one["type"] not in _UNKNOWN)
    misspelt = [(*one["loc"][:-1], _closest_key(one["loc"])) for one in faults if one["type"] in _UNKNOWN]
    lines = [_fault(one) for one in faults if one["type"] != "missing" or tuple(one["loc"]) not in misspelt]
    if len(lines) > MOST_TOLD:
        lines = [*lines[:MOST_TOLD], f"and {len(lines) - MOST_TOLD} more"]
    return (
        lines[0]
        if len(lines) == 1
        else "\n".join(["several keys are wrong:", *(f"  {one}" for one in lines)])
    )


def _fault(fault: ErrorDetails) -> str:
    # pydantic marks the name of a gain mode itself, unlike its table, by one more step.
    key = ".".join(str(step) for step in fault["loc"] if step != "[key]")
    if fault["type"] in _UNKNOWN and (closest := _closest_key(fault["loc"])):
        return f"{key}: unknown key; did you mean {closest!r}?"
    expected = _expected(fault)
    if "; got " not in expected:  # a fault of several values says itself what was given
        expected += "; got none" if fault["type"] == "missing" else f"; got {fault['input']!r:.80}"
    return f"{key}: {expected}" if key else expected


def _closest_key(location: Sequence[str | int]) -> str:
    """The known key that is like an unknown one; an empty text if there is none."""
    return next(iter(get_close_matches(str(location[-1]), _keys(location[:-1]), n=1)), "")


def _expected(fault: ErrorDetails) -> str:
    context = fault.get("ctx", {})
    if fault["type"] in _UNKNOWN:
        return f"expected one of the keys {', '.join(_keys(fault['loc'][:-1]))}"
    if fault["type"] == "missing" and isinstance(fault["loc"][-1], int):
        return "expected this entry"
    if fault["type"] == "value_error":
        return str(context["error"])
    bounds = {
        name: f"{Decimal(repr(bound)).normalize():f}" if isinstance(bound, int | float) else bound
        for name, bound in context.items()
    }
    return f"expected {_EXPECTED.get(fault['type'], 'another value').format(**bounds)}"


def _keys(location: Sequence[str | int]) -> list[str]:
    """The keys of the table at a location."""
    table: Any = Instrument
    for step in location:
        kind = get_type_hints(table).get(
            str(step)
        )  # None: the number of an entry, or the name of a gain mode
        if kind is not None:
            table = next(one for one in (kind, *get_args(kind)) if is_dataclass(one) or one is Match)
    return list(get_type_hints(table))
