"""The bad requests and files of the whole API, as a table: what is sent, and what is to be answered."""

from __future__ import annotations

import gzip
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from tests.fits_bombs import padded

MIB = 2**20
JSON = {"Content-Type": "application/json"}
A = "a" * 64
DEEP = 20_000


@dataclass(frozen=True)
class Attack:
    """A request with ann's key, where it brings no other, and the refusal that it is to get."""

    name: str
    status: int
    code: str
    method: str = "POST"
    address: str = "/v1/jobs"
    headers: dict[str, str] = field(default_factory=dict)
    content: Callable[[], bytes] | None = None
    json: Any = None


def job(name: str, status: int, code: str, kind: str, **parameters: Any) -> Attack:
    """A job that cannot be."""
    return Attack(name, status, code, json={"kind": kind, "parameters": parameters})


def body(name: str, status: int, code: str, content: bytes, **more: Any) -> Attack:
    """A body that is no request."""
    return Attack(name, status, code, content=lambda: content, headers=JSON, **more)


def got(name: str, status: int, code: str, address: str, **headers: str) -> Attack:
    """An address that is none."""
    return Attack(
        name, status, code, "GET", address, headers={k.replace("_", "-"): v for k, v in headers.items()}
    )


def image(name: str, status: int, code: str, make: Callable[[], bytes]) -> Attack:
    """A file that is no image."""
    return Attack(name, status, code, address="/v1/images", content=make)


def transit(name: str, status: int, code: str, make: Callable[[], bytes]) -> Attack:
    """An archive that is no transit."""
    return Attack(name, status, code, address="/v1/transits", content=make)


# Files of FITS --------------------------------------------------------------------------------------
# These and the archives are examples; all refusals are tested in tests/psfcore/fits and tests/psfcore/transit.


def cards(*lines: str) -> bytes:
    """A header of these cards."""
    return padded(b"".join(line.ljust(80).encode() for line in (*lines, "END")), b" ")


def primary(bitpix: int, *axes: int) -> bytes:
    """The header of an image."""
    sizes = [f"NAXIS{n:<3}= {axis:>20}" for n, axis in enumerate(axes, 1)]
    first = "SIMPLE  =                    T"
    return cards(first, f"BITPIX  = {bitpix:>20}", f"NAXIS   = {len(axes):>20}", *sizes)


def long_header(mib: int) -> bytes:
    """Cards without end."""
    return primary(16, 8, 8)[:400] + b"COMMENT x".ljust(80) * (mib * MIB // 80)


FILES = [
    image("100 MB of cards in gzip", 422, "header-too-long", lambda: gzip.compress(long_header(100), 1)),
    image(
        "gzip that declares 300 GB",
        422,
        "three-axes",
        lambda: gzip.compress(primary(8, 10**5, 10**5, 30) + bytes(10**6)),
    ),
    image("a script", 415, "not-fits", lambda: b"#!/bin/sh\nrm -rf /\n" * 500),
    image("more than may be sent", 413, "too-large", lambda: b"SIMPLE  =" + bytes(9 * MIB)),
    image("nothing", 400, "empty-upload", lambda: b""),
    image("a cube", 422, "three-axes", lambda: primary(8, 8, 8, 2) + bytes(2880)),
]


# Archives -------------------------------------------------------------------------------------------

SMALL_FITS = primary(8, 8, 8) + bytes(2880)


MANIFEST = json.dumps(
    {
        "schema": "transit/1",
        "instrument": "hri_euv",
        "images": [{"file": "0.fits", "fov": 1, "x": 4.0, "y": 4.0, "r": 2.0}],
    }
).encode()


def zipped(*members: tuple[str, bytes]) -> bytes:
    """A .zip of these."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return file.getvalue()


def transit_zip(*more: tuple[str, bytes]) -> bytes:
    """The archive of a transit with more in it."""
    return zipped(("transit.json", MANIFEST), ("0.fits", SMALL_FITS), *more)


ARCHIVES = [
    transit("a name that climbs, zip", 422, "archive-climbs", lambda: transit_zip(("../x.fits", b"x"))),
    transit(
        "a zip of 100 MB of zeros",
        413,
        "archive-too-large",
        lambda: transit_zip(("b.fits", bytes(100 * MIB))),
    ),
    transit(
        "a transit.json of lists in lists", 422, "bad-manifest", lambda: zipped(("transit.json", b"[" * DEEP))
    ),
]


# Requests -------------------------------------------------------------------------------------------

FORM = {"Content-Type": "multipart/form-data; boundary=x"}
PART = b'--x\r\nContent-Disposition: form-data; name="%s"\r\n\r\n'


def form(
    name: str, content: bytes, kind: str = FORM["Content-Type"], code: str = "bad-form", to: str = "images"
) -> Attack:
    """An upload's form that is none."""
    return Attack(
        name, 400, code, address=f"/v1/{to}", headers={"Content-Type": kind}, content=lambda: content
    )


REQUESTS = [
    body("no JSON", 422, "invalid-request", b"kind=deconvolve"),
    body("lists in lists", 400, "http-400", b"[" * DEEP),
    body("a number of 5000 digits", 400, "http-400", b'{"kind":' + b"9" * 5000 + b"}"),
    body("no UTF-8", 400, "http-400", b'{"kind":"\xff\xfe"}'),
    body("half a character", 422, "invalid-request", b'{"kind":"\\ud800","parameters":{}}'),
    body(
        "NaN",
        422,
        "invalid-request",
        b'{"kind":"deconvolve","parameters":{"image_id":"%s","saturation_dn":NaN}}' % A.encode(),
    ),
    body("20 MB of JSON", 413, "too-large", b'"' + b"x" * 20 * MIB + b'"'),
    Attack(
        "JSON that says it is text",
        422,
        "invalid-request",
        content=lambda: b'{"kind":"psf-build"}',
        headers={"Content-Type": "text/plain"},
    ),
    job("a mask that was not uploaded", 404, "no-such-image", "psf-build", instrument="hri_euv", mask_id=A),
    job("no TOML", 422, "bad-instrument-file", "psf-build", instrument_file="= = ="),
    job(
        "an instrument that is a path",
        422,
        "unknown-instrument",
        "psf-build",
        instrument="../../../etc/passwd",
    ),
    job("an image that is a path", 422, "invalid-request", "deconvolve", image_id="../" * 20 + "etc/passwd"),
    job("an image that was not uploaded", 404, "no-such-image", "deconvolve", image_id=A),
    job("a transit that was not uploaded", 404, "no-such-transit", "psf-fit", transit_id=A),
    job("TOML: lists in lists", 422, "bad-instrument-file", "psf-build", instrument_file="a = " + "[" * DEEP),
    job(
        "TOML: tables in tables",
        422,
        "bad-instrument-file",
        "psf-build",
        instrument_file="a = " + "{b=" * DEEP,
    ),
    job(
        "TOML: a key of 30000 parts",
        422,
        "bad-instrument-file",
        "psf-build",
        instrument_file=".".join("a" * 30_000) + " = 1",
    ),
    job(
        "TOML: a number of 60000 digits",
        422,
        "bad-instrument-file",
        "psf-build",
        instrument_file="a = " + "9" * 60_000,
    ),
    form("a form without boundary", b"--x\r\n", kind="multipart/form-data"),
    form("a form with a boundary of 5000", b"--x\r\n", kind="multipart/form-data; boundary=" + "x" * 5000),
    form("a form without a file", PART % b"other" + b"1\r\n--x--\r\n"),
    form(
        "a form of 20000 parts", PART % b"other" + b"1\r\n" + 20_000 * (PART % b"o" + b"1\r\n") + b"--x--\r\n"
    ),
    form("a part with a name of 2 MB", PART % (b"n" * 2 * MIB) + b"1\r\n--x--\r\n"),
    form("a part with 200000 headers", b"--x\r\n" + b"A: b\r\n" * 200_000 + b"\r\n1\r\n--x--\r\n"),
    form("a form that breaks off", PART % b"file" + b"SIMPLE  =", code="upload-ended-early"),
    form("nothing as a form", b""),
    form(
        "a transit's form that breaks off",
        PART % b"file" + b"PK\3\4",
        code="upload-ended-early",
        to="transits",
    ),
    got("an address of nothing", 404, "http-404", "/v1/nothing"),
    got("an id of 5 letters", 422, "invalid-request", "/v1/transits/short"),
    got("an id that climbs", 404, "http-404", "/v1/images/..%2f..%2fetc%2fpasswd"),
    got("an id that climbs in a download", 404, "http-404", "/v1/products/..%2f..%2fcatalogue.sqlite/file"),
    got("an id with a line end", 422, "invalid-request", "/v1/images/%0d%0aSet-Cookie:x=1"),
    got("a page of nothing", 422, "invalid-request", "/v1/jobs?limit=0"),
    got("a phase there is not", 422, "invalid-request", "/v1/jobs?phase=SLEEPING"),
    got("a cursor of nonsense", 422, "bad-cursor", "/v1/transits?cursor=nonsense"),
    got("a cursor of NUL", 422, "bad-cursor", "/v1/jobs?cursor=MS4wIAA="),
    Attack(
        "a form with a codec of its own",
        415,
        "bad-form",
        address="/login",
        headers={"Content-Type": FORM["Content-Type"] + "; charset=undefined"},
        content=lambda: PART % b"key" + b"1\r\n--x--\r\n",
    ),
    got("a name of control letters", 422, "invalid-request", "/v1/psfs?name=%1b%5b31m"),
    got("a host of another's", 421, "host-not-served", "/v1/jobs", Host="evil.example"),
    Attack(
        "a page of another site",
        403,
        "cross-site",
        address="/v1/jobs",
        headers={"Origin": "http://evil.example"},
        content=lambda: b"{}",
    ),
    Attack("a word that is no method", 405, "http-405", "BREW", "/v1/jobs"),
    got("no key", 401, "no-key", "/v1/jobs", Authorization=""),
    got("a key of nonsense", 401, "bad-key", "/v1/jobs", Authorization="Bearer ' OR 1=1 --"),
    got("a key of a megabyte", 401, "bad-key", "/v1/jobs", Authorization="Bearer hpsf_" + "a" * MIB),
]
