"""transit.json is read correctly; errors name the image and the key."""

from __future__ import annotations

import copy
import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from psfcore.errors import DataError
from psfcore.transit.manifest import MAX_IMAGES, is_plain_name, parse_manifest, read_manifest

GOOD: dict[str, Any] = {
    "schema": "transit/1",
    "instrument": "hri_euv",
    "known_psf": "diffraction.fits",
    "noise": {"photon_gain_dn": 6.0, "read_noise_dn": 2},
    "images": [
        {"file": "000.fits", "fov": 1, "x": 14.6, "y": 171.0, "r": 10.75},
        {"file": "001.fits", "fov": 2, "x": -3, "y": 171.0, "r": 10.75},
        {"file": "002.fits", "fov": 2, "x": 20.0, "y": 171.0, "r": 10.75},
    ],
}
Change = Callable[[dict[str, Any]], object]


def changed(change: Change) -> bytes:
    content = copy.deepcopy(GOOD)
    change(content)
    return json.dumps(content).encode()


def test_a_manifest_is_read_as_written_with_unknown_keys() -> None:
    manifest = parse_manifest(json.dumps(GOOD).encode())
    assert manifest.instrument == "hri_euv"
    assert manifest.noise is not None and manifest.noise.read_noise_dn == 2.0
    assert manifest.files == ("000.fits", "001.fits", "002.fits", "diffraction.fits")
    assert manifest.pointings == {1: 1, 2: 2}
    assert (manifest.images[1].x, manifest.images[1].r) == (-3.0, 10.75)
    assert parse_manifest(b"\xef\xbb\xbf" + json.dumps(GOOD).encode()) == manifest, (
        "a byte order mark is ignored"
    )

    def strip(content: dict[str, Any]) -> None:
        for key in ("instrument", "known_psf", "noise"):
            del content[key]
        content["made_by"] = {"a": 1}
        content["images"][0]["comment"] = "egress"

    manifest = parse_manifest(changed(strip))
    assert (manifest.instrument, manifest.known_psf, manifest.noise) == (None, None, None)
    assert manifest.files == ("000.fits", "001.fits", "002.fits")


def image(index: int, **values: Any) -> Change:
    return lambda content: content["images"][index].update(values)


def top(**values: Any) -> Change:
    return lambda content: content.update(values)


def many(content: dict[str, Any]) -> None:
    content["images"] = [
        {"file": f"{i}.fits", "fov": 1, "x": 1, "y": 1, "r": 1} for i in range(MAX_IMAGES + 1)
    ]


WRONG: list[tuple[Change, list[str]]] = [
    (top(schema="transit/2"), ["schema", "transit/1", "transit/2"]),
    (lambda content: content.pop("schema"), ["schema", "no such key"]),
    (top(images=[]), ["images", "at least 1", "got 0"]),
    (many, ["images", str(MAX_IMAGES), str(MAX_IMAGES + 1)]),
    (image(1, file="../001.fits"), ["images[1] (../001.fits).file", "plain file name"]),
    (image(1, file="a\0b"), ["images[1]", "plain file name"]),
    (image(2, file="000.fits"), ["images[2] (000.fits)", "once", "images[0]"]),
    (image(2, file="diffraction.fits"), ["images[2]", "known PSF"]),
    (image(2, file="transit.json"), ["images[2]", "manifest"]),
    (top(known_psf="transit.json"), ["known_psf"]),
    (image(2, x=float("nan")), ["images[2] (002.fits).x", "finite"]),
    (image(2, x="12"), ["images[2] (002.fits).x", "got '12'"]),
    (image(2, x=True), ["images[2] (002.fits).x"]),
    (image(2, r=0), ["images[2] (002.fits).r", "greater than 0", "got 0"]),
    (image(2, r=1e5), ["images[2] (002.fits).r"]),
    (image(2, fov=1.5), ["images[2] (002.fits).fov"]),
    (lambda content: content["images"][0].pop("r"), ["images[0] (000.fits).r", "no such key"]),
    (lambda content: content["images"].insert(1, None), ["images[1]", "None"]),
    (top(noise={"photon_gain_dn": -1, "read_noise_dn": 2}), ["noise.photon_gain_dn", "-1"]),
    (top(noise={"photon_gain_dn": 0, "read_noise_dn": 0}), ["noise", "above zero"]),
    (top(instrument="a\0b"), ["instrument", "printable"]),
]
NOT_A_MANIFEST = (
    b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000, b'{"schema": ' + b"9" * 5000 + b"}", b" " * 2**23
)  # fmt: skip


def refusal(content: bytes) -> str:
    """The message of the refusal of a transit.json."""
    with pytest.raises(DataError) as caught:
        parse_manifest(content)
    assert caught.value.code == "bad-manifest" and "expected" in caught.value.message
    return caught.value.message


def test_a_wrong_value_is_named_and_other_content_is_refused() -> None:
    for change, words in WRONG:
        message = refusal(changed(change))
        assert "got" in message and all(word in message for word in words), message
    for content in NOT_A_MANIFEST:
        refusal(content)


def test_a_folder_without_a_manifest_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "image.fits"
    file.touch()
    for place, fault in ((tmp_path, "has none"), (file, "is a file"), (tmp_path / "no", "is not there")):
        with pytest.raises(DataError, match=f"{place.name} {fault}") as refused:
            read_manifest(place)
        assert refused.value.code == "no-manifest"


def test_plain_names() -> None:
    for name in ("000.fits", "a b.fits", "solar-eui_2023T04:43.fits", "ü.fits", "a" * 255):
        assert is_plain_name(name), name
    paths = ("a/001.fits", "a\\001.fits", "/001.fits", "C:001.fits", "x:y.fits.gz", "..", ".")
    for name in (*paths, "", " a.fits", "a\n.fits", "a" * 256):
        assert not is_plain_name(name), name


def test_values_are_counted_before_they_become_objects() -> None:
    start = b'{"schema": "transit/1", '
    for content in (
        start + b'"images": [' + 1_390_000 * b"{}," + b"{}]}",
        start + b'"deep": [' + 1_000_000 * b"[]," + b"[]]}",
        start + b'"deep": ' + 1_000_000 * b"[" + 1_000_000 * b"]" + b"}",
        start + b'"images": [' + 60_000 * b"{}," + b"{}]}",  # fewer values, but more images than allowed
    ):
        tracemalloc.start()
        message = refusal(content)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert "expected at most" in message
        assert peak < 16 * 2**20, f"{content[:40]!r}: {peak / 2**20:.0f} MiB"
