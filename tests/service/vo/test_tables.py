"""Tables of the VO: lists of products and PSFs, DataLink, VOSI, and what the validators of STILTS say."""

from __future__ import annotations

import io
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from astropy.io.votable import parse
from astropy.time import Time
from fastapi.testclient import TestClient
from sqlalchemy import delete
from vo_models.vodataservice.models import TableSet
from vo_models.vosi.availability import Availability
from vo_models.vosi.capabilities import VOSICapabilities
from vo_models.vosi.tables.models import VOSITableSet

from service.vo.interfaces import OFFERED
from service.vo.links import LINKS_TYPE, MOST_IDS
from service.vo.votables import OBSCORE, PRODUCTS, TABLES
from tests.service.conftest import execute
from tests.service.keyed import Keyed
from tests.service.vo.made import SHAPE, add_product
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, PsfRow


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


def test_availability(api: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "needed", lambda *_: {})  # the worker of a test does not announce itself
    answer = api.get("/vo/availability")
    assert answer.headers["content-type"].startswith("text/xml")
    found = Availability.from_xml(answer.content)
    assert found.available and found.up_since is not None and not found.note

    def broken(*_: object) -> dict[str, Callable[[], None]]:
        def away() -> None:
            raise checks.Unusable("the broker does not answer")

        return {"broker": away}

    monkeypatch.setattr(checks, "needed", broken)
    found = Availability.from_xml(api.get("/vo/availability").content)
    assert not found.available and found.note == ["the broker does not answer"]
    assert api.get("/readyz").status_code == 503, "both read the same checks"


def test_capabilities_name_addresses_that_answer(api: TestClient) -> None:
    found = VOSICapabilities.from_xml(api.get("/vo/capabilities").content)
    addresses = {
        str(one.standard_id): str(one.interface[0].access_url[0].value)  # type: ignore[index]
        for one in found.capability
    }
    assert set(addresses) == {one.standard_id for one in OFFERED}
    for standard, address in addresses.items():
        assert address.startswith("http://testserver/")
        status = 400 if standard == "urn:heliopsf:cutout" else 200  # a cut-out without parameters
        assert api.get(address).status_code == status, standard


def test_a_service_with_keys_shows_its_interfaces_to_everybody(service: Keyed) -> None:
    for name in ("availability", "capabilities", "tables"):
        assert service.api.get(f"/vo/{name}").status_code == 200
    found = VOSICapabilities.from_xml(service.api.get("/vo/capabilities").content)
    for one in found.capability:
        [interface] = one.interface or []
        needs_key = "VOSI" not in str(one.standard_id)
        assert bool(interface.security_method) == needs_key
        if needs_key:
            refused = service.api.get(str(interface.access_url[0].value))
            assert refused.status_code == 401 and "Basic" in refused.headers["WWW-Authenticate"]


def test_tables_list_every_column(api: TestClient) -> None:
    found: TableSet = VOSITableSet.from_xml(api.get("/vo/tables").content)
    [schema] = found.tableset_schema
    assert schema.table is not None
    named = {table.table_name: [c.column_name for c in table.column or []] for table in schema.table}
    assert named == {table.name: [column.name for column in table.columns] for table in TABLES}


STILTS = shutil.which("stilts")
needs_stilts = pytest.mark.skipif(STILTS is None, reason="needs stilts (apt-get install stilts)")


def judged(task: str, path: Path) -> list[str]:
    """The errors and warnings that a validator finds in a file."""
    assert STILTS is not None
    done = subprocess.run([STILTS, task, path], capture_output=True, text=True, timeout=600)
    lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    return [line for line in lines if line.startswith(("E-", "W-", "F-", "ERROR", "WARNING", "Error"))]


def documents(api: TestClient, folder: Path) -> dict[str, Path]:
    """A file for every kind of VOTable that the service sends."""
    ids = add_product(api, folder)
    add_product(api, folder, number=2, thumbnail_sha256=None)
    addresses = {
        "products": "/vo/products",
        "page": "/vo/products?MAXREC=1",
        "columns": "/vo/products?MAXREC=0",
        "psfs": "/vo/psfs",
        "links": f"/vo/links?ID={ids['product']}&ID={ids['psf']}&ID=nothing",
        "no-links": "/vo/links",
        "error": "/vo/products?MAXREC=-1",
    }
    written = {}
    for name, address in addresses.items():
        written[name] = folder / f"{name}.xml"
        written[name].write_bytes(api.get(address).content)
    return written


@pytest.mark.slow
@needs_stilts
def test_votlint_and_datalinklint_find_nothing(api: TestClient, tmp_path: Path) -> None:
    written = documents(api, tmp_path)
    found = {name: judged("votlint", path) for name, path in written.items()}
    assert found == {name: [] for name in written}
    for name in ("links", "no-links"):
        assert judged("datalinklint", written[name]) == [], name


@pytest.mark.slow
@needs_stilts
def test_the_validators_find_what_is_wrong(api: TestClient, tmp_path: Path) -> None:
    """A test of the test: a wrong document is noticed."""
    path = documents(api, tmp_path)["links"]
    path.write_text(path.read_text().replace("#this", "#that").replace('name="ID"', 'name="IDS"'))
    assert judged("datalinklint", path)
    path.write_text(path.read_text().replace('datatype="long"', 'datatype="integer"'))
    assert judged("votlint", path)
