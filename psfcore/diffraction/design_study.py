"""How the pitch and the wire width of an entrance mesh change the PSF.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Analytical solution for mesh diffraction" and
"Mesh geometry": a larger pitch brings the orders closer together, so that the diffracted light blurs the image
instead of veiling it. A smaller pitch spreads the orders: they veil the image, but the orders of a flare can be
distinguished. With f = 1 - wire / pitch:

    share of the light in the order (k, 0) = f^2 sinc^2(pi k f)                                      Eq. (1)
    share outside the order (0, 0) = 1 - f^2                                                         Eq. (2)

The light beyond a radius (1 - encircled energy) is computed from the pattern of mesh_series. This pattern is for a
square pupil as wide as the aperture, without mount, filter wheel or scatter. The pattern is normalised to the light on
the full reach.

| symbol | name | unit |
|---|---|---|
| d | pitch_um | um |
| - | wire_um | um |
| N | windows: diameter of the aperture divided by the pitch | - |
| lambda f / d | spacing_px | px |
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.diffraction.mesh_series import mesh_line, order_spacing_px
from psfcore.errors import DataError
from psfcore.instruments.model import Instrument
from psfcore.psf import REACH_GRID_PX, cumulative_curve
from psfcore.scatter.power_law import described_kernel

NEAR_PX = 10.0
FAR_PX = 100.0
FLARE_PX = 5  # the flare whose orders are looked at, px per side
MOST_MESHES = 400
_COMPARED_PX = (50.0, 150.0)  # orders at these radii are compared with the scatter


@dataclass(frozen=True)
class MeshDesign:
    """One mesh: its geometry, and its effect in percent of all transmitted light.

    Attributes
    ----------
    peak_visibility
        The contrast (high - low) / (high + low) of the orders along the axis, for a flare of FLARE_PX px per side. It
        is 1 if the orders are separate, and 0 if they merge.
    peak_over_scatter
        The light of an order in a pixel, divided by the diffuse scatter of the same flare in this pixel; the largest
        value for the orders on the axis from 50 to 150 px. None if the instrument has no scatter.
    """

    pitch_um: float
    wire_um: float
    windows: int
    spacing_px: float
    transmitted_pct: float
    diffracted_pct: float
    beyond_10_px_pct: float
    beyond_100_px_pct: float
    peak_visibility: float
    peak_over_scatter: float | None


@dataclass(frozen=True)
class DesignStudy:
    """The computed meshes, sorted by wire width and then by pitch; and the mesh of the instrument itself ("flown"; None
    if the instrument has no mesh).
    """

    instrument: str
    flare_px: int
    rows: tuple[MeshDesign, ...]
    flown: MeshDesign | None

    def as_json(self) -> str:
        """The study as JSON; the keys are the names of the fields."""
        return json.dumps(asdict(self), indent=1)


def design_study(
    instrument: Instrument, pitches_um: Iterable[float], wires_um: Iterable[float]
) -> DesignStudy:
    """Compute every combination of pitch and wire at the entrance of `instrument`, and also the first square entrance
    mesh of the instrument.

    Raises DataError "bad-design" for no mesh or more than 400 meshes, and for a wire that is not narrower than every
    pitch.
    """
    pitches, wires = sorted(set(pitches_um)), sorted(set(wires_um))
    _check(pitches, wires)
    halo = None
    if instrument.scatter is not None:
        kernel = described_kernel(instrument.scatter, REACH_GRID_PX)
        halo = kernel[REACH_GRID_PX // 2, REACH_GRID_PX // 2 :]
    rows = [_mesh(instrument, pitch, wire, halo) for wire in wires for pitch in pitches]
    square = [mesh for mesh in instrument.meshes if mesh.openings == "square"]
    own = next((mesh for mesh in square if mesh.place == "entrance"), None)
    flown = None if own is None else _mesh(instrument, own.pitch_um, own.wire_um, halo)
    return DesignStudy(instrument.name, FLARE_PX, tuple(rows), flown)


def _check(pitches: Sequence[float], wires: Sequence[float]) -> None:
    number = len(pitches) * len(wires)
    if not 1 <= number <= MOST_MESHES:
        raise DataError(
            "bad-design", f"expected 1 to {MOST_MESHES} meshes (pitches times wires); got {number}"
        )
    if not (wires[0] > 0 and np.isfinite(pitches).all() and wires[-1] < pitches[0]):
        raise DataError(
            "bad-design",
            f"expected finite pitches and wires with 0 < wire < pitch (um); got wires {wires} and pitches {pitches}",
        )


def _mesh(
    instrument: Instrument, pitch_um: float, wire_um: float, halo: NDArray[np.float64] | None
) -> MeshDesign:
    windows = max(1, round(instrument.aperture.diameter_mm * 1e3 / pitch_um))
    spacing = order_spacing_px(
        wavelength_angstrom=instrument.wavelength_angstrom,
        distance_mm=instrument.focal_length_mm,
        pitch_um=pitch_um,
        pixel_pitch_um=instrument.detector.pixel_pitch_um,
    )
    line = mesh_line(spacing, pitch_um=pitch_um, wire_um=wire_um, windows=windows, size=REACH_GRID_PX)
    beyond = cumulative_curve(np.outer(line, line), [NEAR_PX, FAR_PX])
    open_share = 1 - wire_um / pitch_um
    return MeshDesign(
        pitch_um=float(pitch_um),
        wire_um=float(wire_um),
        windows=windows,
        spacing_px=spacing,
        transmitted_pct=100 * open_share**2,
        diffracted_pct=100 * (1 - open_share**2),  # Eq. (2)
        beyond_10_px_pct=float(beyond[0]),
        beyond_100_px_pct=float(beyond[1]),
        peak_visibility=_contrast(spacing),
        peak_over_scatter=None if halo is None else _over_scatter(open_share, spacing, halo),
    )


def _contrast(spacing_px: float) -> float:
    """`peak_visibility` of MeshDesign: the contrast along the axis of the orders of a flare, as pixels record it.

    Each order is the box of the flare convolved with a pixel, a trapezium. All orders are assumed to be equally bright.
    """
    x = np.linspace(0.0, spacing_px, 401)
    neighbours = int(np.ceil((FLARE_PX + 1) / spacing_px)) + 1
    orders = spacing_px * np.arange(-neighbours, neighbours + 2)
    apart = np.abs(x[:, None] - orders)
    light = np.clip((FLARE_PX + 1) / 2 - apart, 0.0, 1.0).sum(axis=1)
    return float((light.max() - light.min()) / (light.max() + light.min()))


def _over_scatter(open_share: float, spacing_px: float, halo: NDArray[np.float64]) -> float:
    """`peak_over_scatter` of MeshDesign; 0 if no order lies at 50 to 150 px."""
    k = np.arange(np.ceil(_COMPARED_PX[0] / spacing_px), np.floor(_COMPARED_PX[1] / spacing_px) + 1)
    share = open_share**2 * np.sinc(k * open_share) ** 2  # Eq. (1)
    under = halo[np.rint(k * spacing_px).astype(int)]
    # The light of an order spreads over as many pixels as the flare has. In these pixels the scatter is nearly
    # constant.
    return float((share / FLARE_PX**2 / under).max(initial=0.0))
