"""The inputs of a simulated transit from files: its plan, the diffraction PSF, and scenes.

A plan states when, where and for how long images are taken. Three kinds of files are read:

- a plan as JSON, as `Plan.as_json` returns it (`size_px`, `shots`, ...);
- truth.json of a simulated transit, which contains such a plan;
- transit.json, or a folder with it. Exposure times, gain modes, times and the size of the images come from the headers
  of the images. If there are no images yet, transit.json states them: `size_px`, and `exposure_s`, `gain_mode` and
  `time_s` of each image. `views` then says what each pointing shows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from psfcore.arrays import Plane
from psfcore.build import build_psf
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import HeaderSummary, read_summary
from psfcore.fits.images import read_plane
from psfcore.fits.observation import read_observation
from psfcore.fits.units import parse_unit
from psfcore.instruments.model import load_instrument
from psfcore.simulate.plan import (
    CAMERA,
    DISC,
    HIGH,
    VIEWS,
    WEST,
    Plan,
    Shot,
    drawn_oversampling,
    plan_from_json,
)
from psfcore.simulate.scene import scene_from_image
from psfcore.transit.folder import times_s
from psfcore.transit.manifest import MANIFEST_NAME, MAX_MANIFEST_BYTES, TransitManifest, parse_manifest

LARGEST_DIFFRACTION_PX = 2048
LARGEST_SIZE_PX = 4096
MOST_IMAGES = 1000
_INTERVAL_S = 60.0  # time between two images, if their times are not stated


@dataclass(frozen=True)
class PlanFile:
    """The content of a plan file.

    Attributes
    ----------
    known_psf
        The file with the known part of the PSF; None: the plan file does not state it.
    instrument
        The name of the instrument; None: the plan file does not state it.
    """

    plan: Plan
    known_psf: Path | None = None
    instrument: str | None = None


def read_plan(path: str | Path, limits: FitsLimits) -> PlanFile:
    """The plan in a file, or in the transit.json of a folder.

    Raises DataError "no-manifest", "bad-manifest", "bad-plan", and the errors of reading a header.
    """
    path = Path(path)
    file = path / MANIFEST_NAME if path.is_dir() else path
    if not file.is_file():
        raise DataError(
            "no-manifest",
            f"expected a plan, or a folder with {MANIFEST_NAME}; {path} has no {MANIFEST_NAME}: add it, or name the "
            "file of a plan",
        )
    with file.open("rb") as source:
        text = source.read(MAX_MANIFEST_BYTES + 1)
    content = _object(text, file.name)
    if "images" in content or str(content.get("schema", "")).startswith("transit/"):
        manifest = parse_manifest(text)
        plan = _checked(_of_transit(manifest, content, file.parent, limits), file.name)
        known_psf = None if manifest.known_psf is None else file.parent / manifest.known_psf
        return PlanFile(
            plan, known_psf if known_psf is not None and known_psf.is_file() else None, manifest.instrument
        )
    if isinstance(content.get("plan"), dict):
        content = content["plan"]
    if "shots" not in content:
        raise _bad(
            f"{file.name}: expected a plan with `shots`, or a {MANIFEST_NAME} with `images`; got the keys "
            f"{', '.join(sorted(content))[:120] or 'of an empty object'}"
        )
    return PlanFile(_checked(plan_from_json(content), file.name))


def _checked(plan: Plan, name: str) -> Plan:
    """The plan, if it can be simulated. A file may state any number."""
    if not isinstance(plan.size_px, int) or plan.size_px > LARGEST_SIZE_PX:
        raise _bad(f"{name}: expected images of at most {LARGEST_SIZE_PX} px; got {plan.size_px!r:.60} px")
    if len(plan.shots) > MOST_IMAGES:
        raise _bad(f"{name}: expected at most {MOST_IMAGES} images; got {len(plan.shots)}")
    for number, shot in enumerate(plan.shots):
        if not (math.isfinite(shot.exposure_s) and math.isfinite(shot.time_s)):
            raise _bad(
                f"{name}: image {number}: expected a finite exposure and time; got {shot.exposure_s} s and "
                f"{shot.time_s} s"
            )
    return plan


def _object(text: bytes, name: str) -> dict[str, Any]:
    if len(text) > MAX_MANIFEST_BYTES:
        raise _bad(f"{name}: expected at most {MAX_MANIFEST_BYTES} bytes; got more")
    try:
        content = json.loads(text.decode("utf-8-sig"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise _bad(
            f"{name}: expected a plan or a {MANIFEST_NAME}, as JSON in UTF-8; got: {error!s:.120}"
        ) from None
    if not isinstance(content, dict):
        raise _bad(f"{name}: expected a JSON object; got {type(content).__name__}")
    return content


def _of_transit(
    manifest: TransitManifest, content: Mapping[str, Any], folder: Path, limits: FitsLimits
) -> Plan:
    """The plan of a transit whose images may not be taken yet."""
    missing = [image.file for image in manifest.images if not (folder / image.file).is_file()]
    if 0 < len(missing) < len(manifest.images):
        raise _bad(
            f"{MANIFEST_NAME}: expected all images in the folder, or none of them; missing: {', '.join(missing[:5])}"
        )
    if not missing:
        headers = [read_summary(folder / image.file, limits) for image in manifest.images]
        size_px, exposures = _size_of_headers(headers), _exposures_of_headers(headers, manifest)
    else:
        size_px, exposures = _size_of_manifest(content), _exposures_of_manifest(content["images"])
    numbers = {pointing: k for k, pointing in enumerate(manifest.pointings, start=1)}
    shots = [
        Shot(numbers[image.pointing], image.x, image.y, exposure_s, gain_mode, time_s)
        for image, (exposure_s, gain_mode, time_s) in zip(manifest.images, exposures, strict=True)
    ]
    radii = sorted(image.r for image in manifest.images)
    return Plan(
        size_px=size_px,
        shots=tuple(sorted(shots, key=lambda shot: shot.time_s)),
        views=_views(content, len(numbers)),
        radius_px=radii[len(radii) // 2],
        noise=CAMERA if manifest.noise is None else manifest.noise.noise(),
        oversampling=drawn_oversampling(size_px),
    )


def _size_of_headers(headers: Sequence[HeaderSummary]) -> int:
    shapes = {header.shape for header in headers}
    ny, nx = headers[0].shape
    if len(shapes) > 1 or ny != nx:
        got = ", ".join(f"{x} x {y} px" for y, x in sorted(shapes)[:3])
        raise _bad(f"expected square images of equal size; got {got}: cut them, or write a plan with `shots`")
    return ny


def _exposures_of_headers(
    headers: Sequence[HeaderSummary], manifest: TransitManifest
) -> list[tuple[float, str, float]]:
    """Exposure time, gain mode and time of each image, from its header."""
    rows = []
    for header, image, time_s in zip(headers, manifest.images, times_s(headers), strict=True):
        if header.exposure_s is None:
            raise _bad(f"{image.file}: expected XPOSURE or EXPTIME in the header; got neither of them")
        rows.append((header.exposure_s, (header.gain_mode or HIGH).lower(), time_s))
    return rows


def _size_of_manifest(content: Mapping[str, object]) -> int:
    size = content.get("size_px")
    if not isinstance(size, int) or isinstance(size, bool):
        raise _bad(
            f"{MANIFEST_NAME}: expected the images in the folder or, without them, `size_px` (their width and height "
            f"in px); got {size!r:.60}"
        )
    return size


def _exposures_of_manifest(images: Sequence[Mapping[str, Any]]) -> list[tuple[float, str, float]]:
    """Exposure time, gain mode and time of each image, from transit.json."""
    rows = []
    for number, image in enumerate(images):
        exposure_s = image.get("exposure_s")
        gain_mode = image.get("gain_mode", HIGH)
        time_s = image.get("time_s", number * _INTERVAL_S)
        label = f"{MANIFEST_NAME}: images[{number}]"
        if not _is_number(exposure_s):
            raise _bad(
                f"{label}: expected the images in the folder or, without them, `exposure_s` of each image; got "
                f"{exposure_s!r:.60}"
            )
        if not _is_number(time_s) or not isinstance(gain_mode, str):
            raise _bad(
                f"{label}: expected a number as `time_s` and a text as `gain_mode`; got {time_s!r:.60} and "
                f"{gain_mode!r:.60}"
            )
        rows.append((float(exposure_s), gain_mode.lower(), float(time_s)))
    return rows


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _views(content: Mapping[str, object], count: int) -> tuple[str, ...]:
    """The view of each pointing, as the file states it.

    Default: three pointings show the east limb, the disc and the west limb; with any other number, all pointings show
    the disc.
    """
    views = content.get("views")
    if views is None:
        return VIEWS if count == len(VIEWS) else (DISC,) * count
    if not isinstance(views, list) or len(views) != count or not set(map(str, views)) <= set(VIEWS):
        raise _bad(
            f"{MANIFEST_NAME}: expected `views` with one of {', '.join(VIEWS)} for each of the {count} pointings; got "
            f"{views!r:.120}"
        )
    return tuple(views)


def _bad(message: str) -> DataError:
    return DataError("bad-plan", message)


def diffraction_kernel(
    instrument: str, file: Path | None, size: int, limits: FitsLimits, *, threads: int = 1
) -> Plane:
    """Weights [y, x] of the diffraction PSF. If ``file`` is given, they are read from it and not changed.

    Otherwise they are computed for ``instrument`` on (size, size) px and divided by their sum.
    """
    if file is not None:
        return read_plane(file, limits)
    kernel = build_psf(
        load_instrument(instrument), size=size, component="DIFFRACTION", threads=threads
    ).kernel
    weights: Plane = kernel / kernel.sum()
    return weights


def scenes_from_files(files: Sequence[Path], plan: Plan, limits: FitsLimits) -> dict[int, Plane] | None:
    """A scene for each pointing; the keys are the pointings' numbers. None if ``files`` is empty.

    A single image serves for all pointings; for the west limb it is mirrored. Otherwise ``files`` contains one image
    for each pointing. Raises DataError "scene-count", "bad-scene".
    """
    if not files:
        return None
    if len(files) not in (1, len(plan.views)):
        raise DataError(
            "scene-count",
            f"expected one scene image, or {len(plan.views)} (one for each pointing); got {len(files)}",
        )
    scenes = {}
    for pointing in plan.pointings:
        rate = image_rate(files[(pointing - 1) % len(files)], limits)
        mirrored = len(files) == 1 and plan.views[pointing - 1] == WEST
        scenes[pointing] = scene_from_image(rate[:, ::-1] if mirrored else rate, plan)
    return scenes


def image_rate(file: str | Path, limits: FitsLimits) -> Plane:
    """Pixels [y, x] of an image. They are divided by the exposure time if they are counts and that time is known."""
    image = read_observation(file, limits)
    if parse_unit(image.unit).kind == "count" and image.exposure_s is not None:
        return image.pixels / image.exposure_s
    return image.pixels
