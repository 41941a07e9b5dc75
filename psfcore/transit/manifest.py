"""transit.json: the files of a transit, and the position of the occulter in each image according to the ephemeris.

This module imports no numerical library, so that the web process can check an upload. Unknown keys are ignored, so that
files of a newer version can be read.

| key | meaning | unit |
|---|---|---|
| x, y | centre of the occulter from the ephemeris; the centre of the first pixel is 0 | px |
| r | radius of the occulter | px |
| fov | the pointing | |
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from psfcore.errors import DataError
from psfcore.noise import NoiseFigures
from psfcore.transit.admission import MANIFEST_NAME as MANIFEST_NAME
from psfcore.transit.admission import MAX_MANIFEST_BYTES as MAX_MANIFEST_BYTES
from psfcore.transit.admission import is_plain_name

MAX_IMAGES = 2000
MOST_FAULTS = 8  # wrong values that a message names
# Every value of a JSON text except the first follows one of these characters. Python needs about 100 bytes for a value,
# so the number of values is limited before the text is read. An image of today's format has 5 values.
_BEFORE_VALUES = (b",", b"[", b"{")
MAX_VALUES = 64 * MAX_IMAGES
FARTHEST_PX = 1e6
LARGEST_RADIUS_PX = 4096.0


def _plain(name: str) -> str:
    if not is_plain_name(name):
        raise ValueError("expected a plain file name inside the folder")
    return name


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("expected printable characters")
    return text


FileName = Annotated[str, AfterValidator(_plain)]
# strict: the values "12.5" (a string) and true are not accepted as numbers.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Coordinate = Annotated[Number, Field(ge=-FARTHEST_PX, le=FARTHEST_PX)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class _Noise(NoiseFigures):
    """The noise figures, as in a request; but unknown keys are ignored."""

    model_config = ConfigDict(extra="ignore")


class ImageEntry(_Frozen):
    """One image of a transit: its file, its pointing, and the centre and radius of the occulter, px."""

    file: FileName
    pointing: Annotated[int, Field(strict=True, ge=0, le=10_000, alias="fov")]
    x: Coordinate
    y: Coordinate
    r: Annotated[Number, Field(gt=0, le=LARGEST_RADIUS_PX)]


class TransitManifest(_Frozen):
    """The content of transit.json; the images keep the order of the file."""

    schema_: Literal["transit/1"] = Field(alias="schema")
    instrument: Annotated[str, Field(min_length=1, max_length=80), AfterValidator(_printable)] | None = None
    known_psf: FileName | None = None
    noise: _Noise | None = None
    images: Annotated[tuple[ImageEntry, ...], Field(min_length=1, max_length=MAX_IMAGES)]

    @property
    def files(self) -> tuple[str, ...]:
        """All named files: the images in their order, then the known PSF."""
        psf = () if self.known_psf is None else (self.known_psf,)
        return (*(image.file for image in self.images), *psf)

    @property
    def pointings(self) -> dict[int, int]:
        """The number of images of each pointing."""
        counts: dict[int, int] = {}
        for image in self.images:
            counts[image.pointing] = counts.get(image.pointing, 0) + 1
        return dict(sorted(counts.items()))


def read_manifest(folder: str | Path) -> TransitManifest:
    """The transit.json of a folder.

    Raises DataError "no-manifest" if there is none, and the errors of ``parse_manifest``.
    """
    path = Path(folder) / MANIFEST_NAME
    if not path.is_file():
        got = (
            f"the folder {folder} has none: add it"
            if Path(folder).is_dir()
            else f"{folder} is {'a file' if Path(folder).exists() else 'not there'}: name the folder of the transit"
        )
        raise DataError("no-manifest", f"expected a folder with the file {MANIFEST_NAME}; {got}")
    with path.open("rb") as file:
        return parse_manifest(file.read(MAX_MANIFEST_BYTES + 1))


def parse_manifest(content: bytes) -> TransitManifest:
    """A manifest from the bytes of transit.json.

    Raises DataError "bad-manifest":

    - if the JSON cannot be read, or the schema is wrong;
    - if values are missing or wrong;
    - if there is no image, or more than MAX_IMAGES images;
    - if a file name is not plain or occurs twice;
    - if both noise figures are zero.

    The message names each wrong key (an image by its index and file), the expected value and the given value.
    """
    if len(content) > MAX_MANIFEST_BYTES:
        raise _bad(f"expected at most {MAX_MANIFEST_BYTES} bytes; got more")
    values = sum(content.count(character) for character in _BEFORE_VALUES)
    if values > MAX_VALUES:
        raise _bad(f"expected at most {MAX_VALUES} of the characters ',', '[' and '{{'; got {values}")
    try:
        data = json.loads(content.decode("utf-8-sig"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError, ValueError) as error:
        raise _bad(f"expected JSON in UTF-8; got: {str(error) or type(error).__name__:.120}") from None
    if not isinstance(data, dict):
        raise _bad(f"expected a JSON object; got {type(data).__name__}")
    # pydantic builds a model of every image before it counts the images.
    images = data.get("images")
    if isinstance(images, list) and len(images) > MAX_IMAGES:
        raise _bad(f"images: expected at most {MAX_IMAGES} images; got {len(images)}")
    try:
        manifest = TransitManifest.model_validate(data)
    except ValidationError as error:
        faults = [_fault(one, data) for one in error.errors()]
        more = f"; and {len(faults) - MOST_FAULTS} more" if len(faults) > MOST_FAULTS else ""
        raise _bad("; ".join(faults[:MOST_FAULTS]) + more) from None
    _check_once(manifest)
    if manifest.noise is not None and not (manifest.noise.photon_gain_dn or manifest.noise.read_noise_dn):
        raise _bad("noise: expected photon_gain_dn or read_noise_dn above zero; got 0 and 0")
    return manifest


def _bad(message: str) -> DataError:
    return DataError("bad-manifest", f"{MANIFEST_NAME}: {message}")


def _check_once(manifest: TransitManifest) -> None:
    seen: dict[str, int] = {}
    for index, image in enumerate(manifest.images):
        if image.file in seen:
            message = f"expected each file once; got the same file as images[{seen[image.file]}]"
            raise _bad(f"images[{index}] ({image.file}): {message}")
        if image.file in (MANIFEST_NAME, manifest.known_psf):
            role = "known PSF" if image.file == manifest.known_psf else "manifest"
            message = f"expected the file of an image; got the file of the {role}"
            raise _bad(f"images[{index}] ({image.file}): {message}")
        seen[image.file] = index
    if manifest.known_psf == MANIFEST_NAME:
        raise _bad(f"known_psf: expected a FITS file; got {MANIFEST_NAME}")


def _fault(fault: ErrorDetails, data: dict[str, Any]) -> str:
    got = "no such key" if fault["type"] == "missing" else f"{fault['input']!r:.80}"
    if fault["type"] in ("too_long", "too_short"):
        got = f"{len(data['images'])}"
    expected = fault["msg"].removeprefix("Value error, ")
    expected = expected if expected.startswith("expected") else f"expected: {expected}"
    return f"{_where(fault['loc'], data)}: {expected}; got {got}"


def _where(location: tuple[int | str, ...], data: dict[str, Any]) -> str:
    """The path of a value in transit.json, for a message; an image is named by its index and file."""
    match location:
        case ("images", int() as index, *rest):
            entry = data["images"][index]
            name = entry.get("file") if isinstance(entry, dict) else None
            label = f"images[{index}]" + (
                f" ({name:.80})" if isinstance(name, str) and name.isprintable() else ""
            )
            return ".".join([label, *map(str, rest)])
        case _:
            return ".".join(map(str, location)) or "file"
