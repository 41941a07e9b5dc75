"""How the pixels of an image lie on the detector: plate scale, turns and flips, and whether they were interpolated.

World coordinates of a pixel at the offset p from the reference pixel (Greisen and Calabretta 2002, A&A 395, 1061;
Thompson 2006, A&A 449, 791):

    w = M p,   M_ij = CD_ij, or CDELT_i PC_ij, or CDELT_i R_ij(CROTA2)                    Eq. (1)

A PSF is known on the pixels of the detector. Let M_0 be the matrix of an image as the detector gives it: a turn by the
roll of the spacecraft, without a flip. Then the offset p on the image is, up to the plate scale, the offset T p on the
detector:

    T = M_0^-1 M,   both with columns of length 1                                        Eq. (2)

T is the unit matrix for an image as the detector gives it. The roll of M_0 is known where a card states it, although
the image was turned later: SAT_ROT + INST_ROT of AIA, CROTA of Solar Orbiter, SC_ROLL of STEREO. Other spacecraft keep
solar north near +y.

| symbol | name | unit |
|---|---|---|
| M | matrix | arcsec / px |
| T | on_detector | - |
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from psfcore.fits.cards import Cards, optional_number, optional_text

_ARCSEC_PER_UNIT = {"arcsec": 1.0, "arcmin": 60.0, "deg": 3600.0, "degree": 3600.0, "rad": 206264.80624709636}
# Turns below this angle are not mentioned. Where no card states the roll of the detector, pointing errors are allowed
# for.
FINEST_ARCSEC = 0.01  # per px; no image of the Sun is finer
SILENT_DEG = 0.3
SILENT_WITHOUT_ROLL_DEG = 1.0
_MAP_AXES = ("CRLN", "HGLN", "CRLT", "HGLT", "RA--", "DEC-")

Matrix = tuple[tuple[float, float], tuple[float, float]]
UNIT: Matrix = ((1.0, 0.0), (0.0, 1.0))


@dataclass(frozen=True)
class Frame:
    """How the pixels of an image lie on the detector.

    Attributes
    ----------
    scale_arcsec
        Plate scale along x and y, arcsec/px; None: unknown.
    on_detector
        The matrix T of Eq. (2).
    roll_known
        Whether a card states the roll of the detector.
    interpolated
        The reason why the pixels are not those of the detector; None: they are those of the detector.
    """

    scale_arcsec: tuple[float | None, float | None]
    on_detector: Matrix
    roll_known: bool
    interpolated: str | None

    @property
    def quarter_turns(self) -> Matrix | None:
        """The quarter turns and flips of the image, as T with the values -1, 0 and 1; None if it was turned by another
        angle.
        """
        limit = SILENT_DEG if self.roll_known else SILENT_WITHOUT_ROLL_DEG
        (a, b), (c, d) = self.on_detector
        nearest: Matrix = ((float(round(a)), float(round(b))), (float(round(c)), float(round(d))))
        far = max(abs(v - n) for v, n in zip((a, b, c, d), (*nearest[0], *nearest[1]), strict=True))
        return nearest if far <= math.sin(math.radians(limit)) else None

    @property
    def turn_deg(self) -> float:
        """The angle from the x axis of the detector to that of the image, -180 to 180 degrees, counted towards +y."""
        (a, _), (c, _) = self.on_detector
        return math.degrees(math.atan2(c, a))

    @property
    def turn_to_build_deg(self) -> float:
        """The turn (to 0.01 degrees) for which a PSF must be built; 0 if the PSF of the detector can be used, turned or
        as it is.
        """
        return 0.0 if self.flipped or self.quarter_turns is not None else round(self.turn_deg, 2)

    @property
    def flipped(self) -> bool:
        """Whether the image is a mirror image of the detector."""
        (a, b), (c, d) = self.on_detector
        return a * d - b * c < 0


def frame_of(header: Cards) -> Frame:
    """The frame that the cards of an image describe."""
    matrix = _matrix(header)
    units = [
        _ARCSEC_PER_UNIT.get(
            (optional_text(header, f"CUNIT{k}") or _unit_without_card(header, matrix)).lower()
        )
        for k in (1, 2)
    ]  # None: a unit that is no angle
    (a, b), (c, d) = (
        tuple(one * (unit or 1.0) for one in row) for row, unit in zip(matrix, units, strict=True)
    )
    x, y = math.hypot(a, c), math.hypot(b, d)
    scales = None if None in units or x == 0 else x, None if None in units or y == 0 else y
    if min(x, y) == 0:
        return Frame(scales, UNIT, roll_known=False, interpolated=_interpolated(header))
    roll = _detector_roll_deg(header)
    cosine, sine = math.cos(math.radians(roll or 0.0)), math.sin(math.radians(roll or 0.0))
    a, b, c, d = a / x, b / y, c / x, d / y
    return Frame(
        scales,
        # Eq. (2)
        ((cosine * a + sine * c, cosine * b + sine * d), (cosine * c - sine * a, cosine * d - sine * b)),
        roll is not None,
        _interpolated(header),
    )


def _unit_without_card(header: Cards, matrix: Matrix) -> str:
    """The unit of an axis without CUNIT: degrees if the axes are celestial (FITS standard, section 8.2), but many
    headers mean arcsec.
    """
    fine = max(abs(one) for row in matrix for one in row) < FINEST_ARCSEC
    return "deg" if fine and (optional_text(header, "CTYPE1") or "")[4:5] == "-" else "arcsec"


def plate_scale_arcsec(header: Cards, axis: int = 1) -> float | None:
    """Plate scale of an axis, arcsec/px; None if the header does not give it in a unit of angle.

    Parameters
    ----------
    axis
        Number of the axis: 1 for x, 2 for y.
    """
    return frame_of(header).scale_arcsec[axis - 1]


def _matrix(header: Cards) -> Matrix:
    """M of Eq. (1) in the units of the header; zeros if there are no such cards."""
    (a, b), (c, d) = [[optional_number(header, f"CD{i}_{j}") for j in (1, 2)] for i in (1, 2)]
    x, y = (optional_number(header, f"CDELT{i}") for i in (1, 2))
    if x is not None or y is not None:
        (a, b), (c, d) = _turn(header, x or 1.0, y or 1.0)
        return ((x or 0.0) * a, (x or 0.0) * b), ((y or 0.0) * c, (y or 0.0) * d)
    return (a or 0.0, b or 0.0), (c or 0.0, d or 0.0)


def _turn(header: Cards, step_x: float, step_y: float) -> Matrix:
    """PC_ij, or the turn by CROTA2 for pixels of different sides."""
    pc = [[optional_number(header, f"PC{i}_{j}") for j in (1, 2)] for i in (1, 2)]
    if any(value is not None for row in pc for value in row):
        (a, b), (c, d) = pc
        return (1.0 if a is None else a, b or 0.0), (c or 0.0, 1.0 if d is None else d)
    angle = math.radians(optional_number(header, "CROTA2", "CROTA1", "CROTA") or 0.0)
    sine, cosine = math.sin(angle), math.cos(angle)
    return (cosine, -sine * step_y / step_x), (sine * step_x / step_y, cosine)


def _detector_roll_deg(header: Cards) -> float | None:
    """The roll of an image as the detector gives it, if a card states it."""
    telescope = (optional_text(header, "TELESCOP") or "").upper()
    if telescope.startswith("SDO"):
        parts = [optional_number(header, key) for key in ("SAT_ROT", "INST_ROT")]
        return None if None in parts else sum(part or 0.0 for part in parts)
    if telescope.startswith("SOLO"):
        return optional_number(header, "CROTA")
    if (optional_text(header, "INSTRUME") or "").upper() == "SWAP":
        return optional_number(header, "P2_ROLL")
    if (optional_text(header, "DETECTOR") or "").upper() == "EUVI":
        return optional_number(header, "SC_ROLL")
    return None


def _interpolated(header: Cards) -> str | None:
    """Why the pixels of an image were interpolated, with the better input; None if no card says so."""
    telescope = (optional_text(header, "TELESCOP") or "").upper()
    level = optional_number(header, "LVL_NUM")
    if telescope.startswith("SDO") and level is not None and level >= 1.5:
        return f"level {level:g} is turned to solar north and interpolated: use the level 1 image"
    if (optional_text(header, "INSTRUME") or "").upper() == "SWAP" and optional_number(header, "LEVEL") == 1:
        return "level 1 of SWAP is turned to solar north and interpolated: use the level 0 image"
    axes = [(optional_text(header, f"CTYPE{axis}") or "").upper()[:4] for axis in (1, 2)]
    if any(axis in _MAP_AXES for axis in axes):
        return f"it was projected onto {axes[0].strip('-')}, {axes[1].strip('-')}: use the image before the projection"
    return None
