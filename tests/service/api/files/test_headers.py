"""All headers over HTTP."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from astropy.io import fits
from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.service.conftest import upload


def cards_of(path: Path) -> list[list[list[object]]]:
    with fits.open(path) as hdus:
        return [[[c.keyword, c.value, c.comment] for c in hdu.header.cards] for hdu in hdus]


def test_the_header_of_an_upload(api: TestClient, tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits", OBSERVER="who", LONG="x" * 90)
    with fits.open(tmp_path / "i.fits", mode="update") as hdus:
        hdus[0].header.add_history("was calibrated")
        hdus[0].header.add_comment("looks good")
    where = f"/v1/images/{upload(api, tmp_path / 'i.fits')}/header"
    answer = api.get(where)
    (listed,) = answer.json()
    assert (listed["index"], listed["name"]) == (0, "PRIMARY")
    assert [listed["cards"]] == cards_of(tmp_path / "i.fits")
    assert ["HISTORY", "was calibrated", ""] in listed["cards"]
    again = api.get(where, headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304 and "immutable" in again.headers["cache-control"]
    assert api.get(f"/v1/images/{'f' * 64}/header").status_code == 404
    assert api.get(f"/v1/products/{'f' * 64}/header").status_code == 404


def test_the_headers_of_a_product(
    api: TestClient, image_file: Path, psf_file: Path, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    parameters = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters}).json()
    run_jobs()
    product = api.get(f"/v1/jobs/{job['id']}").json()["result"]
    (tmp_path / "p.fits").write_bytes(api.get(f"{product}/file").content)
    listed = api.get(f"{product}/header").json()
    assert [(one["index"], one["name"]) for one in listed] == [(0, "PRIMARY"), (1, "QUALITY")]
    assert [one["cards"] for one in listed] == cards_of(tmp_path / "p.fits")
