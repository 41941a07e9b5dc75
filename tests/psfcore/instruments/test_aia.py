"""The meshes of the seven AIA files have the arms and orders that Grigis et al. (2012) measured."""

from __future__ import annotations

import pytest

from psfcore.diffraction.mesh_series import order_spacing_px
from psfcore.instruments.model import Mesh, load_instrument

# Table 2 of Grigis et al., AIA PSF characterization and deconvolution, as aiapy's filter_mesh_parameters gives it.
# Channel: angles of the four arms (degrees), spacing of the entrance mesh and of the focal-plane mesh (px).
MEASURED = {
    94: ((49.81, 40.16, -40.28, -49.92), 8.99, 0.207),
    131: ((50.27, 40.17, -39.70, -49.95), 12.37, 0.289),
    171: ((49.81, 39.57, -40.13, -50.38), 16.26, 0.377),
    193: ((49.82, 39.57, -40.12, -50.37), 18.39, 0.425),
    211: ((49.78, 40.08, -40.34, -49.95), 19.97, 0.465),
    304: ((49.76, 40.18, -40.14, -49.90), 28.87, 0.670),
    335: ((50.40, 39.80, -39.64, -50.25), 31.83, 0.738),
}


def spacing_px(channel: int, mesh: Mesh) -> float:
    aia = load_instrument(f"aia_{channel}")
    return order_spacing_px(
        wavelength_angstrom=aia.wavelength_angstrom,
        distance_mm=aia.mesh_distance_mm(mesh),
        pitch_um=mesh.pitch_um,
        pixel_pitch_um=aia.detector.pixel_pitch_um,
    )


def test_the_meshes_have_the_measured_arms_and_orders() -> None:
    """A square mesh has two arms, 90 degrees apart. The measured spacing gives a pitch within 1 % of the nominal one."""
    for channel, (arms_deg, entrance_px, focal_px) in MEASURED.items():
        *entrance, focal = meshes = load_instrument(f"aia_{channel}").meshes
        assert all(mesh.place == "entrance" for mesh in entrance), channel
        arms = sorted(angle for mesh in entrance for angle in (mesh.angle_deg, mesh.angle_deg - 90))
        assert arms == pytest.approx(sorted(arms_deg), abs=0.065), channel
        assert sum(mesh.share for mesh in entrance) == 1, channel
        assert [spacing_px(channel, mesh) for mesh in entrance] == pytest.approx([entrance_px] * 2, abs=0.005)
        assert spacing_px(channel, focal) == pytest.approx(focal_px, abs=0.001), channel
        assert (focal.place, focal.angle_deg) == ("filter_wheel", 45.0), channel
        for mesh in meshes:
            assert mesh.pitch_um == pytest.approx(25_400 / 70, rel=0.01) and mesh.wire_um == 34.0, channel
