"""One table of bad requests: each is a clear 4xx, and leaves nothing behind."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

from tests.service.conftest import upload
from workers.settings import Settings


def as_fits(
    path: Path, *hdus: fits.PrimaryHDU | fits.ImageHDU | fits.BinTableHDU | fits.CompImageHDU
) -> bytes:
    fits.HDUList(list(hdus)).writeto(path)
    return path.read_bytes()


def header_only(**cards: object) -> bytes:
    text = fits.Header({"SIMPLE": True, "BITPIX": -32, **cards}).tostring()
    return text.encode()


def table_only(path: Path) -> bytes:
    table = fits.BinTableHDU.from_columns([fits.Column("A", "E", array=np.ones(3))])
    return as_fits(path, fits.PrimaryHDU(), table)


def three_axes(path: Path) -> bytes:
    return as_fits(path, fits.PrimaryHDU(np.zeros((3, 32, 32), "f4")))


def truncated(path: Path) -> bytes:
    return as_fits(path, fits.PrimaryHDU(np.ones((200, 200), "f4")))[:60_000]


def hcompress(path: Path) -> bytes:
    return as_fits(
        path,
        fits.PrimaryHDU(),
        fits.CompImageHDU(np.arange(4096, dtype="i2").reshape(64, 64), compression_type="HCOMPRESS_1"),
    )


def huge(_: Path) -> bytes:
    return header_only(NAXIS=2, NAXIS1=60_000, NAXIS2=60_000)


def huge_in_gzip(_: Path) -> bytes:
    return gzip.compress(huge(_) + bytes(2880 * 50))


FILES = [
    ("text", lambda _: b"This is not FITS, it is a letter.\n" * 200, 415, "not-fits"),
    ("empty", lambda _: b"", 400, "empty-upload"),
    ("starts like FITS", lambda _: b"SIMPLE  =" + b"x" * 5000, 422, None),
    ("shorter than a card", lambda _: b"SIMP", 422, None),
    ("truncated", truncated, 422, None),
    ("table only", table_only, 422, None),
    ("three axes", three_axes, 422, None),
    ("60000 x 60000 header", huge, 422, None),
    ("60000 x 60000 in gzip", huge_in_gzip, 422, None),
    ("codec not allowed", hcompress, 422, None),
    ("over the size limit", lambda _: b"SIMPLE  =" + bytes(3 * 2**20), 413, "too-large"),
]


@pytest.mark.parametrize("where", ["/v1/images", "/v1/psfs"])
@pytest.mark.parametrize(("make", "status", "code"), [f[1:] for f in FILES], ids=[f[0] for f in FILES])
def test_bad_files(
    api: TestClient, settings: Settings, tmp_path: Path, where: str, make, status: int, code: str | None
) -> None:
    content = make(tmp_path / "bad.fits")
    for options in ({"content": content}, {"files": {"file": ("bad.fits", content)}}):
        answer = api.post(where, **options)
        assert answer.status_code == status, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        problem = answer.json()
        assert problem["status"] == status and "expected" in problem["detail"]
        assert code is None or problem["type"] == f"urn:heliopsf:{code}"
    assert api.get(where).json()["items"] == []
    left = [p for folder in ("tmp", "blobs") for p in (settings.data_dir / folder).rglob("*") if p.is_file()]
    assert left == []


A = "a" * 64
JOBS = [
    ("no body", None, 422),
    ("a list", [], 422),
    ("no kind", {"parameters": {}}, 422),
    ("unknown kind", {"kind": "bake", "parameters": {}}, 422),
    ("no image", {"kind": "deconvolve", "parameters": {}}, 422),
    ("image id no hash", {"kind": "deconvolve", "parameters": {"image_id": "../x"}}, 422),
    ("image never uploaded", {"kind": "deconvolve", "parameters": {"image_id": A}}, 404),
    ("no steps", {"kind": "deconvolve", "parameters": {"image_id": A, "method": {"steps": 0}}}, 422),
    (
        "steps no number",
        {"kind": "deconvolve", "parameters": {"image_id": A, "method": {"steps": "many"}}},
        422,
    ),
    ("unknown method", {"kind": "deconvolve", "parameters": {"image_id": A, "method": {"name": "x"}}}, 422),
    ("unknown instrument", {"kind": "psf-build", "parameters": {"instrument": "hubble"}}, 422),
    ("instrument a path", {"kind": "psf-build", "parameters": {"instrument": "../../etc/passwd"}}, 422),
    ("no instrument", {"kind": "psf-build", "parameters": {}}, 422),
    (
        "two instruments",
        {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "instrument_file": "x"}},
        422,
    ),
    ("instrument no TOML", {"kind": "psf-build", "parameters": {"instrument_file": "= = ="}}, 422),
    ("instrument lacks keys", {"kind": "psf-build", "parameters": {"instrument_file": "name = 'x'"}}, 422),
    (
        "mask never uploaded",
        {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "mask_id": A}},
        404,
    ),
    (
        "unknown component",
        {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "component": "x"}},
        422,
    ),
    ("odd size", {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "size": 99}}, 422),
    ("size of a planet", {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "size": 10**9}}, 422),
]


@pytest.mark.parametrize(("body", "status"), [j[1:] for j in JOBS], ids=[j[0] for j in JOBS])
def test_bad_jobs(api: TestClient, body: object, status: int) -> None:
    answer = api.post("/v1/jobs", json=body)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["detail"]
    assert api.get("/v1/jobs").json()["items"] == []


@pytest.mark.parametrize(
    ("body", "suggested"),
    [
        ({"kind": "evaluate", "parameters": {"transit_id": "0" * 64}}, "report"),
        (
            {"kind": "deconvolve", "parameters": {"image_id": "0" * 64, "effects_picture": True}},
            "changes_picture",
        ),
        ({"kind": "psf-build", "parameters": {"instrumnt": "hri_euv"}}, "instrument"),
    ],
)
def test_an_unknown_name_gets_the_known_one(api: TestClient, body: object, suggested: str) -> None:
    refused = api.post("/v1/jobs", json=body)
    assert refused.status_code == 422
    assert f"did you mean '{suggested}'?" in refused.json()["detail"]
    assert any("did you mean" in error["message"] for error in refused.json()["errors"])


def test_an_image_of_an_unknown_instrument_asks_for_a_psf(api: TestClient, image_file: Path) -> None:
    body = {"kind": "deconvolve", "parameters": {"image_id": upload(api, image_file)}}
    answer = api.post("/v1/jobs", json=body)
    assert answer.status_code == 409
    assert "TEST" in answer.json()["detail"] and "psf_id" in answer.json()["detail"]
    body["parameters"]["psf_id"] = A  # type: ignore[index]
    assert api.post("/v1/jobs", json=body).status_code == 404


@pytest.mark.parametrize(
    ("method", "address", "status"),
    [
        ("GET", "/v1/nothing", 404),
        ("PUT", "/v1/jobs", 405),
        ("GET", "/v1/jobs/none", 422),
        ("GET", f"/v1/jobs/{A[:32]}", 404),
        ("GET", "/v1/jobs/%00", 422),
        ("GET", "/v1/psfs?name=%00", 422),
        ("POST", "/v1/psfs?name=a%00b", 422),
        ("GET", "/v1/jobs?cursor=MS4wIAA=", 422),
        ("DELETE", f"/v1/jobs/{A[:32]}", 404),
        ("GET", f"/v1/images/{A}", 404),
        ("GET", "/v1/images/short", 422),
        ("GET", f"/v1/transits/{A}", 404),
        ("GET", "/v1/transits/short", 422),
        ("GET", "/v1/transits?cursor=nonsense", 422),
        ("PUT", "/v1/transits", 405),
        ("GET", f"/v1/psfs/{A}", 404),
        ("GET", f"/v1/psfs/{A}/file", 404),
        ("GET", f"/v1/psfs/{A}/preview", 404),
        ("GET", f"/v1/products/{A}", 404),
        ("GET", f"/v1/products/{A}/file", 404),
        ("GET", f"/v1/products/{A}/preview", 404),
        ("GET", "/v1/jobs?limit=0", 422),
        ("GET", "/v1/jobs?limit=9999", 422),
        ("GET", "/v1/jobs?phase=SLEEPING", 422),
        ("GET", "/v1/jobs?cursor=nonsense", 422),
        ("GET", "/v1/jobs?cursor=%FF%00", 422),
        ("GET", "/v1/psfs?cursor=bmFuIHg=", 422),
    ],
)
def test_bad_addresses(api: TestClient, method: str, address: str, status: int) -> None:
    answer = api.request(method, address)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["detail"]


FORM = "multipart/form-data"


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        (FORM, b"--x\r\n"),
        (f"{FORM}; boundary=x", b"no boundary here"),
        (f"{FORM}; boundary=x", b""),
        (
            f"{FORM}; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="other"\r\n\r\nhello\r\n--x--\r\n',
        ),
        (f"{FORM}; boundary=x", b'--x\r\nContent-Disposition: form-data; name="file"\r\n\r\nSIMPLE  ='),
    ],
)
@pytest.mark.parametrize("where", ["/v1/images", "/v1/transits"])
def test_bad_forms(api: TestClient, where: str, kind: str, content: bytes) -> None:
    content = content.replace(b"SIMPLE  =", b"PK\3\4") if where == "/v1/transits" else content
    answer = api.post(where, content=content, headers={"Content-Type": kind})
    assert answer.status_code == 400, answer.text
    assert answer.json()["type"] in ("urn:heliopsf:bad-form", "urn:heliopsf:upload-ended-early")
