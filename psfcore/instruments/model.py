"""The instrument file (TOML): its tables and keys, checked key by key.

Every key names its unit. Angles are in degrees from +x of the detector towards +y. docs/instruments.md is the reference.
"""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from psfcore.errors import DataError
from psfcore.instruments.checked import BadValues, Checked, Fault, Limit
from psfcore.instruments.files import instrument_path

_MOST_DOTS = 64  # a part of the file without brackets, commas or line ends may contain this number of dots

Positive = Annotated[float, Limit(gt=0)]
# The software multiplies and divides lengths. Within these limits no product or quotient overflows or becomes 0. All
# telescopes from X-rays to the far infrared are well within these limits, in the units of the keys.
_LEAST, _MOST = 1e-9, 1e9
Size = Annotated[float, Limit(ge=_LEAST, le=_MOST)]
SizeOrNone = Annotated[float, Limit(ge=0, le=_MOST)]
Number = float
Place = Annotated[float, Limit(ge=-_MOST, le=_MOST)]
Count = Annotated[int, Limit(ge=1, le=100_000)]
# The numbers of parts of an instrument. Memory and time of a PSF grow with them; the shipped instruments have at most 3
# meshes of 551 windows, 8 rays, 2 rings and 1 spectral line.
MOST_BYTES = 65_536
MOST_LINES, MOST_MIRRORS, MOST_MESHES, MOST_WINDOWS = 64, 16, 16, 10_000
MOST_RAYS, MOST_RINGS, MOST_POLYGONS, MOST_CORNERS = 256, 64, 64, 1024
MOST_KEYS = 64
Windows = Annotated[int, Limit(ge=1, le=MOST_WINDOWS)]
Name = Annotated[str, Limit(max_length=80)]
Share = Annotated[float, Limit(gt=0, lt=1)]
MatchKey = Literal["TELESCOP", "INSTRUME", "DETECTOR", "FILTER", "EC_FW1_", "EC_FW2_", "WAVELNTH", "CDELT1"]
_NUMBERS = ("WAVELNTH", "CDELT1")


class GainMode(Checked):
    """Saturation and noise of one readout mode. ``basis``: the origin of the numbers."""

    saturation_dn: Positive | None = None
    photon_gain_dn: Positive | None = None
    read_noise_dn: Positive | None = None
    basis: Literal["published", "measured", "assumed"]


class Detector(Checked):
    """The sensor. The keys of ``gain_modes`` are the values of the header keyword GAINCOMB."""

    pixel_pitch_um: Size
    pixels: Count
    readout_pixels: Count
    plate_scale_arcsec: Size
    gain_modes: Annotated[dict[Name, GainMode], Limit(max_length=MOST_KEYS)] = field(default_factory=dict)


class Aperture(Checked):
    """The entrance pupil: a disc, or a ring where the centre is obscured."""

    diameter_mm: Size
    obscuration_diameter_mm: SizeOrNone = 0.0

    def check(self) -> str | None:
        """The obscuration must be smaller than the aperture."""
        if self.obscuration_diameter_mm < self.diameter_mm:
            return None
        return (
            f"expected obscuration_diameter_mm less than diameter_mm ({self.diameter_mm}); "
            f"got {self.obscuration_diameter_mm}"
        )


class SpectralLine(Checked):
    """A spectral line of the bandpass and its share of the light; the shares are normalised to sum 1."""

    wavelength_angstrom: Size
    weight: Size


class Mirror(Checked):
    """A conic mirror. Its sag is r^2 / (R (1 + sqrt(1 - (1 + K) r^2 / R^2)))."""

    name: Name
    radius_mm: Size
    conic: Number
    diameter_mm: Size
    figure: Literal["concave", "convex"]


class Distances(Checked):
    """Distances along the optical path, as the drawings give them."""

    aperture_to_primary_mm: Size
    primary_to_secondary_mm: Size
    secondary_to_filter_wheel_mm: Size
    filter_wheel_to_detector_mm: Size


class Mesh(Checked):
    """A square mesh that supports a filter.

    ``windows``: number of windows of the diffraction series in each direction. At the entrance, this is the diameter of
    the aperture divided by the pitch; at the filter wheel, the number of windows that the light crosses.
    ``share``: the fraction of the light that crosses this mesh, if several meshes are mounted side by side.
    """

    name: Name
    place: Literal["entrance", "filter_wheel"]
    pitch_um: Size
    wire_um: Size
    windows: Windows
    angle_deg: Number = 0.0
    share: Annotated[float, Limit(gt=0, le=1)] = 1.0

    def check(self) -> str | None:
        """The wires must be thinner than the pitch."""
        if self.wire_um < self.pitch_um:
            return None
        return f"expected wire_um less than pitch_um ({self.pitch_um}); got {self.wire_um}"


class Rays(Checked):
    """Straight bars from the hub (or the centre) to the rim, at equal angles."""

    count: Annotated[int, Limit(ge=1, le=MOST_RAYS)]
    width_mm: Size
    first_angle_deg: Number = 0.0


class Ring(Checked):
    """A circular bar; ``radius_mm`` is the radius of its centre line."""

    radius_mm: Size
    width_mm: Size


class Polygon(Checked):
    """An opaque polygon with corners (x, y) in mm from the centre of the aperture."""

    corners_mm: Annotated[tuple[tuple[Place, Place], ...], Limit(min_length=3, max_length=MOST_CORNERS)]


class MaskImage(Checked):
    """A mask as a FITS or PNG image centred on the aperture: 0 is opaque, the largest value is open.

    ``file`` is the name of a file in the folder of the instrument file.
    """

    file: Annotated[str, Limit(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*\.(png|fits|fits\.gz)$")]
    width_mm: Size


class Mount(Checked):
    """The mount of the entrance filter. ``basis``: the origin of its description."""

    basis: Literal["drawing", "assumed"]
    rays: Annotated[tuple[Rays, ...], Limit(max_length=MOST_RAYS)] = ()
    rings: Annotated[tuple[Ring, ...], Limit(max_length=MOST_RINGS)] = ()
    hub_diameter_mm: SizeOrNone = 0.0
    polygons: Annotated[tuple[Polygon, ...], Limit(max_length=MOST_POLYGONS)] = ()
    mask_image: MaskImage | None = None

    def check(self) -> str | None:
        """The total number of rays, and of corners of polygons, is limited."""
        for most, got, parts in (
            (MOST_RAYS, self.ray_count, "rays"),
            (MOST_CORNERS, self.corner_count, "corners of polygons"),
        ):
            if got > most:
                return f"expected at most {most} {parts} in all; got {got}"
        return None

    @property
    def ray_count(self) -> int:
        """Number of rays of all groups."""
        return sum(rays.count for rays in self.rays)

    @property
    def corner_count(self) -> int:
        """Number of corners of all polygons."""
        return sum(len(polygon.corners_mm) for polygon in self.polygons)


class Scatter(Checked):
    """The softened power law a / (b + r)^c; ``total`` is its sum over r > 0 on the full reach."""

    b_px: Positive
    c: Positive
    total: Share
    basis: Literal["published", "fitted", "inferred"]


class Instrument(Checked):
    """An instrument: all quantities from which a PSF is computed.

    ``turn_deg``: the angle from the +x axis of the detector to that of the images, degrees. The angles and corners of a read
    instrument are those on the images.
    """

    name: Annotated[str, Limit(pattern=r"^[a-z][a-z0-9_]{0,39}$")]
    version: Annotated[str, Limit(pattern=r"^\d+\.\d+\.\d+$")]
    status: Literal["draft", "released"]
    wavelength_angstrom: Size
    bandpass: Annotated[tuple[SpectralLine, ...], Limit(max_length=MOST_LINES)] = ()
    focal_length_mm: Size
    turn_deg: Number = 0.0
    match: dict[MatchKey, Name | Size] = field(default_factory=dict)
    aperture: Aperture
    mirrors: Annotated[tuple[Mirror, ...], Limit(max_length=MOST_MIRRORS)] = ()
    distances: Distances | None = None
    meshes: Annotated[tuple[Mesh, ...], Limit(max_length=MOST_MESHES)] = ()
    mount: Mount | None = None
    detector: Detector
    scatter: Scatter | None = None

    def check(self) -> None:
        """Check that WAVELNTH and CDELT1 of the table [match] are numbers and its other keys are texts.

        Check also that no spectral line is so weak that its weight cannot be normalised.
        """
        wrong = [
            Fault(("match", key), f"expected {'a number' if key in _NUMBERS else 'a text'}", value)
            for key, value in self.match.items()
            if isinstance(value, str) == (key in _NUMBERS)
        ]
        total = sum(line.weight for line in self.bandpass)
        wrong += [
            Fault(
                ("bandpass", k, "weight"),
                f"expected at least {_LEAST:g} of the sum of all weights",
                line.weight,
            )
            for k, line in enumerate(self.bandpass)
            if line.weight < _LEAST * total
        ]
        if self.turn_deg and self.mount is not None and self.mount.mask_image is not None:
            wrong.append(
                Fault(("turn_deg",), "expected 0, because a mask image is not turned", self.turn_deg)
            )
        if wrong:
            raise BadValues(wrong)

    def on_images(self) -> Instrument:
        """The instrument as images that are turned by ``turn_deg`` show it: a direction on them is smaller by this angle."""
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
        return replace(self, meshes=meshes, mount=mount)

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
                f"{self.name}: distances: expected this table, because mesh {mesh.name!r} is at the filter wheel; got none",
            )
        return self.distances.filter_wheel_to_detector_mm


def _turned(corners: tuple[tuple[float, float], ...], angle_deg: float) -> tuple[tuple[float, float], ...]:
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return tuple((cosine * x - sine * y, sine * x + cosine * y) for x, y in corners)


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Read an instrument by its name, or from a TOML file given as a Path or as a string that ends in .toml.

    Raises DataError "unknown-instrument" or "bad-instrument-file" (one line that names the key).
    """
    is_file = isinstance(name_or_path, Path) or name_or_path.endswith(".toml")
    path = Path(name_or_path) if is_file else instrument_path(str(name_or_path))
    return parse_instrument(read_instrument_text(path), path.name)


def read_instrument_text(path: Path) -> str:
    """Read an instrument file, but at most one character more than the limit, so that `parse_instrument` can refuse it.

    Raises DataError "bad-instrument-file".
    """
    try:
        with path.open("rb") as file:
            return file.read(MOST_BYTES + 1).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise DataError("bad-instrument-file", f"{path.name}: expected TOML in UTF-8; {reason}") from None


def parse_instrument(text: str, label: str) -> Instrument:
    """Read an instrument from the text of its TOML file; ``label`` names the file in errors.

    Raises DataError "bad-instrument-file": one line with the key, the expected and the given value.
    """
    if len(text) > MOST_BYTES:
        raise DataError("bad-instrument-file", f"{label}: expected at most {MOST_BYTES} characters; got more")
    try:
        return Instrument.read(_parse_toml(text)).on_images()
    except BadValues as error:
        raise DataError("bad-instrument-file", f"{label}: {_said(error)}") from None
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        # An integer of thousands of digits raises ValueError; deeply nested lists raise RecursionError.
        deep = isinstance(error, RecursionError)
        reason = "too many levels of nesting" if deep else " ".join(str(error).split())
        raise DataError("bad-instrument-file", f"{label}: expected TOML; {reason:.200}") from None


def _said(error: BadValues) -> str:
    """The first fault in one line, and how many further faults there are."""
    first, more = error.faults[0], len(error.faults) - 1
    key = ".".join(map(str, first.key)) or "file"
    # If the fault concerns a whole table, its text already says what was given. A missing key has no value.
    if "; got " in first.expected:
        got = ""
    elif first.got is None:
        got = "; got none"
    else:
        got = f"; got {first.got!r:.80}"
    return f"{key}: {first.expected}{got}" + (f" (and {more} more)" if more else "")


def _parse_toml(text: str) -> dict[str, Any]:
    # The parser's time grows with the square of a dotted key's length: 64 kB of "a.a.a" would take half a minute.
    for stretch in re.split(r"[^\w\"'. \t-]", text):
        if stretch.count(".") > _MOST_DOTS:
            raise ValueError(f"a key may have at most {_MOST_DOTS} parts; got {stretch.strip()[:40]!r} ...")
    return tomllib.loads(text)
