"""Pixels and headers over HTTP are those of the file."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from fastapi.testclient import TestClient
from httpx import Response

from service.api import pixels as of_files
from service.http.state import State
from tests.conftest import write_image
from tests.service.conftest import refusal, result_of, upload
from tests.service.vo.made import add_product
from workers.files.store import Store
from workers.settings import Settings


@pytest.fixture
def decodings(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the planes that were decoded."""
    names: list[str] = []
    really = of_files.decode_plane

    def counted(path: Any, name: str, *given: Any) -> Any:
        names.append(name)
        return really(path, name, *given)

    monkeypatch.setattr(of_files, "decode_plane", counted)
    return names


def numbers(answer: Response) -> np.ndarray:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/octet-stream"
    shape = tuple(map(int, answer.headers["x-pixels-shape"].split(",")))
    return np.frombuffer(answer.content, "<f4").reshape(shape)


def test_overview_all_pixels_and_a_window_decode_once(
    api: TestClient, image_file: Path, decodings: list[str]
) -> None:
    where = f"/v1/images/{upload(api, image_file)}/pixels"
    stored = fits.getdata(image_file)
    overview = api.get(where, params={"step": 4})
    expected = stored.astype(float).reshape(24, 4, 32, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(numbers(overview), expected, rtol=2**-23)
    assert overview.headers["x-plane-shape"] == "96,128" and overview.headers["x-pixels-unit"] == "DN/s"
    whole = api.get(where)
    np.testing.assert_array_equal(numbers(whole), stored)
    assert int(whole.headers["content-length"]) == stored.nbytes
    window = api.get(where, params={"x": 100, "y": 90, "width": 20, "height": 5})
    np.testing.assert_array_equal(numbers(window), stored[90:95, 100:120])
    assert decodings == ["image"]

    # An answer is kept by the client, and counts as a read.
    first = api.get(where, params={"step": 2})
    tag = first.headers["etag"]
    assert "immutable" in first.headers["cache-control"]
    again = api.get(where, params={"step": 2}, headers={"If-None-Match": tag})
    assert (again.status_code, again.content) == (304, b"") and again.headers["etag"] == tag
    others = [{}, {"step": 3}, {"step": 2, "x": 1}, {"step": 2, "height": 9}]
    assert len({tag, *(api.get(where, params=one).headers["etag"] for one in others)}) == 5
    left = [int(api.get(where).headers["ratelimit"].split("r=")[1].split(";")[0]) for _ in range(2)]
    assert left[0] - left[1] == 1


def test_the_planes_and_headers_of_a_product(
    api: TestClient, image_file: Path, psf_file: Path, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    product = result_of(
        api,
        run_jobs,
        "deconvolve",
        image_id=upload(api, image_file),
        psf_id=upload(api, psf_file, "/v1/psfs"),
        noise={"photon_gain_dn": 2.0, "read_noise_dn": 1.0},
        error_draws=2,
        method={"name": "richardson-lucy", "steps": 1},
    )
    (tmp_path / "p.fits").write_bytes(api.get(product["file"]).content)
    where = f"/v1/products/{product['id']}/pixels"
    quality = fits.getdata(tmp_path / "p.fits", "QUALITY")
    assert len(np.unique(quality)) > 1
    for plane, stored in (
        ("image", fits.getdata(tmp_path / "p.fits", 0)),
        ("error", fits.getdata(tmp_path / "p.fits", "ERROR")),
        ("quality", quality),
    ):
        answer = api.get(where, params={"plane": plane})
        np.testing.assert_array_equal(numbers(answer), stored)
        assert answer.headers.get("x-pixels-unit") == (None if plane == "quality" else "DN/s")
    union = np.bitwise_or.reduce(quality.reshape(24, 4, 32, 4), axis=(1, 3))
    np.testing.assert_array_equal(numbers(api.get(where, params={"plane": "quality", "step": 4})), union)
    listed = api.get(f"/v1/products/{product['id']}/header").json()
    names = [(one["index"], one["name"]) for one in listed]
    assert names == [(0, "PRIMARY"), (1, "QUALITY"), (2, "ERROR")]
    assert [one["cards"] for one in listed] == cards_of(tmp_path / "p.fits")
    answer = api.get(f"/v1/images/{product['image_id']}/header")
    assert [one["cards"] for one in answer.json()] == cards_of(image_file)
    again = api.get(
        f"/v1/images/{product['image_id']}/header", headers={"If-None-Match": answer.headers["etag"]}
    )
    assert again.status_code == 304 and "immutable" in again.headers["cache-control"]


def cards_of(path: Path) -> list[list[list[object]]]:
    with fits.open(path) as hdus:
        return [[[c.keyword, c.value, c.comment] for c in hdu.header.cards] for hdu in hdus]


def test_requests_that_cannot_be_answered(api: TestClient, image_file: Path, tmp_path: Path) -> None:
    image_id = upload(api, image_file)
    where = f"/v1/images/{image_id}/pixels"
    detail = refusal(api.get(where, params={"x": 100, "width": 29}), 422, "window-outside")
    assert "plane of 128 x 96 px" in detail and "x 100, y 0, width 29, height 96" in detail
    assert "'image'" in refusal(api.get(where, params={"plane": "quality"}), 422, "invalid-request")
    for wrong in ({"step": 0}, {"x": -1}, {"width": 0}, {"height": "all"}):
        refusal(api.get(where, params=wrong), 422, "invalid-request")
    refusal(api.get(f"/v1/images/{'f' * 64}/pixels"), 404, "no-such-image")
    refusal(api.get(f"/v1/products/{'f' * 64}/pixels"), 404, "no-such-product")
    product = f"/v1/products/{add_product(api, tmp_path)['product']}"
    detail = refusal(api.get(f"{product}/pixels", params={"plane": "other"}), 422, "invalid-request")
    assert "'quality'" in detail


def test_a_damaged_file_is_not_decoded(api: TestClient, image_file: Path, settings: Settings) -> None:
    image_id = upload(api, image_file)
    path = Store(settings.data_dir).path(image_id)
    content = bytearray(path.read_bytes())
    content[-3000] ^= 1  # the same size
    path.write_bytes(content)
    refusal(api.get(f"/v1/images/{image_id}/pixels"), 410, "file-damaged")


def test_clients_at_once_get_the_same_pixels_of_one_decoding(
    api: TestClient, tmp_path: Path, decodings: list[str]
) -> None:
    write_image(tmp_path / "i.fits", shape=(256, 256))
    plain = (tmp_path / "i.fits").read_bytes()
    (tmp_path / "i.fits.gz").write_bytes(gzip.compress(plain))
    image_id = upload(api, tmp_path / "i.fits.gz")
    stored = fits.getdata(tmp_path / "i.fits")
    with ThreadPoolExecutor(8) as pool:
        for answer in pool.map(lambda _: api.get(f"/v1/images/{image_id}/pixels"), range(8)):
            np.testing.assert_array_equal(numbers(answer), stored)
    assert decodings == ["image"]
    state: State = api.app.state.heliopsf
    assert list((state.settings.data_dir / "tmp").iterdir()) == []
