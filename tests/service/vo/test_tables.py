"""Tables of the VO: lists of products and PSFs, DataLink, VOSI, and what the validators of STILTS say.
Cut-outs of products."""

from __future__ import annotations

import io
import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.io.votable import parse
from astropy.time import Time
from astropy.wcs import WCS
from fastapi.testclient import TestClient
from sqlalchemy import delete
from vo_models.vodataservice.models import TableSet
from vo_models.vosi.availability import Availability
from vo_models.vosi.capabilities import VOSICapabilities
from vo_models.vosi.tables.models import VOSITableSet

from psfcore.fits.blocks import FitsLimits
from psfcore.fits.viewing.regions import Region, write_cutout
from service.vo.interfaces import OFFERED
from service.vo.links import LINKS_TYPE, MOST_IDS
from service.vo.votables import OBSCORE, PRODUCTS, TABLES
from tests.service.conftest import execute
from tests.service.keyed import Keyed
from tests.service.vo.made import SHAPE, WCS_CARDS, add_product, pixels
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, PsfRow
from workers.settings import Settings


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
    many = shared_api.get("/vo/links?" + "&".join(["ID=x"] * (MOST_IDS + 1)))
    assert many.status_code == 400 and b"ERROR" in many.content
    assert b"expected ID, at most 200 of them; got '201 of them'" in many.content


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


# --- cut-outs --------------------------------------------------------------------------------------------


def cut(api: TestClient, identity: str, **fields: str) -> fits.HDUList:
    answer = api.get("/vo/cutout", params={"ID": identity, **fields})
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/fits"
    assert int(answer.headers["content-length"]) == len(answer.content)
    return fits.open(io.BytesIO(answer.content), checksum=True)


@pytest.fixture(scope="module")
def product(shared_api: TestClient, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The id of a product."""
    return add_product(shared_api, tmp_path_factory.mktemp("product"))["product"]


def test_the_smallest_rectangle_of_whole_pixels(shared_api: TestClient, product: str) -> None:
    for fields, columns, rows in (
        ({"circle": "40.4 30 2.2"}, (38, 43), (28, 32)),
        ({"BOX": "40 30 0.1 0.1", "FRAME": "pixel"}, (40, 40), (30, 30)),
        ({"POLYGON": "1 2 9 2 9 20"}, (1, 9), (2, 20)),
        ({"BOX": "0 0 8 8"}, (0, 4), (0, 4)),
        ({"CIRCLE": "64 48 1000"}, (0, SHAPE[1] - 1), (0, SHAPE[0] - 1)),
    ):
        part = (slice(rows[0], rows[1] + 1), slice(columns[0], columns[1] + 1))
        with cut(shared_api, product, **fields) as hdus:
            assert [hdu.name for hdu in hdus] == ["PRIMARY", "QUALITY", "ERROR"]
            for hdu, whole in zip(hdus, (pixels(), pixels() % 7, pixels() / 2), strict=True):
                np.testing.assert_array_equal(hdu.data, whole[part], err_msg=str(fields))
            assert hdus["QUALITY"].data.dtype == np.uint8
            assert "PXBEG1" not in hdus[0].header and "columns" in str(hdus[0].header["HISTORY"])


def test_a_pixel_keeps_its_place_on_the_sky(shared_api: TestClient, product: str) -> None:
    api = shared_api
    whole = WCS(fits.getheader(io.BytesIO(api.get(f"/v1/products/{product}/file").content)))
    x, y = 70, 20
    longitude, latitude = (float(n) * 3600 for n in whole.wcs_pix2world([[x, y]], 0)[0])
    radius = 3.0  # arcsec: 6 px
    fields = {"CIRCLE": f"{longitude!r} {latitude!r} {radius}", "FRAME": "helioprojective"}
    with cut(api, product, **fields) as hdus:
        ny, nx = hdus[0].shape
        assert hdus[0].data[ny // 2, nx // 2] == pixels()[y, x]
        assert (ny, nx) == (13, 13)
        for hdu in hdus:
            place = WCS(hdu.header).wcs_pix2world([[nx // 2, ny // 2]], 0)[0] * 3600
            np.testing.assert_allclose(place, (longitude, latitude), atol=1e-6)


def test_a_region_on_the_sky_is_inside_its_cutout(shared_api: TestClient, product: str) -> None:
    """Every pixel whose centre is in a rotated box on the sky is in the cut-out: compared with all pixels of the
    image."""
    api = shared_api
    header = fits.getheader(io.BytesIO(api.get(f"/v1/products/{product}/file").content))
    y, x = np.indices(SHAPE)
    sky = WCS(header).wcs_pix2world(np.column_stack((x.ravel(), y.ravel())), 0) * 3600
    centre, width, height = sky[50 * SHAPE[1] + 60], 8.0, 4.0
    inside = (abs(sky[:, 0] - centre[0]) <= width / 2) & (abs(sky[:, 1] - centre[1]) <= height / 2)
    box = f"{float(centre[0])!r} {float(centre[1])!r} {width} {height}"
    with cut(api, product, BOX=box, FRAME="helioprojective") as hdus:
        assert set(pixels().ravel()[inside]) <= set(hdus[0].data.ravel())
        diagonal = math.hypot(width, height) / 0.5
        assert max(hdus[0].shape) <= diagonal + 2


def test_cards_of_many_axes_do_not_reach_the_library_of_coordinates(tmp_path: Path) -> None:
    """A header with WCSAXES = 99999999 made it fill the memory, and then end its process."""
    good = {**WCS_CARDS, "CRPIX1": 32.5, "CRPIX2": 32.5, "CRVAL1": 0.0, "CRVAL2": 0.0}
    bad = {"WCSAXES": 99_999_999, "CTYPE9": "HPLN-TAN", "PV2_999": 1.0, "CD1_900": 2.0}
    fits.PrimaryHDU(pixels()[:64, :64], fits.Header(good | bad)).writeto(tmp_path / "p.fits")
    region = Region.circle("helioprojective", 0.0, 0.0, 1.9)
    with (tmp_path / "cut.fits").open("wb") as target:
        write_cutout(tmp_path / "p.fits", region, FitsLimits(max_pixels=4096), target)
    assert fits.getdata(tmp_path / "cut.fits").shape == (8, 8)


BAD: list[tuple[dict[str, str], int, str]] = [
    ({}, 400, "expected CIRCLE, BOX or POLYGON, exactly one of them; got none"),
    ({"CIRCLE": "1 2 3", "BOX": "1 2 3 4"}, 400, "exactly one of them; got 'CIRCLE and BOX'"),
    ({"CIRCLE": "1 2"}, 400, "expected CIRCLE, finite numbers: x y radius; got '1 2'"),
    ({"CIRCLE": "1 2 0"}, 400, "sizes above 0; got '1 2 0'"),
    ({"POLYGON": " ".join(["1"] * 300)}, 400, "with 3 to 100 corners"),
    ({"CIRCLE": "1 2 3", "FRAME": "icrs"}, 400, "expected FRAME, pixel or helioprojective; got 'icrs'"),
    ({"CIRCLE": "-50 2 3"}, 422, "expected a region with pixels of the image, 128 x 96 px"),
    ({"CIRCLE": "1 2 3", "FRAME": "helioprojective"}, 409, "give the region in pixels"),
    ({"CIRCLE": "1 2 3", "ID": "nothing"}, 404, "expected ID, the id of one of your products"),
    ({"CIRCLE": "1 2 3", "ID": ""}, 400, "expected ID, of one product; got none"),
]


def test_bad_requests(api: TestClient, tmp_path: Path) -> None:
    ids = add_product(api, tmp_path, wcs=False)
    for fields, status, said in BAD:
        answer = api.get("/vo/cutout", params={"ID": ids["product"], **fields})
        assert answer.status_code == status and said in answer.text, (fields, answer.text)
        assert answer.headers["content-type"].startswith("text/plain"), fields


def test_owners_and_caches(service: Keyed, settings: Settings, tmp_path: Path) -> None:
    mine, other = service.client("me"), service.client("other")
    product = add_product(mine, tmp_path, owner="me")["product"]
    query = {"ID": product, "CIRCLE": "9 9 3"}
    first = mine.get("/vo/cutout", params=query)
    again = mine.get("/vo/cutout", params=query, headers={"If-None-Match": first.headers["etag"]})
    assert (first.status_code, again.status_code) == (200, 304)
    assert other.get("/vo/cutout", params=query).status_code == 404
    assert service.api.get("/vo/cutout", params=query).status_code == 401
    assert list((settings.data_dir / "tmp").iterdir()) == [], "no temporary file is left"
    assert len(mine.get("/vo/products?responseformat=json").json()["rows"]) == 1
    for table in ("products", "psfs"):
        assert other.get(f"/vo/{table}?responseformat=json").json()["rows"] == []
    nobody = "0" * 64
    own, others = (client.get("/vo/links", params={"ID": product}).text for client in (mine, other))
    assert "NotFoundFault" not in own and "<TD>true</TD>" in own, "its links need a key"
    assert others.replace(product, nobody) == other.get("/vo/links", params={"ID": nobody}).text
