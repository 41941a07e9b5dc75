"""A simulated transit as a folder, in the format of a real one, with its truth beside it.

NNN.fits            images, whole DN      noise_free/NNN.fits  the same without noise, DN/s
diffraction.fits    known part of the PSF scenes/fovN.fits     scenes without occulter, DN/s, margins included
transit.json        what a real one has   truth.json           PSF, exact places, seeds, the plan
"""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from psfcore.errors import DataError
from psfcore.fits.fits_io import Cards, CardValue, read_plane, write_plane
from psfcore.fits.header import FitsLimits
from psfcore.simulate.plan import HIGH, Shot, plan_from_json
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.sky import TrueSky, true_sky
from psfcore.simulate.transit import PLATE_SCALE_ARCSEC, SimulatedTransit

SCHEMA = "transit/1"
TRUTH_FILE = "truth.json"
DIFFRACTION_FILE = "diffraction.fits"

_START = datetime(2023, 1, 3, 3, 42)
_LARGEST_PX = 16384


def write(simulated: SimulatedTransit, folder: str | Path) -> None:
    """Write a simulated transit into `folder`, which is made where there is none; files there are replaced."""
    folder = Path(folder)
    for name in (".", "noise_free", "scenes"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for index, frame in enumerate(simulated.transit.frames):
        seen = frame.pixels.astype(np.float64) * frame.exposure_s
        dn = np.rint(seen).astype(np.int32) if simulated.plan.whole_dn else seen
        write_plane(folder / frame.file, dn, cards=_frame_cards(simulated, index, "DN"))
        noise_free = simulated.sky.expected(index)
        cards = _frame_cards(simulated, index, "DN/s")
        write_plane(folder / "noise_free" / frame.file, noise_free, cards=cards)
    for pointing, scene in simulated.scenes.items():
        about: dict[str, CardValue] = {"BUNIT": "DN/s", "FOV": pointing, "MARGIN": simulated.plan.margin_px}
        write_plane(
            folder / "scenes" / f"fov{pointing}.fits", scene, cards=_cards(instrument_values() | about)
        )
    write_plane(folder / DIFFRACTION_FILE, simulated.sky.diffraction, cards=_cards(instrument_values()))
    _write_json(folder / "transit.json", _transit_json(simulated))
    _write_json(folder / TRUTH_FILE, simulated.truth.as_json() | {"plan": simulated.plan.as_json()})


def read_sky(folder: str | Path, *, threads: int = 1) -> TrueSky:
    """The sky of a folder that `write` wrote; scenes on detector pixels, so that a pixel's light counts as even.

    Raises DataError "not-simulated" where the truth is not there, and what FITS files may raise.
    """
    folder = Path(folder)
    try:
        content = json.loads((folder / TRUTH_FILE).read_text())
        psf, plan_json = content["psf"], content["plan"] | {"oversampling": 1}
        names = ("c", "total", "stretch", "angle_deg", "dipole")
        scatter = ScatterTruth(b_px=psf["b"], **{name: psf[name] for name in names})
        seed = int(content["scene_seed"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        if isinstance(error, DataError):
            raise
        wanted = f"{TRUTH_FILE} in {folder.name}, as `heliopsf simulate transit` writes it"
        raise DataError(
            "not-simulated", f"expected {wanted}; got {type(error).__name__}: {error!s:.120}"
        ) from None
    plan = plan_from_json(plan_json)
    limits = FitsLimits(max_pixels=_LARGEST_PX**2)
    scenes = {
        pointing: read_plane(folder / "scenes" / f"fov{pointing}.fits", limits) for pointing in plan.pointings
    }
    diffraction = read_plane(folder / DIFFRACTION_FILE, limits)
    return true_sky(plan, scatter, diffraction, seed, scenes=scenes, threads=threads)


def _transit_json(simulated: SimulatedTransit) -> dict[str, Any]:
    transit, noise = simulated.transit, simulated.plan.noise
    images = [
        {
            "file": frame.file,
            "fov": frame.pointing,
            "x": frame.place.x_px,
            "y": frame.place.y_px,
            "r": frame.place.radius_px,
        }
        for frame in transit.frames
    ]
    return {
        "schema": SCHEMA,
        "instrument": transit.instrument,
        "known_psf": DIFFRACTION_FILE,
        "noise": {"photon_gain_dn": noise.photon_gain_dn, "read_noise_dn": noise.read_noise_dn},
        "images": images,
    }


def _frame_cards(simulated: SimulatedTransit, index: int, unit: str) -> Cards:
    shot = simulated.plan.shots[index]
    values = shot_values(shot, unit)
    level = simulated.plan.saturation_dn
    if level is not None and shot.gain_mode == HIGH and unit == "DN":
        values["SATURATE"] = float(np.rint(level)) if simulated.plan.whole_dn else level
    return _cards(values)


def shot_values(shot: Shot, unit: str) -> dict[str, CardValue]:
    """What the header of a simulated image says of how it was taken."""
    begin = (_START + timedelta(seconds=shot.time_s)).isoformat(timespec="milliseconds")
    return instrument_values() | {
        "DATE-BEG": begin,
        "XPOSURE": shot.exposure_s,
        "GAINCOMB": shot.gain_mode,
        "BUNIT": unit,
    }


def instrument_values() -> dict[str, CardValue]:
    """What every header says of the instrument that is imitated."""
    return {
        "ORIGIN": "SIMULATED by heliopsf",
        "TELESCOP": "SOLO/EUI/HRI_EUV",
        "INSTRUME": "EUI",
        "DETECTOR": "HRI_EUV",
        "WAVELNTH": 174,
        "CDELT1": PLATE_SCALE_ARCSEC,
        "CDELT2": PLATE_SCALE_ARCSEC,
    }


_COMMENTS = {
    "ORIGIN": "not an observation",
    "TELESCOP": "telescope imitated",
    "INSTRUME": "instrument imitated",
    "DETECTOR": "detector imitated",
    "WAVELNTH": "[Angstrom] wavelength",
    "CDELT1": "[arcsec] pixel scale along axis 1",
    "CDELT2": "[arcsec] pixel scale along axis 2",
    "DATE-BEG": "[UTC] start of exposure, made up",
    "XPOSURE": "[s] exposure time",
    "GAINCOMB": "gain mode imitated",
    "BUNIT": "unit of the pixels",
    "SATURATE": "[DN] level at which pixels clip",
    "FOV": "pointing",
    "MARGIN": "[pixel] beyond the field on each side",
}


def _cards(values: dict[str, CardValue]) -> dict[str, tuple[CardValue, str]]:
    return {key: (value, _COMMENTS[key]) for key, value in values.items()}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
