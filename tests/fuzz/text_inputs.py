"""Texts of transit.json and of instrument files, made from a seed: equal seeds give equal texts."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, 10**30, 1e308, -1e308, 1e-308, 0.5, float("nan"), float("inf"), "", "x"),
    *("transit/1", "../a.fits", "a/b", "C:x", "a\0b", "\u202e", "$\\frac{$", "a" * 300, [], {}, [[]], [{}], {"file": 1}),
)  # fmt: skip


def manifest(seed: int) -> bytes:
    """A transit.json with one to five faults."""
    rng = np.random.default_rng([3, seed])
    content: dict[str, Any] = {
        "schema": "transit/1",
        "instrument": "hri_euv",
        "known_psf": "diffraction.fits",
        "noise": {"photon_gain_dn": 6.0, "read_noise_dn": 2},
        "images": [
            {"file": f"{n:03d}.fits", "fov": int(rng.integers(4)), "x": 14.6, "y": 171.0, "r": 10.75}
            for n in range(int(rng.choice([0, 1, 3, 30, 2000, 2001], p=[0.1, 0.2, 0.5, 0.16, 0.02, 0.02])))
        ],
    }
    for _ in range(int(rng.integers(1, 6))):
        match int(rng.integers(6)):
            case 0 | 1:
                content[str(rng.choice([*content, "new", "images"]))] = _any(rng)
            case 2 | 3:
                images = content.get("images")
                if isinstance(images, list) and images and isinstance(images[0], dict):
                    image = images[int(rng.integers(len(images)))]
                    if isinstance(image, dict):
                        image[str(rng.choice(["file", "fov", "x", "y", "r", "other"]))] = _any(rng)
            case 4:
                content.pop(str(rng.choice(list(content) or ["x"])), None)
            case _:
                deep: Any = _any(rng)
                for _ in range(int(rng.choice([3, 50, 2000]))):
                    deep = [deep]
                content["deep"] = deep if rng.random() < 0.5 else [_any(rng)] * int(rng.choice([10, 200_000]))
    text = bytearray(_json(content))
    if rng.random() < 0.3:
        low = int(rng.integers(len(text)))
        text[low : low + int(rng.integers(3))] = rng.bytes(int(rng.integers(1, 6)))
    return bytes(text)


def _json(content: Any) -> bytes:
    try:
        return json.dumps(content).encode()
    except RecursionError:
        return b'{"deep": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"


def _any(rng: np.random.Generator) -> Any:
    return copy.deepcopy(VALUES[int(rng.integers(len(VALUES)))])  # a later fault may change it


def instrument(seed: int) -> bytes:
    """An instrument file: every key within the limits of its own, plausible or extreme; sometimes with a fault."""
    rng = np.random.default_rng([4, seed])
    wild = rng.random() < 0.3

    def size(usual: float) -> str:
        if wild and rng.random() < 0.3:
            return f"{float(10 ** rng.uniform(-9, 9)):.6e}"
        return f"{usual * 2 ** rng.uniform(-2, 2):.6e}"

    def angle() -> str:
        return str(rng.choice(["0.0", "45.0", "90", "49.84", "1e-9", "-1e300", "1e9"]))

    lines = [
        'name = "fuzz"', 'version = "1.0.0"', f'status = "{rng.choice(["draft", "released"])}"',
        f"wavelength_angstrom = {size(174)}", f"focal_length_mm = {size(4187)}",
        "[aperture]", f"diameter_mm = {size(47)}",
        f"obscuration_diameter_mm = {rng.choice(['0.0', size(10)])}",
        "[detector]", f"pixel_pitch_um = {size(10)}", "pixels = 512", "readout_pixels = 512",
        f"plate_scale_arcsec = {size(0.5)}",
    ]  # fmt: skip
    if rng.random() < 0.4:
        names = (
            "aperture_to_primary",
            "primary_to_secondary",
            "secondary_to_filter_wheel",
            "filter_wheel_to_detector",
        )
        lines += ["[distances]", *(f"{name}_mm = {size(500)}" for name in names)]
    for number in range(int(rng.choice([0, 0, 0, 1, 2, 3] + [16, 17] * wild))):
        lines += [
            "[[meshes]]", f'name = "m{number}"', f'place = "{rng.choice(["entrance", "filter_wheel"])}"',
            f"pitch_um = {size(400)}", f"wire_um = {size(30)}",
            f"windows = {rng.choice([1, 2, 13, 37, 551] + [9_999, 10_000, 10_001] * (rng.random() < 0.02))}",
            f"angle_deg = {angle()}", f"share = {rng.choice([1, 1, 0.5])}",
        ]  # fmt: skip
    if rng.random() < 0.5:
        lines += ["[mount]", 'basis = "assumed"', f"hub_diameter_mm = {rng.choice(['0.0', size(5)])}"]
        sets = [
            f"{{ count = {rng.choice([1, 3, 8, 255, 256, 257])}, width_mm = {size(0.5)}, first_angle_deg = {angle()} }}"
            for _ in range(int(rng.integers(3)))
        ]
        rings = [
            f"{{ radius_mm = {size(8)}, width_mm = {size(0.4)} }}"
            for _ in range(int(rng.choice([0, 1, 3, 64, 65])))
        ]
        corners = [
            f"{{ corners_mm = [{', '.join(_corner(rng, wild) for _ in range(int(rng.choice([2, 3, 4, 100, 1025]))))}] }}"
            for _ in range(int(rng.choice([0, 0, 1, 2])))
        ]
        lines += [
            f"rays = [{', '.join(sets)}]",
            f"rings = [{', '.join(rings)}]",
            f"polygons = [{', '.join(corners)}]",
        ]
    if rng.random() < 0.4:
        lines += [
            "[scatter]", f"b_px = {size(6)}", f"c = {size(2.5)}", f"total = {rng.choice([0.4, 1e-300, 0.999999])}",
            'basis = "fitted"',
        ]  # fmt: skip
    for _ in range(int(rng.choice([0, 0, 0, 2] + [64, 65] * (rng.random() < 0.05)))):
        lines += ["[[bandpass]]", f"wavelength_angstrom = {size(174)}", f"weight = {size(1)}"]
    text = bytearray("\n".join(lines).encode())
    if rng.random() < 0.2:
        low = int(rng.integers(len(text)))
        text[low : low + int(rng.integers(3))] = rng.bytes(int(rng.integers(1, 6)))
    return bytes(text)


def _corner(rng: np.random.Generator, wild: bool) -> str:
    reach = 1e9 if wild and rng.random() < 0.1 else 20.0
    return f"[{rng.uniform(-reach, reach):.6e}, {rng.uniform(-reach, reach):.6e}]"
