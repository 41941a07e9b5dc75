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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.images import CardValue, read_plane, write_plane
from psfcore.simulate.headers import HRI_EUV, Imitated, commented
from psfcore.simulate.plan import HIGH, Plan, plan_from_json
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.sky import TrueSky, true_sky
from psfcore.simulate.transit import SimulatedTransit
from psfcore.transit.transit import Place

Plane = NDArray[np.float64]
SCHEMA = "transit/1"
TRUTH_FILE = "truth.json"
DIFFRACTION_FILE = "diffraction.fits"

_LARGEST_PX = 16384


def write(simulated: SimulatedTransit, folder: str | Path) -> None:
    """Write a simulated transit into `folder`. The folder is created if needed; existing files are replaced."""
    folder, plan, imitated = Path(folder), simulated.plan, simulated.imitated
    frames = simulated.transit.frames
    seen = [frame.pixels.astype(np.float64) * frame.exposure_s for frame in frames]
    exposures = [np.rint(dn).astype(np.int32) for dn in seen] if plan.whole_dn else seen
    places = [frame.place for frame in frames]
    write_observation(folder, plan, exposures, places, simulated.sky.diffraction, imitated)
    for name in ("noise_free", "scenes"):
        (folder / name).mkdir(exist_ok=True)
    for index, frame in enumerate(frames):
        cards = commented(imitated.shot_values(plan.shots[index], "DN/s"))
        write_plane(folder / "noise_free" / frame.file, simulated.sky.expected(index), cards=cards)
    for pointing, scene in simulated.sky.scenes.items():
        about: dict[str, CardValue] = {"BUNIT": "DN/s", "FOV": pointing, "MARGIN": plan.margin_px}
        cards = commented(imitated.values() | about)
        write_plane(folder / "scenes" / f"fov{pointing}.fits", scene, cards=cards)
    _write_json(folder / TRUTH_FILE, simulated.truth.as_json() | {"plan": plan.as_json()})


def write_observation(
    folder: Path,
    plan: Plan,
    exposures: Sequence[NDArray[Any]],
    places: Sequence[Place],
    diffraction: Plane,
    imitated: Imitated = HRI_EUV,
) -> None:
    """Write the files that a real transit also has: images, diffraction PSF and transit.json.

    exposures: [y, x] in DN, in the order of the plan. places: the reported positions of the occulter.
    """
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for n, (dn, shot, place) in enumerate(zip(exposures, plan.shots, places, strict=True)):
        values, file, level = imitated.shot_values(shot, "DN"), f"{n:03d}.fits", plan.saturation_dn
        if level is not None and shot.gain_mode == HIGH:
            values["SATURATE"] = float(np.rint(level)) if plan.whole_dn else level
        write_plane(folder / file, dn, cards=commented(values))
        at = {"x": place.x_px, "y": place.y_px, "r": place.radius_px}
        entries.append({"file": file, "fov": shot.pointing, **at})
    # PSFSUM says that the file is a PSF, see `content_of`; otherwise it would be deconvolved like an image of the folder.
    is_psf: dict[str, CardValue] = {"PSFSUM": float(diffraction.sum())}
    write_plane(folder / DIFFRACTION_FILE, diffraction, cards=commented(imitated.values() | is_psf))
    content = {
        "schema": SCHEMA,
        "instrument": imitated.name,
        "known_psf": DIFFRACTION_FILE,
        "noise": {"photon_gain_dn": plan.noise.photon_gain_dn, "read_noise_dn": plan.noise.read_noise_dn},
        "images": entries,
    }
    _write_json(folder / "transit.json", content)


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


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
