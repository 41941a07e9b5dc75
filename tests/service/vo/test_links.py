"""DataLink tables."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from astropy.io.votable import parse
from fastapi.testclient import TestClient
from sqlalchemy import delete

from service.vo.links import LINKS_TYPE, MOST_IDS
from tests.service.conftest import execute
from tests.service.vo.made import add_product
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, PsfRow


def links(api: TestClient, *ids: str) -> tuple[list[dict[str, Any]], Any]:
    """The rows, and the whole VOTable, which astropy reads without a complaint."""
    answer = api.get("/vo/links", params={"ID": list(ids)})
    assert answer.status_code == 200 and answer.headers["content-type"] == LINKS_TYPE
    votable = parse(io.BytesIO(answer.content), verify="exception")
    table = votable.resources[0].tables[0].to_table()
    rows = [{name: str(row[name]) for name in table.colnames} for row in table]
    return rows, votable


def test_every_link_of_a_product_leads_to_what_it_says(api: TestClient, tmp_path: Path) -> None:
    ids = add_product(api, tmp_path)
    rows, votable = links(api, ids["product"])
    assert {(row["semantics"], row["local_semantics"]) for row in rows} == {
        ("#this", "file"),
        ("#preview", "preview"),
        ("#preview-image", "thumbnail"),
        ("#calibration", "psf"),
        ("#calibration", "psf-links"),
        ("#progenitor", "input"),
        ("#auxiliary", "provenance"),
        ("#cutout", "cutout"),
    }
    for row in rows:
        assert row["ID"] == ids["product"] and row["error_message"] == "" and row["link_auth"] == "false"
        # DataLink: exactly one of these three.
        assert [bool(row[name]) for name in ("access_url", "service_def", "error_message")].count(True) == 1
        if row["access_url"]:
            answer = api.get(row["access_url"])
            assert answer.status_code == 200, row
            assert answer.headers["content-type"].partition("; charset")[0] == row["content_type"]
            if row["content_length"].isdecimal():
                assert int(row["content_length"]) == len(answer.content)
    [service] = [one for one in votable.resources if one.utype == "adhoc:service"]
    [named] = [row["service_def"] for row in rows if row["service_def"]]
    assert named == service.ID
    given = {param.name: param.value for param in service.params}
    assert given["accessURL"] == "http://testserver/vo/cutout"
    inputs = {param.name for param in service.groups[0].entries}
    assert inputs == {"ID", "CIRCLE", "BOX", "POLYGON", "FRAME"}


def test_several_ids_of_both_kinds_and_unknown_ones(api: TestClient, tmp_path: Path) -> None:
    ids = add_product(api, tmp_path, thumbnail_sha256=None)
    psf = f"urn:heliopsf:psf:{ids['psf']}"
    rows, _ = links(
        api, "nothing", f"urn:heliopsf:product:{ids['product']}", psf, f"urn:heliopsf:psf:{ids['product']}"
    )
    unknown = [row for row in rows if row["error_message"]]
    assert [row["ID"] for row in unknown] == ["nothing", f"urn:heliopsf:psf:{ids['product']}"]
    assert all(row["error_message"].startswith("NotFoundFault: expected the id") for row in unknown)
    assert {row["local_semantics"] for row in rows if row["ID"] == psf} == {"file", "provenance"}
    assert "thumbnail" not in {row["local_semantics"] for row in rows}
    empty, votable = links(api)
    assert empty == [] and votable.resources[0].infos[0].value == "OK"
    posted = api.post("/vo/links", data={"ID": [ids["product"], ids["psf"]]})
    assert posted.status_code == 200 and posted.content.count(b"#this") == 2


def test_an_input_and_a_psf_that_are_not_there_are_rows_with_an_error(
    api: TestClient, catalogue: Catalogue, tmp_path: Path
) -> None:
    ids = add_product(api, tmp_path)
    for row in (ImageRow, PsfRow):
        execute(catalogue, delete(row))
    rows, _ = links(api, ids["product"])
    faults = {row["local_semantics"]: row["error_message"] for row in rows if row["error_message"]}
    assert set(faults) == {"input", "psf"} and "archive" in faults["input"] and "deleted" in faults["psf"]
    listed = api.get("/vo/products?responseformat=json").json()["rows"][0]
    assert listed["t_min"] is None and listed["s_xel1"] is None


def test_what_cannot_be_answered_is_a_votable_too(shared_api: TestClient) -> None:
    [row], _ = links(shared_api, "\x01\u00e9<&\ud7ff")  # XML cannot contain it
    assert row["ID"] == "?\\xe9<&\\ud7ff" and row["error_message"]
    refused = shared_api.get("/vo/links", params={"RESPONSEFORMAT": "\x01<"})
    assert parse(io.BytesIO(refused.content)).resources[0].infos[0].value == "ERROR"
    for query, said in (
        ("RESPONSEFORMAT=json", b"expected RESPONSEFORMAT, votable; got 'json'"),
        ("&".join(["ID=x"] * (MOST_IDS + 1)), b"expected ID, at most 200 of them; got '201 of them'"),
    ):
        answer = shared_api.get(f"/vo/links?{query}")
        assert answer.status_code == 400 and said in answer.content and b"ERROR" in answer.content
