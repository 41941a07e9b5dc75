"""Uploaded images are given back as they came."""

from __future__ import annotations

import gzip
import hashlib
from pathlib import Path

from fastapi.testclient import TestClient


def test_the_file_of_an_upload_is_what_was_sent(api: TestClient, image_file: Path) -> None:
    plain = image_file.read_bytes()
    for content, name, media_type in (
        (plain, "solar image.fits", "application/fits"),
        (gzip.compress(plain), None, "application/gzip"),
    ):
        where = "/v1/images"
        if name is None:
            sent = api.post(where, content=content, headers={"Content-Type": "application/fits"})
        else:
            sent = api.post(where, files={"file": (name, content, "application/fits")})
        image_id = sent.json()["id"]
        got = api.get(f"/v1/images/{image_id}/file")
        assert got.content == content
        assert got.headers["content-type"] == media_type
        assert got.headers["etag"] == f'"{hashlib.sha256(content).hexdigest()}"'
        expected = "solar%20image.fits" if name else f"image-{image_id[:12]}.fits.gz"
        assert expected in got.headers["content-disposition"]
        known = api.get(f"/v1/images/{image_id}/file", headers={"If-None-Match": got.headers["etag"]})
        assert known.status_code == 304
    missing = api.get(f"/v1/images/{'f' * 64}/file")
    assert (missing.status_code, missing.json()["type"]) == (404, "urn:heliopsf:no-such-image")
