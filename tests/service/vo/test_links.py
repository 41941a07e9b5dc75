"""Cut-outs of products."""

from __future__ import annotations

import collections
import io
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from fastapi.testclient import TestClient
from httpx import Response
from sqlalchemy import update

from psfcore.fits.blocks import FitsLimits
from psfcore.fits.viewing.regions import Region, write_cutout
from tests.fits_bombs import padded
from tests.service.conftest import execute
from tests.service.keyed import Keyed
from tests.service.vo.made import OBSERVED, SHAPE, WCS_CARDS, add_product, pixels
from workers.catalogue.tables import ProductRow
from workers.settings import Settings


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
        ({"CIRCLE": "40 30 2"}, (38, 42), (28, 32)),
        ({"circle": "40.4 30 2.2"}, (38, 43), (28, 32)),
        ({"BOX": "40 30 5 3"}, (38, 42), (29, 31)),
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
    """Every pixel whose centre is in a rotated box on the sky is in the cut-out: compared with all pixels of the image."""
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
    good = {
        "CTYPE1": "HPLN-TAN",
        "CTYPE2": "HPLT-TAN",
        "CDELT1": 0.5,
        "CDELT2": 0.5,
        "CRPIX1": 32.5,
        "CRPIX2": 32.5,
    }
    units = {"CUNIT1": "arcsec", "CUNIT2": "arcsec"}
    bad = {"WCSAXES": 99_999_999, "CTYPE9": "HPLN-TAN", "PV2_999": 1.0, "CD1_900": 2.0}
    fits.PrimaryHDU(pixels()[:64, :64], fits.Header(good | units | bad)).writeto(tmp_path / "p.fits")
    region = Region.circle("helioprojective", 0.0, 0.0, 1.9)
    with (tmp_path / "cut.fits").open("wb") as target:
        write_cutout(tmp_path / "p.fits", region, FitsLimits(max_pixels=4096), target)
    assert fits.getdata(tmp_path / "cut.fits").shape == (8, 8)


KEYWORDS = (
    *("WCSAXES", "WCSNAME", "RADESYS", "EQUINOX", "LONPOLE", "LATPOLE", "MJD-OBS", "MJDREF", "DATE-OBS", "DATE-BEG", "DATEREF"),
    *("DSUN_OBS", "HGLN_OBS", "HGLT_OBS", "RSUN_REF", "RSUN_OBS", "CROTA1", "CROTA2", "TIMESYS", "TREFPOS", "OBSGEO-X"),
    *("A_ORDER", "B_ORDER", "AP_ORDER", "A_2_0", "B_0_3", "CPDIS1", "DP1", "D2IMDIS1", "PS1_0", "PV1_1", "PV2_3", "PV2_99"),
    *(f"{name}{axis}{version}" for name in ("CTYPE", "CUNIT", "CRPIX", "CRVAL", "CDELT", "CNAME", "CRDER", "CZPHS")
      for axis in (1, 2, 3, 99) for version in ("", "A")),
    *(f"{name}{i}_{j}" for name in ("PC", "CD") for i in (1, 2, 3) for j in (1, 2, 99)),
)  # fmt: skip
VALUES = (
    *("0", "1", "-1", "2", "3", "99", "0.5", "-0.0", "1E300", "-1E300", "1E-300", "1E400", "99999999", "20000", "-2147483648", "NaN"),
    *("T", "", "(1,2)", "'HPLN-TAN'", "'HPLT-TAN'", "'HPLN-SIP'", "'RA---TPV'", "'HPLN-ZPN'", "'HPLT-CAR'", "'STOKES'", "'TIME'"),
    *("'FREQ-LOG'", "'WAVE-TAB'", "'LINEAR'", "'arcsec'", "'deg'", "'m'", "'furlong'", "'sqrt(deg)**9'", "'10**400 m'", "''", "'open"),
    *("'2022-03-17T04:02:00.000'", "'0000-00-00'", "'99999-01-01T00:00:00'", "'HELIOPROJECTIVE'", "'\x7f'", "'%s%n'", "'TABULAR: 1'"),
)  # fmt: skip


def damaged_places(seed: int) -> bytes:
    """A product with good cards of its places, then a hundred cards of places with any value."""
    rng = np.random.default_rng(seed)
    good = fits.Header({**OBSERVED, **WCS_CARDS}).tostring(endcard=False, padding=False)
    first = "".join(
        f"{key:8}= {value:>20}".ljust(80)
        for key, value in {"SIMPLE": "T", "BITPIX": -32, "NAXIS": 2, "NAXIS1": 128, "NAXIS2": 96}.items()
    )
    bad = "".join(
        f"{rng.choice(KEYWORDS):8}= {rng.choice(VALUES):>20}".ljust(80)[:80]
        for _ in range(100 if seed % 2 else 3)
    )
    header = first + good + bad + "END".ljust(80)
    data = pixels().astype(">f4").tobytes()
    return padded(header.encode(), b" ") + padded(data, b"\0")


def asked(api: TestClient, content: bytes, folder: Path, product: str) -> Iterator[Response]:
    """The answer of each address that reads the cards of a file, as an image and as the file of a product."""
    yield (sent := api.post("/v1/images", content=content))
    if sent.status_code == 201:
        for address in ("", "/header", "/pixels", "/psf"):
            yield api.get(f"/v1/images/{sent.json()['id']}{address}")
    state = api.app.state.heliopsf
    (folder / "damaged.fits").write_bytes(content)
    digest = state.store.keep(folder / "damaged.fits")
    execute(state.catalogue, update(ProductRow).values(file_sha256=digest, bytes=len(content)))
    for address in ("", "/header", "/pixels", "/file", "/provenance"):
        yield api.get(f"/v1/products/{product}{address}")
    for frame in ("pixel", "helioprojective"):
        yield api.get("/vo/cutout", params={"ID": product, "CIRCLE": "100 -50 9", "FRAME": frame})
    yield api.get("/vo/products", params={"POS": "CIRCLE 0 0 1"})


@pytest.mark.parametrize("headers", [4, pytest.param(200, marks=pytest.mark.slow)])
def test_cards_of_places_with_any_value(api: TestClient, tmp_path: Path, headers: int) -> None:
    product, answers = add_product(api, tmp_path)["product"], collections.Counter[int]()
    for seed in range(headers):
        for answer in asked(api, damaged_places(seed), tmp_path, product):
            assert answer.status_code < 500, (seed, answer.url, answer.text)
            answers[answer.status_code] += 1
    assert {200, 201, 422} <= set(answers), answers


BAD: list[tuple[dict[str, str], int, str]] = [
    ({}, 400, "expected CIRCLE, BOX or POLYGON, exactly one of them; got none"),
    ({"CIRCLE": "1 2 3", "BOX": "1 2 3 4"}, 400, "exactly one of them; got 'CIRCLE and BOX'"),
    ({"CIRCLE": "1 2"}, 400, "expected CIRCLE, finite numbers: x y radius; got '1 2'"),
    ({"CIRCLE": "1 2 nan"}, 400, "expected CIRCLE, finite numbers"),
    ({"CIRCLE": "1 2 0"}, 400, "sizes above 0; got '1 2 0'"),
    ({"BOX": "1 2 3 -4"}, 400, "sizes above 0"),
    ({"POLYGON": "1 2 3 4"}, 400, "expected POLYGON, finite numbers"),
    ({"POLYGON": " ".join(["1"] * 300)}, 400, "with 3 to 100 corners"),
    ({"CIRCLE": "1 2 3", "FRAME": "icrs"}, 400, "expected FRAME, pixel or helioprojective; got 'icrs'"),
    ({"CIRCLE": "-50 2 3"}, 422, "expected a region with pixels of the image, 128 x 96 px"),
    ({"CIRCLE": "1 2 3", "FRAME": "helioprojective"}, 409, "give the region in pixels"),
    (
        {"CIRCLE": "1 2 3", "ID": "nothing"},
        404,
        "expected ID, the id of one of your products; got 'nothing'",
    ),
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
