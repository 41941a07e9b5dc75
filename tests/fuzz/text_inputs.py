"""Texts of transit.json and of instrument files, made from a seed: equal seeds give equal texts."""

from __future__ import annotations

import copy
import json
import re
from typing import Any

import numpy as np

from psfcore.instruments.files import instrument_names, instrument_path

VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        2**31,
        2**63,
        10**30,
        1e308,
        -1e308,
        1e-308,
        0.5,
        float("nan"),
        float("inf"),
        "",
        "x",
    ),
    *(
        "transit/1",
        "../a.fits",
        "a/b",
        "C:x",
        "a\0b",
        "\u202e",
        "$\\frac{$",
        "a" * 300,
        [],
        {},
        [[]],
        [{}],
        {"file": 1},
    ),
)
NUMBERS = ("0", "-1", "1e-9", "1e9", "-1e300", "nan", "inf", "1", "2", "0.5", "255", "257", "9999", "10001")
# Tables and keys that no shipped instrument has, or not so many of.
TABLES = (
    "[[meshes]]\nname = 'm'\nplace = 'entrance'\npitch_um = 400.0\nwire_um = 30.0\nwindows = 37\nangle_deg = 49.84\n",
    "[[meshes]]\nname = 'w'\nplace = 'filter_wheel'\npitch_um = 400.0\nwire_um = 30.0\nwindows = 9\nshare = 0.5\n",
    "[[bandpass]]\nwavelength_angstrom = 171.0\nweight = 3.0\n",
    "[mount]\nbasis = 'assumed'\nhub_diameter_mm = 5.0\npolygons = [{ corners_mm = [[0, 1], [1, 0], [1, 1]] }]\n",
    "[scatter]\nb_px = 6.0\nc = 2.5\ntotal = 0.999999\nbasis = 'fitted'\n",
)


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
                image = (
                    images[int(rng.integers(len(images)))] if isinstance(images, list) and images else None
                )
                if isinstance(image, dict):
                    image[str(rng.choice(["file", "fov", "x", "y", "r", "other"]))] = _any(rng)
            case 4:
                content.pop(str(rng.choice(list(content) or ["x"])), None)
            case _:
                deep: Any = _any(rng)
                for _ in range(int(rng.choice([3, 50, 2000]))):
                    deep = [deep]
                content["deep"] = deep if rng.random() < 0.5 else [_any(rng)] * int(rng.choice([10, 200_000]))
    try:
        text = json.dumps(content)
    except RecursionError:
        text = '{"deep": ' + "[" * 100_000 + "]" * 100_000 + "}"
    return _with_junk(text, rng)


def instrument(seed: int) -> bytes:
    """A shipped instrument file with one to five faults: other numbers, lost and repeated lines, more tables."""
    rng = np.random.default_rng([4, seed])
    text = instrument_path(str(rng.choice(instrument_names()))).read_text("utf-8")
    for _ in range(int(rng.integers(1, 6))):
        lines = text.splitlines()
        match int(rng.integers(8)):
            case 0:
                del lines[int(rng.integers(len(lines)))]
                text = "\n".join(lines)
            case 1:
                lines.insert(int(rng.integers(len(lines))), str(rng.choice(lines)))
                text = "\n".join(lines)
            case 2 | 3:
                text += "\n" + str(rng.choice(TABLES)) * int(
                    rng.choice([1, 2, 17, 65], p=[0.7, 0.2, 0.05, 0.05])
                )
            case _:
                number = rng.choice(list(re.finditer(r"(?<== )-?\d[\d.e+-]*|(?<=\[)\d+(?=,)", text)))
                usual = f"{float(number[0]) * 2 ** rng.uniform(-2, 2):.6g}"
                value = str(rng.choice(NUMBERS)) if rng.random() < 0.3 else usual
                text = text[: number.start()] + value + text[number.end() :]
    return _with_junk(text, rng)


def _with_junk(text: str, rng: np.random.Generator) -> bytes:
    content = bytearray(text.encode())
    if rng.random() < 0.2:
        low = int(rng.integers(len(content)))
        content[low : low + int(rng.integers(3))] = rng.bytes(int(rng.integers(1, 6)))
    return bytes(content)


def _any(rng: np.random.Generator) -> Any:
    return copy.deepcopy(VALUES[int(rng.integers(len(VALUES)))])  # a later fault may change it
