"""A simulated transit as a folder: the files of a real transit, and files with the true values.

| file | content |
|---|---|
| NNN.fits | images, whole DN |
| diffraction.fits | diffraction PSF |
| transit.json | the description that a real transit also has |
| noise_free/NNN.fits | images without noise, DN/s |
| scenes/fovN.fits | scene of each pointing without the occulter, with margins, DN/s |
| truth.json | PSF, exact positions, seeds, plan |
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.images import Cards, CardValue, read_plane, write_plane
from psfcore.simulate.headers import commented
from psfcore.simulate.plan import HIGH, plan_from_json
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.sky import TrueSky, true_sky
from psfcore.simulate.transit import SimulatedTransit

SCHEMA = "transit/1"
TRUTH_FILE = "truth.json"
DIFFRACTION_FILE = "diffraction.fits"

_LARGEST_PX = 16384


def write(simulated: SimulatedTransit, folder: str | Path) -> None:
    """Write a simulated transit into `folder`. The folder is created if needed; existing files are replaced."""
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
    of_instrument = simulated.imitated.values()
    for pointing, scene in simulated.sky.scenes.items():
        about: dict[str, CardValue] = {"BUNIT": "DN/s", "FOV": pointing, "MARGIN": simulated.plan.margin_px}
        write_plane(folder / "scenes" / f"fov{pointing}.fits", scene, cards=commented(of_instrument | about))
    diffraction = simulated.sky.diffraction
    # PSFSUM says that the file is a PSF, see `content_of`; otherwise it would be deconvolved like an image of the folder.
    is_psf: dict[str, CardValue] = {"PSFSUM": float(diffraction.sum())}
    write_plane(folder / DIFFRACTION_FILE, diffraction, cards=commented(of_instrument | is_psf))
    _write_json(folder / "transit.json", _transit_json(simulated))
    _write_json(folder / TRUTH_FILE, simulated.truth.as_json() | {"plan": simulated.plan.as_json()})


def read_sky(folder: str | Path, *, threads: int = 1) -> TrueSky:
    """The sky of a folder that `write` wrote.

    The folder's scenes are stored on detector pixels. The light is therefore uniform within a pixel, even where the
    original scene had finer pixels. Raises DataError "not-simulated" if truth.json is missing or invalid, and the
    errors of reading FITS files.
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
            "not-simulated", f"expected a file {wanted}; got {type(error).__name__}: {error!s:.120}"
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
    values = simulated.imitated.shot_values(shot, unit)
    level = simulated.plan.saturation_dn
    if level is not None and shot.gain_mode == HIGH and unit == "DN":
        values["SATURATE"] = float(np.rint(level)) if simulated.plan.whole_dn else level
    return commented(values)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
