"""Lists of products and PSFs as VOTable and JSON."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from astropy.io.votable import parse
from astropy.time import Time
from fastapi.testclient import TestClient

from service.vo.columns import OBSCORE, PRODUCTS
from tests.service.vo.made import SHAPE, add_product


def table(content: bytes) -> tuple[Any, dict[str, str]]:
    """The rows, and the INFO elements, of a VOTable that astropy reads without a complaint."""
    votable = parse(io.BytesIO(content), verify="exception")
    [resource] = [one for one in votable.resources if one.type == "results"]
    return resource.tables[0].to_table(), {info.name: info.value for info in resource.infos}


def test_a_product_has_the_columns_of_obscore(api: TestClient, tmp_path: Path) -> None:
    ids = add_product(api, tmp_path)
    answer = api.get("/vo/products")
    assert answer.status_code == 200 and answer.headers["content-type"] == "application/x-votable+xml"
    rows, infos = table(answer.content)
    assert infos["QUERY_STATUS"] == "OK" and rows.colnames[: len(OBSCORE)] == [c.name for c in OBSCORE]
    [row] = rows
    assert row["obs_publisher_did"] == f"urn:heliopsf:product:{ids['product']}"
    assert (row["obs_id"], row["psf_id"], row["method"]) == (ids["image"], ids["psf"], "linear")
    assert (row["s_xel1"], row["s_xel2"]) == (SHAPE[1], SHAPE[0])
    start = Time("2022-03-17T04:02:00", scale="utc").mjd
    assert row["t_min"] == pytest.approx(start, abs=1e-9)
    assert (row["t_max"] - row["t_min"]) * 86400 == pytest.approx(2.0, abs=1e-4)
    assert row["em_min"] == row["em_max"] == pytest.approx(174e-10)
    assert row["s_fov"] == pytest.approx(SHAPE[1] * 0.5 / 3600)
    assert row["instrument_name"] == "HRI_EUV" and row["facility_name"] == "SOLO"
    assert row["artefact_score"] == 0.25
    file = api.get(row["file_url"])
    assert file.status_code == 200 and file.headers["etag"] == f'"{row["file_sha256"]}"'
    assert api.get(row["access_url"]).headers["content-type"] == row["access_format"]
    assert api.get(row["provenance_url"]).status_code == 200

    rows, _ = table(api.get("/vo/psfs").content)
    [row] = rows
    assert row["obs_publisher_did"] == f"urn:heliopsf:psf:{ids['psf']}" and row["status"] == "draft"
    told = api.get("/vo/products", params={"responseformat": "application/json"}).json()
    assert [column["name"] for column in told["columns"]] == [column.name for column in PRODUCTS.columns]
    [product] = told["rows"]
    assert (product["s_ra"], product["t_exptime"], told["status"], told["next"]) == (None, 2.0, "OK", None)


def test_pages(api: TestClient, tmp_path: Path) -> None:
    for number in (1, 2, 3):
        add_product(api, tmp_path, number=number)
    first, infos = table(api.get("/vo/products?MAXREC=2").content)
    assert infos["QUERY_STATUS"] == "OVERFLOW" and len(first) == 2
    second, last = table(api.get(infos["next"]).content)
    assert last["QUERY_STATUS"] == "OK" and "next" not in last
    listed = [row["obs_publisher_did"][-1] for row in (*first, *second)]
    assert listed == ["3", "2", "1"], "newest first, each once"
    none, infos = table(api.get("/vo/products?MAXREC=0").content)
    assert len(none) == 0 and infos["QUERY_STATUS"] == "OVERFLOW"
    assert table(api.post("/vo/products", data={"maxrec": "1"}).content)[1]["QUERY_STATUS"] == "OVERFLOW"


def test_errors_are_votables(shared_api: TestClient) -> None:
    for query, status, said in (
        ("MAXREC=-1", 400, "expected MAXREC, a whole number of 0 or more; got '-1'"),
        ("MAXREC=many", 400, "expected MAXREC, a whole number of 0 or more; got 'many'"),
        ("MAXREC=1&maxrec=2", 400, "expected MAXREC once; got it 2 times"),
        ("RESPONSEFORMAT=fits", 400, "expected RESPONSEFORMAT, votable or json; got 'fits'"),
        ("CURSOR=xyz", 422, "expected the cursor in the `next` address"),
    ):
        answer = shared_api.get(f"/vo/products?{query}")
        kind = answer.headers["content-type"]
        assert (answer.status_code, kind) == (status, "application/x-votable+xml"), query
        [info] = parse(io.BytesIO(answer.content)).resources[0].infos
        assert (info.name, info.value) == ("QUERY_STATUS", "ERROR") and said in info.content, query
