"""The plan of a simulated transit: the occulter's position and the exposure of each image, and the errors.

The default plan follows Hofmeister et al., The point-spread function of HRI_EUV, section "The observations". There are
three pointings. In the first, the planet approaches the Sun's east limb. In the second, it crosses the solar disc. In
the third, it moves away from the west limb. While the planet is far from the limb, exposures last 5 s in combined gain.
Near the limb they last 0.9 s in high gain. In front of the solar disc they last 1.8 s in high gain.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from psfcore.errors import DataError
from psfcore.noise import Noise
from psfcore.transit.transit import Place

RADIUS_PX = 10.75
SMALLEST_SIZE_PX = 64
LARGEST_FINE_SIZE_PX = 1024  # the largest field that is simulated on half pixels by default
EAST, DISC, WEST = "east_limb", "disc", "west_limb"
VIEWS = (EAST, DISC, WEST)
DARK, ON = "dark", "on"
COMBINED, HIGH = "combined", "high-only"
CAMERA = Noise(photon_gain_dn=6.0, read_noise_dn=2.0)

# Up to this number of images, each pointing gets a third of them. More images are divided as in the paper.
_THIRDS_UP_TO = 60
_PAPER_LIMB_SHARE = 24 / 126
_PAPER_FAR_SHARE = 10 / 24
_MARGIN_PX = 6.0  # smallest distance between the edge of the occulter and the edge of the field
_MINUTE_S = 60.0
_KEYS = {"pointing": "fov"}  # names of Shot's fields that differ in truth.json


@dataclass(frozen=True)
class Shot:
    """One image: number of its pointing (from 1), exact centre of the occulter, exposure time, gain mode, start
    time.
    """

    pointing: int
    x_px: float
    y_px: float
    exposure_s: float
    gain_mode: str
    time_s: float


@dataclass(frozen=True)
class Plan:
    """Everything that determines a simulated transit except the PSF and the seed.

    Raises DataError "bad-plan".

    Attributes
    ----------
    views
        One of VIEWS for each pointing, in the order of their numbers.
    ephemeris_error_px
        Rms error of the reported position along each axis.
    saturation_dn
        Level at which high-only images clip; None: no saturation. Combined images do not saturate.
    brightness
        Factor by which the scenes are multiplied.
    oversampling
        Number of scene pixels in a detector pixel along each axis, 1 or 2.
    beyond
        "dark" if the scene ends at the edge of the field; "on" if the Sun continues for beyond_px on each side (None:
        half the field).
    """

    size_px: int
    shots: tuple[Shot, ...]
    views: tuple[str, ...] = VIEWS
    radius_px: float = RADIUS_PX
    ephemeris_error_px: float = 0.6
    noise: Noise = CAMERA
    saturation_dn: float | None = None
    dark_offset_dn: float = 0.0
    whole_dn: bool = True
    brightness: float = 1.0
    oversampling: int = 2
    beyond: str = DARK
    beyond_px: int | None = None

    def __post_init__(self) -> None:
        _expect(self.size_px >= SMALLEST_SIZE_PX, f"a field of {SMALLEST_SIZE_PX} px or more", self.size_px)
        _expect(len(self.shots) > 0, "at least one image", "none")
        _expect(self.oversampling in (1, 2), "an oversampling of 1 or 2", self.oversampling)
        _expect(self.beyond in (DARK, ON), f"beyond {DARK!r} or {ON!r}", self.beyond)
        _expect(self.beyond_px is None or self.beyond_px >= 0, "beyond_px >= 0", self.beyond_px)
        _expect(set(self.views) <= set(VIEWS), f"views of {VIEWS}", self.views)
        _expect(self.brightness > 0, "a brightness above 0", self.brightness)
        _expect(self.ephemeris_error_px >= 0, "an ephemeris error >= 0", self.ephemeris_error_px)
        level = self.saturation_dn
        _expect(level is None or level > 0, "a saturation level above 0 DN", level)
        _expect(np.isfinite(self.dark_offset_dn), "a finite dark offset", self.dark_offset_dn)
        for shot in self.shots:
            _expect(
                1 <= shot.pointing <= len(self.views), f"a pointing of 1 to {len(self.views)}", shot.pointing
            )
            _expect(shot.exposure_s > 0, "an exposure above 0 s", shot.exposure_s)
            low, high = self.radius_px, self.size_px - 1 - self.radius_px
            inside = low <= shot.x_px <= high and low <= shot.y_px <= high
            _expect(inside, "the whole occulter on the field", f"({shot.x_px:.1f}, {shot.y_px:.1f})")

    @property
    def margin_px(self) -> int:
        """How far the scene extends beyond the field on each side."""
        if self.beyond == DARK:
            return 0
        return self.size_px // 2 if self.beyond_px is None else self.beyond_px

    @property
    def pointings(self) -> tuple[int, ...]:
        """The pointings that have images."""
        return tuple(sorted({shot.pointing for shot in self.shots}))

    def place(self, index: int) -> Place:
        """The exact position and the radius of the occulter in an image."""
        return Place(self.shots[index].x_px, self.shots[index].y_px, self.radius_px)

    def as_json(self) -> dict[str, object]:
        """Plain values; plan_from_json reads them."""
        content = dataclasses.asdict(self)
        content["shots"] = [
            {_KEYS.get(key, key): value for key, value in shot.items()} for shot in content["shots"]
        ]
        return content


def plan_from_json(content: dict[str, Any]) -> Plan:
    """The plan that Plan.as_json wrote. Raises DataError "bad-plan"."""
    try:
        names = {key: name for name, key in _KEYS.items()}
        shots = tuple(
            Shot(**{names.get(key, key): value for key, value in shot.items()}) for shot in content["shots"]
        )
        fields = content | {
            "shots": shots,
            "noise": Noise(**content["noise"]),
            "views": tuple(content["views"]),
        }
        return Plan(**fields)
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(
            "bad-plan", f"expected a plan written by `heliopsf simulate transit`; got: {error}"
        ) from None


def default_plan(images: int = 30, size_px: int = 512, **changes: Any) -> Plan:
    """A transit like the one of the paper, with any number of images.

    Up to 60 images are divided equally between the pointings. More images are divided in the ratio of the paper: 24, 78
    and 24. In a limb pointing, the planet is far from the limb in 10 of 24 images (5 s, combined) and near it in the
    others (0.9 s, high-only). In front of the solar disc, all images are 1.8 s, high-only. A field larger than 1024 px
    is simulated with one scene pixel per detector pixel, a smaller one with two along each axis. changes: values for
    other fields of Plan. Raises DataError "bad-plan".
    """
    _expect(images >= 1, "at least one image", images)
    limb = images // 3 if images <= _THIRDS_UP_TO else round(images * _PAPER_LIMB_SHARE)
    far = int(np.ceil(limb * _PAPER_FAR_SHARE))
    counts = (far, limb - far, images - 2 * limb, limb - far, far)
    radius_px = changes.get("radius_px", RADIUS_PX)
    shots = [
        shot
        for phase, count in zip(_PHASES, counts, strict=True)
        for shot in _shots(phase, count, size_px, radius_px)
    ]
    return Plan(size_px, tuple(shots), **({"oversampling": drawn_oversampling(size_px)} | changes))


def drawn_oversampling(size_px: int) -> int:
    """The oversampling of a field of this size: 2, or 1 if the field is larger than 1024 px."""
    return 2 if size_px <= LARGEST_FINE_SIZE_PX else 1


@dataclass(frozen=True)
class _Track:
    """Where the occulter starts and ends in a pointing: (x, y) divided by the edge of the field.

    Attributes
    ----------
    start_min, end_min
        The times of both points, in minutes after 03:42 UT.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    start_min: float
    end_min: float


@dataclass(frozen=True)
class _Phase:
    """Consecutive images with the same pointing, exposure time and gain mode; times in minutes after 03:42 UT."""

    pointing: int
    start_min: float
    end_min: float
    exposure_s: float
    gain_mode: str


_TRACKS = (
    _Track((0.108, 0.361), (0.735, 0.428), 0.0, 53.0),
    _Track((0.104, 0.462), (0.896, 0.417), 62.0, 190.0),
    _Track((0.265, 0.571), (0.892, 0.648), 209.0, 261.0),
)
_PHASES = (
    _Phase(1, 0.0, 29.0, 5.0, COMBINED),
    _Phase(1, 31.0, 53.0, 0.9, HIGH),
    _Phase(2, 62.0, 190.0, 1.8, HIGH),
    _Phase(3, 209.0, 230.0, 0.9, HIGH),
    _Phase(3, 231.0, 261.0, 5.0, COMBINED),
)


def _shots(phase: _Phase, count: int, size_px: int, radius_px: float) -> list[Shot]:
    """Images at equal intervals. The planet moves uniformly along its track and stays clear of the field's edge."""
    if count == 1:
        times = np.array([(phase.start_min + phase.end_min) / 2])
    else:
        times = np.linspace(phase.start_min, phase.end_min, count)
    track = _TRACKS[phase.pointing - 1]
    low = radius_px + _MARGIN_PX
    _expect(2 * low < size_px - 1, f"a field of more than {2 * low + 1:.0f} px", size_px)
    start, end = (
        np.clip(np.multiply(at, size_px), low, size_px - 1 - low) for at in (track.start, track.end)
    )
    shots = []
    for minute in times:
        x, y = start + (end - start) * (minute - track.start_min) / (track.end_min - track.start_min)
        place = (float(x), float(y))
        shots.append(
            Shot(phase.pointing, *place, phase.exposure_s, phase.gain_mode, float(minute * _MINUTE_S))
        )
    return shots


def _expect(holds: bool | np.bool_, wanted: str, got: object) -> None:
    if not holds:
        raise DataError("bad-plan", f"expected {wanted}; got {got}")
