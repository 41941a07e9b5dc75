"""Transits over HTTP: uploaded, listed, described, and refused with a reason."""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from psfcore.errors import DataError
from psfcore.transit.archive import ArchiveLimits, pack, unpack
from service.app import create_app
from service.client.http import Client, ServiceError
from service.local import LocalService
from tests.service.conftest import upload
from tests.transit_files import READ_NOISE, write_transit
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, TransitRow
from workers.files.store import Store
from workers.settings import Settings

WHERE = "/v1/transits"
MIB = 2**20
Members = dict[str, bytes]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_transit(tmp_path / "mercury", images=4)


@pytest.fixture
def tight(settings: Settings) -> Iterator[TestClient]:
    """A service that takes 1 MiB, and lets 2 MiB come out of it."""
    limits = {"max_transit_mib": 1, "max_transit_unpacked_mib": 2}
    with TestClient(create_app(settings.model_copy(update=limits)), raise_server_exceptions=False) as client:
        yield client


def members_of(folder: Path) -> Members:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def as_zip(members: Members) -> bytes:
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as out:
            for name, content in members.items():
                out.writestr(name, content)
        return file.getvalue()


def as_tar(members: Members, mode: str = "w", links: tuple[str, ...] = ()) -> bytes:
    with io.BytesIO() as file:
        with tarfile.open(fileobj=file, mode=mode) as out:  # type: ignore[call-overload]
            for name, content in members.items():
                info = tarfile.TarInfo(name)
                info.size = len(content)
                out.addfile(info, io.BytesIO(content))
            for name in links:
                info = tarfile.TarInfo(name)
                info.type, info.linkname = tarfile.SYMTYPE, "/etc/passwd"
                out.addfile(info)
        return file.getvalue()


def as_tar_gz(members: Members) -> bytes:
    return as_tar(members, "w:gz")


def left(settings: Settings) -> list[Path]:
    return [p for part in ("tmp", "blobs") for p in (settings.data_dir / part).rglob("*") if p.is_file()]


# --- what is taken ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [as_zip, as_tar, as_tar_gz])
def test_a_transit_goes_in_and_is_described(
    api: TestClient, settings: Settings, folder: Path, tmp_path: Path, make: Callable[[Members], bytes]
) -> None:
    content = make(members_of(folder))
    answer = api.post(f"{WHERE}?filename=../mercury.zip", content=content)
    assert answer.status_code == 201, answer.text
    transit = answer.json()
    assert answer.headers["Location"] == f"{WHERE}/{transit['id']}"
    assert transit["id"] == hashlib.sha256(content).hexdigest() and transit["bytes"] == len(content)
    assert transit["archive"] == {as_zip: "zip", as_tar: "tar", as_tar_gz: "tar.gz"}[make]
    assert (transit["images"], transit["instrument"]) == (4, "hri_euv")
    assert transit["pointings"] == [{"fov": 1, "images": 3}, {"fov": 2, "images": 1}]
    assert transit["noise"] == READ_NOISE and transit["known_psf"] == "diffraction.fits"
    assert transit["filename"] == "mercury.zip"
    sizes = {name: len(data) for name, data in members_of(folder).items()}
    assert transit["files"] == [
        {"name": name, "bytes": sizes[name]}
        for name in ("000.fits", "001.fits", "002.fits", "003.fits", "diffraction.fits")
    ]
    assert transit["unpacked_bytes"] == sum(sizes.values())

    assert api.get(answer.headers["Location"]).json() == transit
    [listed] = api.get(WHERE).json()["items"]
    assert listed == {key: value for key, value in transit.items() if key != "files"}
    unpack(Store(settings.data_dir).path(transit["id"]), tmp_path / "out", settings.archive_limits)
    assert members_of(tmp_path / "out") == members_of(folder)

    form = api.post(WHERE, files={"file": ("again.zip", content)})
    assert form.status_code == 200 and form.json() == transit, "the same bytes are the same transit"


def test_optional_parts_of_a_transit(api: TestClient, tmp_path: Path) -> None:
    bare = write_transit(tmp_path / "bare", images=2, noise=None, known_psf=None, instrument=None)
    transit = api.post(WHERE, content=as_zip(members_of(bare))).json()
    assert (transit["noise"], transit["known_psf"], transit["instrument"]) == (None, None, None)


def test_transits_are_listed_a_page_at_a_time_newest_first(api: TestClient, tmp_path: Path) -> None:
    made = [
        api.post(WHERE, content=as_zip(members_of(write_transit(tmp_path / str(n), images=n)))).json()["id"]
        for n in (1, 2, 3)
    ]
    first = api.get(WHERE, params={"limit": 2}).json()
    second = api.get(first["next"]).json()
    assert [item["id"] for item in first["items"] + second["items"]] == made[::-1]
    assert second["next"] is None


def test_a_transit_is_no_image(api: TestClient, folder: Path) -> None:
    identity = api.post(WHERE, content=as_zip(members_of(folder))).json()["id"]
    assert api.get(f"/v1/images/{identity}").status_code == 404


def test_an_upload_larger_than_an_image_may_be(api: TestClient, settings: Settings, folder: Path) -> None:
    """Transits have a limit of their own."""
    content = as_tar({**members_of(folder), "more.bin": bytes(settings.max_upload_bytes)})
    assert api.post(WHERE, content=content).status_code == 201
    assert api.post("/v1/images", content=content).status_code in (413, 415)


# --- what is refused --------------------------------------------------------------------------------------


def without(name: str) -> Callable[[Members], Members]:
    return lambda members: {key: value for key, value in members.items() if key != name}


def having(name: str, content: bytes) -> Callable[[Members], Members]:
    return lambda members: {**members, name: content}


def nothing_in(key: str) -> Callable[[Members], Members]:
    def change(members: Members) -> Members:
        content = json.loads(members["transit.json"])
        content[key] = []
        return {**members, "transit.json": json.dumps(content).encode()}

    return change


@pytest.mark.parametrize(
    ("change", "status", "code", "told"),
    [
        (without("transit.json"), 422, "no-manifest", "transit.json"),
        (without("002.fits"), 422, "missing-file", "002.fits"),
        (without("diffraction.fits"), 422, "missing-file", "diffraction.fits"),
        (having("transit.json", b"{"), 422, "bad-manifest", "JSON"),
        (having("transit.json", b" " * 5 * MIB), 422, "bad-manifest", "bytes"),
        (nothing_in("images"), 422, "bad-manifest", "images"),
        (having("002.fits", b"a letter"), 422, "not-fits", "002.fits"),
        (having("../evil", b"x"), 422, "archive-climbs", "evil"),
        (having("/etc/evil", b"x"), 422, "archive-climbs", "evil"),
        (having("a/b/c.fits", b"x"), 422, "archive-not-plain", "a/b/c.fits"),
    ],
)
def test_archives_that_cannot_be_used(
    api: TestClient,
    settings: Settings,
    folder: Path,
    change: Callable[[Members], Members],
    status: int,
    code: str,
    told: str,
) -> None:
    for make in (as_zip, as_tar, as_tar_gz):
        refused(api, settings, make(change(members_of(folder))), status, code, told)


def refused(api: TestClient, settings: Settings, content: bytes, status: int, code: str, told: str) -> None:
    for options in ({"content": content}, {"files": {"file": ("a.zip", content)}}):
        answer = api.post(WHERE, **options)  # type: ignore[arg-type]
        assert answer.status_code == status, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        problem = answer.json()
        assert problem["type"] == f"urn:heliopsf:{code}" and problem["status"] == status
        assert "expected" in problem["detail"] and told in problem["detail"]
    assert api.get(WHERE).json()["items"] == []
    assert left(settings) == []


@pytest.mark.parametrize(
    ("content", "status", "code"),
    [
        (b"A letter, and no archive.\n" * 100, 415, "not-an-archive"),
        (b"SIMPLE  =" + bytes(5000), 415, "not-an-archive"),
        (b"PK", 415, "not-an-archive"),
        (bytes(2048), 415, "not-an-archive"),
        (gzip.compress(b"SIMPLE  =" + bytes(5000), mtime=0), 415, "not-an-archive"),
        (b"", 400, "empty-upload"),
        (b"PK\x03\x04" + bytes(5000), 422, "archive-broken"),
        (b"\x1f\x8b" + bytes(5000), 422, "archive-broken"),
    ],
    ids=["text", "image", "two-letters", "zeros", "gzipped-image", "nothing", "half-a-zip", "half-a-gzip"],
)
def test_files_that_are_not_archives_are_refused(
    api: TestClient, settings: Settings, content: bytes, status: int, code: str
) -> None:
    refused(api, settings, content, status, code, "expected")


def test_a_link_in_a_tar(api: TestClient, settings: Settings, folder: Path) -> None:
    content = as_tar(members_of(folder), links=("x.fits",))
    refused(api, settings, content, 422, "archive-not-plain", "x.fits")


def test_an_archive_that_stops_short(api: TestClient, settings: Settings, folder: Path) -> None:
    for make in (as_zip, as_tar, as_tar_gz):
        content = make(members_of(folder))
        refused(api, settings, content[: len(content) // 2], 422, "archive-broken", "expected")


def test_too_large_as_sent(tight: TestClient, settings: Settings, folder: Path) -> None:
    content = as_tar({**members_of(folder), "x.bin": bytes(MIB)})
    refused(tight, settings, content, 413, "too-large", str(MIB))


@pytest.mark.parametrize("make", [as_zip, as_tar_gz])
def test_too_large_as_it_comes_out(
    tight: TestClient, settings: Settings, folder: Path, make: Callable[[Members], bytes]
) -> None:
    content = make({**members_of(folder), "x.bin": bytes(40 * MIB)})
    assert len(content) < MIB
    refused(tight, settings, content, 413, "archive-too-large", str(2 * MIB))


def test_a_form_with_more_than_the_file(api: TestClient, folder: Path) -> None:
    bad = api.post(WHERE, files={"other": ("a.zip", as_zip(members_of(folder)))})
    assert bad.status_code == 400 and bad.json()["type"] == "urn:heliopsf:bad-form"


def test_images_are_still_images(api: TestClient, image_file: Path) -> None:
    upload(api, image_file)
    assert api.post(WHERE, content=image_file.read_bytes()).status_code == 415


# --- clients ----------------------------------------------------------------------------------------------


def test_a_client_sends_a_folder_or_an_archive(api: TestClient, folder: Path, tmp_path: Path) -> None:
    with Client("http://testserver", transport=api._transport) as sun:
        transit = sun.upload_transit(folder)
        assert transit["images"] == 4 and transit["filename"] == "mercury.tar"
        assert sun.upload_transit(str(folder))["id"] == transit["id"], "the same bytes each time"
        pack(folder, tmp_path / "own.tar")
        assert sun.upload_transit(tmp_path / "own.tar")["id"] == transit["id"]
        assert sun.get(f"{WHERE}/{transit['id']}") == transit
        (tmp_path / "letter.zip").write_text("a letter " * 50)
        with pytest.raises(ServiceError) as caught:
            sun.upload_transit(tmp_path / "letter.zip")
        assert (caught.value.status, caught.value.code) == (415, "not-an-archive")
        (folder / "001.fits").unlink()
        with pytest.raises(ServiceError, match=r"001\.fits") as caught:
            sun.upload_transit(folder)
        assert caught.value.code == "missing-file"


def test_the_local_service_takes_the_same(settings: Settings, api: TestClient, folder: Path) -> None:
    with Client("http://testserver", transport=api._transport) as sun:
        there = sun.upload_transit(folder)
    local = LocalService(Settings.apart(folder.parent / "local"))
    try:
        here = local.upload_transit(folder)
        assert here | {"created_at": 0} == there | {"created_at": 0}
        (folder / "letter.zip").write_text("a letter")
        with pytest.raises(DataError, match="not-an-archive"):
            local.upload_transit(folder / "letter.zip")
        catalogue = Catalogue(Settings.apart(folder.parent / "local").catalogue_url)
        row = catalogue.get(TransitRow, here["id"], DEFAULT_OWNER)
        assert row is not None and row.summary["images"] == 4
        catalogue.close()
    finally:
        local.close()


def test_the_limits_are_settings() -> None:
    settings = Settings(max_transit_mib=3, max_transit_unpacked_mib=5)
    assert settings.max_transit_bytes == 3 * MIB
    assert settings.archive_limits == ArchiveLimits(max_bytes=5 * MIB)
    defaults = Settings.model_fields
    assert (defaults["max_transit_mib"].default, defaults["max_transit_unpacked_mib"].default) == (4096, 8192)
