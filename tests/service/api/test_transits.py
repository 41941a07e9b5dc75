"""Transits over HTTP: what an upload accepts and describes, and fits to a transit."""

from __future__ import annotations

import hashlib
import io
import tarfile
import zipfile
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from httpx import Response

from psfcore.transit.archive import pack, unpack
from service.app import create_app
from service.client.http import Client, ServiceError
from tests.service.conftest import refusal, upload
from tests.transit_files import READ_NOISE, write_transit
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import PsfRow
from workers.files.store import Store
from workers.settings import Settings

WHERE = "/v1/transits"
MIB = 2**20
Members = dict[str, bytes]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_transit(tmp_path / "mercury", images=4)


def members_of(folder: Path) -> Members:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def as_zip(members: Members) -> bytes:
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as out:
            for name, content in members.items():
                out.writestr(name, content)
        return file.getvalue()


def as_tar(members: Members) -> bytes:
    with io.BytesIO() as file:
        with tarfile.open(fileobj=file, mode="w") as out:
            for name, content in members.items():
                info = tarfile.TarInfo(name)
                info.size = len(content)
                out.addfile(info, io.BytesIO(content))
        return file.getvalue()


# --- what is taken ----------------------------------------------------------------------------------------


def test_a_transit_goes_in_and_is_described(
    api: TestClient, settings: Settings, folder: Path, tmp_path: Path
) -> None:
    content = as_zip(members_of(folder))
    answer = api.post(f"{WHERE}?filename=../mercury.zip", content=content)
    assert answer.status_code == 201, answer.text
    transit = answer.json()
    assert answer.headers["Location"] == f"{WHERE}/{transit['id']}"
    assert transit["id"] == hashlib.sha256(content).hexdigest() and transit["bytes"] == len(content)
    assert (transit["archive"], transit["images"], transit["instrument"]) == ("zip", 4, "hri_euv")
    assert transit["pointings"] == [{"fov": 1, "images": 3}, {"fov": 2, "images": 1}]
    assert transit["noise"] == READ_NOISE and transit["known_psf"] == "diffraction.fits"
    assert transit["filename"] == "mercury.zip"
    sizes = {name: len(data) for name, data in members_of(folder).items()}
    files = {one["name"]: one["bytes"] for one in transit["files"]}
    assert files == {name: size for name, size in sizes.items() if name != "transit.json"}
    assert transit["unpacked_bytes"] == sum(sizes.values())

    assert api.get(answer.headers["Location"]).json() == transit
    [listed] = api.get(WHERE).json()["items"]
    assert listed == {key: value for key, value in transit.items() if key != "files"}
    unpack(Store(settings.data_dir).path(transit["id"]), tmp_path / "out", settings.archive_limits)
    assert members_of(tmp_path / "out") == members_of(folder)
    assert api.get(f"/v1/images/{transit['id']}").status_code == 404, "a transit is no image"

    form = api.post(WHERE, files={"file": ("again.zip", content)})
    assert form.status_code == 200 and form.json() == transit, "the same bytes are the same transit"


def test_transits_have_limits_of_their_own(api: TestClient, settings: Settings, folder: Path) -> None:
    content = as_tar({**members_of(folder), "more.bin": bytes(settings.max_upload_bytes)})
    assert api.post(WHERE, content=content).status_code == 201
    assert api.post("/v1/images", content=content).status_code in (413, 415)


# --- what is refused --------------------------------------------------------------------------------------


def test_archives_that_cannot_be_used(settings: Settings, folder: Path, image_file: Path) -> None:
    """In a body and in a form. More are in the table tests/service/http/attacks.py, all in tests/psfcore/transit."""
    good = members_of(folder)
    without = {name: good[name] for name in good if name != "002.fits"}
    cases = [
        ("002.fits", as_zip(without), 422, "missing-file"),
        ("002.fits", as_tar({**good, "002.fits": b"a letter"}), 422, "not-fits"),
        ("expected", as_zip(good)[: len(as_zip(good)) // 2], 422, "archive-broken"),
        (str(2 * MIB), as_zip({**good, "x.bin": bytes(40 * MIB)}), 413, "archive-too-large"),
        (str(MIB), as_tar({**good, "x.bin": bytes(MIB)}), 413, "too-large"),
        ("expected", image_file.read_bytes(), 415, "not-an-archive"),
        ("expected", b"", 400, "empty-upload"),
    ]
    # A service that takes 1 MiB, and lets 2 MiB come out of it.
    tight = settings.model_copy(update={"max_transit_mib": 1, "max_transit_unpacked_mib": 2})
    with TestClient(create_app(tight), raise_server_exceptions=False) as api:
        for told, content, status, code in cases:
            for options in ({"content": content}, {"files": {"file": ("a.zip", content)}}):
                detail = refusal(api.post(WHERE, **options), status, code)
                assert "expected" in detail and told in detail, (code, told)
        assert api.get(WHERE).json()["items"] == []
        refusal(api.post(WHERE, files={"other": ("a.zip", as_zip(good))}), 400, "bad-form")
    folders = [settings.data_dir / part for part in ("tmp", "blobs")]
    assert not [path for place in folders for path in place.rglob("*") if path.is_file()]


# --- clients ----------------------------------------------------------------------------------------------


def test_a_client_sends_a_folder_or_an_archive(api: TestClient, folder: Path, tmp_path: Path) -> None:
    with Client("http://testserver", transport=api._transport) as sun:
        transit = sun.upload_transit(folder)
        assert transit["images"] == 4 and transit["filename"] == "mercury.tar"
        pack(folder, tmp_path / "own.tar")
        assert sun.upload_transit(tmp_path / "own.tar")["id"] == transit["id"]
        (tmp_path / "letter.zip").write_text("a letter " * 50)
        with pytest.raises(ServiceError) as caught:
            sun.upload_transit(tmp_path / "letter.zip")
        assert (caught.value.status, caught.value.code) == (415, "not-an-archive")
        (folder / "001.fits").unlink()
        with pytest.raises(ServiceError, match=r"001\.fits") as caught:
            sun.upload_transit(folder)
        assert caught.value.code == "missing-file"


def test_the_report_of_a_fitted_psf(
    api: TestClient, catalogue: Catalogue, settings: Settings, tmp_path: Path
) -> None:
    (tmp_path / "report.json").write_text('{"schema": "psf-fit/1"}')
    digest = Store(settings.data_dir).keep(tmp_path / "report.json")
    files = {"file_sha256": digest, "preview_sha256": digest, "bytes": 1}
    known = {"details": {"report_sha256": digest, "transit_id": "3" * 64}, "created_at": 1.0}
    fitted = {"origin": "fitted", "name": "p", "version": "1", "status": "draft"}
    catalogue.add(PsfRow(owner="local", id="4" * 64, **files, **known, **fitted))
    answer = api.get(api.get(f"/v1/psfs/{'4' * 64}").json()["report"])
    assert answer.headers["content-type"] == "application/json" and answer.json()["schema"] == "psf-fit/1"
    known_already = {"If-None-Match": answer.headers["etag"]}
    assert api.get(f"/v1/psfs/{'4' * 64}/report", headers=known_already).status_code == 304


def test_invalid_fits_are_refused(api: TestClient, psf_file: Path, tmp_path: Path) -> None:
    psf_id = upload(api, psf_file, "/v1/psfs")
    assert api.get(f"/v1/psfs/{psf_id}").json()["report"] is None, "it was not fitted"
    refusal(api.get(f"/v1/psfs/{psf_id}/report"), 404, "no-report")

    def answer(**parameters: object) -> Response:
        return api.post("/v1/jobs", json={"kind": "psf-fit", "parameters": parameters})

    pack(write_transit(tmp_path / "silent", noise=None), tmp_path / "t.tar")
    refusal(answer(transit_id=upload(api, tmp_path / "t.tar", "/v1/transits")), 422, "no-noise-figures")
    noise = {"photon_gain_dn": -1, "read_noise_dn": 1}
    for wrong in ({"shape": "round"}, {"seed": -1}, {"noise": noise}, {"a": 1}):
        refusal(answer(transit_id="0" * 64, **wrong), 422, "invalid-request")
