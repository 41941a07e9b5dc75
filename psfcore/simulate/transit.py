"""A simulated transit: scenes convolved with a known PSF, with photon noise and read noise, in whole DN; and its
folder.

    D_i = round(min(g Poisson(I_i t / g) + read + dark, saturation)),  frame i = D_i / t     Eq. (1)

The plan (plan.py) gives the positions and exposures, and the sky (sky.py) gives the noise-free images. If whole_dn of
the plan is False, D_i is not rounded. Only high-only images saturate.

| symbol | name | unit |
|---|---|---|
| I_i | expected(i) of the sky | DN/s |
| g, t | photon_gain_dn, exposure_s | DN, s |
| read | a normal random number with rms read_noise_dn | DN |
| dark, saturation | dark_offset_dn, saturation_dn | DN |

`write` makes a folder with the files of a real transit, and files with the true values:

| file | content |
|---|---|
| NNN.fits | images, whole DN |
| diffraction.fits | diffraction PSF |
| transit.json | the description that a real transit also has |
| noise_free/NNN.fits | images without noise, DN/s |
| scenes/fovN.fits | scene of each pointing without the occulter, with margins, DN/s |
| truth.json | PSF, exact positions, seeds, plan |

The images have the header keywords that real images of the imitated instrument have. HRI_EUV images get the keywords of
level 2 files of EUI. AIA images get the keywords of level 1 files, without DETECTOR and gain modes. Images of another
instrument get three kinds of keywords: those by which the TOML file of the instrument recognises its images, the
wavelength, and the plate scale.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Kernel, Plane
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.images import CardValue, read_plane, write_plane
from psfcore.instruments.model import Instrument
from psfcore.simulate.plan import HIGH, Plan, Shot, plan_from_json
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.sky import TrueSky, true_sky
from psfcore.transit.manifest import MANIFEST_NAME
from psfcore.transit.transit import Frame, Place, Transit

TRUTH_FILE = "truth.json"
DIFFRACTION_FILE = "diffraction.fits"
_EPHEMERIS, _NOISE = 1001, 1002  # independent streams of random numbers
_LARGEST_PX = 16384
_START = datetime(2023, 1, 3, 3, 42)
_TEXTS_OF_HRI = {"TELESCOP": "SOLO/EUI/HRI_EUV", "INSTRUME": "EUI", "DETECTOR": "HRI_EUV"}
_TELESCOPES_OF_AIA = {94: 4, 131: 1, 171: 3, 193: 2, 211: 2, 304: 4, 335: 1}  # Lemen et al. (2012)
_COMMENTS = {
    "ORIGIN": "not an observation",
    "TELESCOP": "telescope imitated",
    "INSTRUME": "instrument imitated",
    "DETECTOR": "detector imitated",
    "WAVEUNIT": "unit of WAVELNTH",
    "WAVELNTH": "[Angstrom] wavelength",
    "CDELT1": "[arcsec] pixel scale along axis 1",
    "CDELT2": "[arcsec] pixel scale along axis 2",
    "DATE-BEG": "[UTC] start of exposure, made up",
    "DATE-OBS": "[UTC] start of exposure, made up",
    "XPOSURE": "[s] exposure time",
    "EXPTIME": "[s] exposure time",
    "GAINCOMB": "gain mode imitated",
    "BUNIT": "unit of the pixels",
    "SATURATE": "[DN] level at which pixels clip",
    "FOV": "pointing",
    "PSFSUM": "this file is a PSF: sum of its weights",
    "MARGIN": "[pixel] width beyond the field on each side",
}


@dataclass(frozen=True)
class Imitated:
    """The instrument that simulated headers imitate.

    Attributes
    ----------
    name
        The instrument's name in transit.json.
    texts
        Keywords that identify the instrument, with their values.
    wavelength_angstrom
        A whole number, the value of WAVELNTH.
    date_key, exposure_key
        The keywords of the start and of the exposure time.
    has_gain_modes
        Whether GAINCOMB is written.
    """

    name: str
    texts: dict[str, str]
    wavelength_angstrom: int
    plate_scale_arcsec: float
    date_key: str = "DATE-BEG"
    exposure_key: str = "XPOSURE"
    has_gain_modes: bool = True

    def values(self) -> dict[str, CardValue]:
        """The keywords that every file of the transit has."""
        return {
            "ORIGIN": "SIMULATED by heliopsf",
            **self.texts,
            "WAVELNTH": self.wavelength_angstrom,
            "CDELT1": self.plate_scale_arcsec,
            "CDELT2": self.plate_scale_arcsec,
        }

    def shot_values(self, shot: Shot, unit: str) -> dict[str, CardValue]:
        """The keywords of one image whose pixels are in `unit`."""
        begin = (_START + timedelta(seconds=shot.time_s)).isoformat(timespec="milliseconds")
        values = self.values() | {self.date_key: begin, self.exposure_key: shot.exposure_s}
        if self.has_gain_modes:
            values["GAINCOMB"] = shot.gain_mode
        return values | {"BUNIT": unit}


HRI_EUV = Imitated("hri_euv", _TEXTS_OF_HRI, 174, 0.492)


def imitated(instrument: Instrument) -> Imitated:
    """The keywords with which headers imitate `instrument`."""
    if instrument.name == HRI_EUV.name:
        return HRI_EUV
    channel = round(instrument.wavelength_angstrom)
    scale_arcsec = instrument.detector.plate_scale_arcsec
    if instrument.name.startswith("aia_") and channel in _TELESCOPES_OF_AIA:
        number = _TELESCOPES_OF_AIA[channel]
        texts = {"TELESCOP": "SDO/AIA", "INSTRUME": f"AIA_{number}", "WAVEUNIT": "angstrom"}
        return Imitated(
            instrument.name, texts, channel, scale_arcsec, "DATE-OBS", "EXPTIME", has_gain_modes=False
        )
    texts = {key: text for key, text in instrument.match.items() if isinstance(text, str)}
    return Imitated(instrument.name, texts, channel, scale_arcsec)


def _commented(values: dict[str, CardValue]) -> dict[str, tuple[CardValue, str]]:
    """Add the comment of each keyword."""
    return {key: (value, _COMMENTS.get(key, "instrument imitated")) for key, value in values.items()}


@dataclass(frozen=True, eq=False)
class SimulatedTransit:
    """A simulated transit in memory, with the true values.

    Attributes
    ----------
    transit
        The transit, with frames in DN/s (float32) that are made from whole DN. The places of the frames are the
        reported positions, which contain the errors of the ephemeris.
    sky
        The true scenes, PSF and positions.
    seed
        Seed of the noise and of the errors of the ephemeris.
    imitated
        The instrument whose keywords the headers get.
    """

    transit: Transit
    sky: TrueSky
    seed: int
    imitated: Imitated

    @property
    def plan(self) -> Plan:
        """The plan of the transit."""
        return self.sky.plan


def simulate(
    plan: Plan,
    scatter: ScatterTruth,
    diffraction: Kernel,
    seed: int,
    *,
    scenes: Mapping[int, Plane] | None = None,
    imitated: Imitated = HRI_EUV,
    threads: int = 1,
) -> SimulatedTransit:
    """A transit of `plan`. Its PSF is `scatter` convolved with `diffraction`. Equal arguments give equal results.

    Raises DataError "bad-diffraction", "bad-scene".

    Parameters
    ----------
    diffraction
        The diffraction PSF: weights [y, x], centre at [n // 2, n // 2], sum 1.
    seed
        Random seed of the scenes, the ephemeris errors and the noise.
    scenes
        For each pointing, a scene to use instead of a synthetic scene, as drawn_scene and scene_from_image of
        psfcore.simulate.scene return it.
    imitated
        The instrument whose keywords the headers get.
    """
    sky = true_sky(plan, scatter, diffraction, seed, scenes=scenes, threads=threads)
    return observed_transit(sky, seed, imitated)


def observed_transit(sky: TrueSky, seed: int, imitated: Imitated = HRI_EUV) -> SimulatedTransit:
    """A transit of a given sky: `seed` determines the noise realisation and the errors of the ephemeris.

    This is faster than `simulate`, because the scenes are already convolved.
    """
    plan = sky.plan
    reported = reported_places(plan, seed)
    start_s = plan.shots[0].time_s
    frames = tuple(
        Frame(
            file=f"{index:03d}.fits",
            pixels=(_read_out(plan, index, sky.expected(index), seed) / shot.exposure_s).astype(np.float32),
            pointing=shot.pointing,
            place=reported[index],
            exposure_s=shot.exposure_s,
            time_s=shot.time_s - start_s,
            gain_mode=shot.gain_mode,
        )
        for index, shot in enumerate(plan.shots)
    )
    transit = Transit(
        frames=frames,
        diffraction=sky.diffraction,
        noise=plan.noise,
        instrument=imitated.name,
        plate_scale_arcsec=imitated.plate_scale_arcsec,
    )
    return SimulatedTransit(transit, sky, seed, imitated)


def _read_out(plan: Plan, index: int, expected: Plane, seed: int) -> Plane:
    """D_i of Eq. (1): one exposure in DN."""
    shot = plan.shots[index]
    rng = np.random.default_rng([seed, _NOISE, index])
    seen_dn = plan.noise.observe(expected, shot.exposure_s, rng) * shot.exposure_s + plan.dark_offset_dn
    if plan.saturation_dn is not None and shot.gain_mode == HIGH:
        seen_dn = np.minimum(seen_dn, plan.saturation_dn)
    return np.asarray(np.rint(seen_dn) if plan.whole_dn else seen_dn)


def reported_places(plan: Plan, seed: int) -> list[Place]:
    """The positions of the occulter that a transit states: the exact positions plus errors of the ephemeris, rounded to
    a tenth of a pixel.
    """
    rng = np.random.default_rng([seed, _EPHEMERIS])
    errors = rng.normal(0.0, plan.ephemeris_error_px, (len(plan.shots), 2))
    return [
        Place(round(shot.x_px + float(dx), 1), round(shot.y_px + float(dy), 1), plan.radius_px)
        for shot, (dx, dy) in zip(plan.shots, errors, strict=True)
    ]


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
        cards = _commented(imitated.shot_values(plan.shots[index], "DN/s"))
        write_plane(folder / "noise_free" / frame.file, simulated.sky.expected(index), cards=cards)
    for pointing, scene in simulated.sky.scenes.items():
        about: dict[str, CardValue] = {"BUNIT": "DN/s", "FOV": pointing, "MARGIN": plan.margin_px}
        cards = _commented(imitated.values() | about)
        write_plane(folder / "scenes" / f"fov{pointing}.fits", scene, cards=cards)
    law = simulated.sky.scatter
    truth = {
        "effects": [],
        "psf": {
            "b": law.b_px,
            "c": law.c,
            "total": law.total,
            "a": law.a,
            "stretch": law.stretch,
            "angle_deg": law.angle_deg,
            "dipole": law.dipole,
        },
        "exact": [{"x": shot.x_px, "y": shot.y_px} for shot in plan.shots],
        "seed": simulated.seed,
        "scene_seed": simulated.sky.seed,
        "plan": plan.as_json(),
    }
    _write_json(folder / TRUTH_FILE, truth)


def write_observation(
    folder: Path,
    plan: Plan,
    exposures: Sequence[NDArray[np.generic]],
    places: Sequence[Place],
    diffraction: Plane,
    imitated: Imitated = HRI_EUV,
) -> None:
    """Write the files that a real transit also has: images, diffraction PSF and transit.json.

    Parameters
    ----------
    exposures
        The images [y, x] in DN, in the order of the plan.
    places
        The reported positions of the occulter.
    """
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for n, (dn, shot, place) in enumerate(zip(exposures, plan.shots, places, strict=True)):
        values, file, level = imitated.shot_values(shot, "DN"), f"{n:03d}.fits", plan.saturation_dn
        if level is not None and shot.gain_mode == HIGH:
            values["SATURATE"] = float(np.rint(level)) if plan.whole_dn else level
        write_plane(folder / file, dn, cards=_commented(values))
        at = {"x": place.x_px, "y": place.y_px, "r": place.radius_px}
        entries.append({"file": file, "fov": shot.pointing, **at})
    # PSFSUM says that the file is a PSF, see `content_of`; otherwise it would be deconvolved like an image of the
    # folder.
    is_psf: dict[str, CardValue] = {"PSFSUM": float(diffraction.sum())}
    write_plane(folder / DIFFRACTION_FILE, diffraction, cards=_commented(imitated.values() | is_psf))
    content = {
        "schema": "transit/1",
        "instrument": imitated.name,
        "known_psf": DIFFRACTION_FILE,
        "noise": {"photon_gain_dn": plan.noise.photon_gain_dn, "read_noise_dn": plan.noise.read_noise_dn},
        "images": entries,
    }
    _write_json(folder / MANIFEST_NAME, content)


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
        raise DataError(
            "not-simulated",
            f"expected a file {TRUTH_FILE} in {folder.name}, as `heliopsf simulate transit` writes it; got "
            f"{type(error).__name__}: {error!s:.120}",
        ) from None
    plan = plan_from_json(plan_json)
    limits = FitsLimits(max_pixels=_LARGEST_PX**2)
    scenes = {
        pointing: read_plane(folder / "scenes" / f"fov{pointing}.fits", limits) for pointing in plan.pointings
    }
    diffraction = read_plane(folder / DIFFRACTION_FILE, limits)
    return true_sky(plan, scatter, diffraction, seed, scenes=scenes, threads=threads)


def _write_json(path: Path, content: Mapping[str, object]) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
