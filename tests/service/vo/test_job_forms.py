"""Files in the forms of UWS clients: UPLOAD=name,param:part (DALI 1.1); and documents as vo-models reads them."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient

from psfcore.files import sha256_of
from tests.service.conftest import upload
from tests.service.keyed import keyed
from tests.service.vo.test_jobs import JOBS, document, parameters
from workers.catalogue.access import Scope
from workers.catalogue.tables import ImageRow
from workers.settings import Settings

Files = dict[str, tuple[str, bytes]]
TABLES = ("images", "transits", "psfs")
NOTHING: dict[str, list[str]] = {table: [] for table in TABLES}


def post(api: TestClient, address: str, fields: dict[str, str | list[str]], files: Files) -> httpx.Response:
    return api.post(address, data=fields, files=files, follow_redirects=False)


def kept(api: TestClient) -> dict[str, list[str]]:
    """The ids of everything that was uploaded."""
    return {table: [row["id"] for row in api.get(f"/v1/{table}").json()["items"]] for table in TABLES}


def temporary(settings: Settings) -> list[Path]:
    return list((settings.data_dir / "tmp").iterdir())


def test_an_image_and_its_psf_arrive_with_the_job(
    api: TestClient, settings: Settings, run_jobs: Callable[[], None], image_file: Path, psf_file: Path
) -> None:
    fields: dict[str, str | list[str]] = {
        "KIND": "deconvolve",
        "PHASE": "RUN",
        "method": '{"name": "linear", "steps": 1}',
        "UPLOAD": ["image,param:first", "psf,param:second"],
    }
    files = {"first": ("../sun.fits", image_file.read_bytes()), "second": ("psf.fits", psf_file.read_bytes())}
    made = post(api, JOBS, fields, files)
    assert made.status_code == 303, made.text
    job = made.headers["location"]
    image, psf = sha256_of(image_file), sha256_of(psf_file)
    sent = parameters(document(api.get(f"{job}/parameters")))
    assert (sent["image_id"], sent["psf_id"]) == (image, psf)
    assert kept(api) == {"images": [image], "transits": [], "psfs": [psf]}
    assert api.get(f"/v1/images/{image}").json()["filename"] == "sun.fits"
    assert temporary(settings) == []
    run_jobs()
    assert api.get(f"{job}/phase").text == "COMPLETED"
    assert api.get(f"{job}/results/result").content.startswith(b"SIMPLE  =")


def test_a_file_may_follow_while_the_job_is_pending(
    api: TestClient, image_file: Path, psf_file: Path
) -> None:
    psf = upload(api, psf_file, "/v1/psfs")
    job = post(api, JOBS, {"KIND": "deconvolve", "psf_id": psf}, {}).headers["location"]
    files = {"f": ("sun.fits", image_file.read_bytes())}
    changed = post(api, f"{job}/parameters", {"UPLOAD": "image,param:f"}, files)
    assert changed.status_code == 303, changed.text
    assert parameters(document(api.get(job)))["image_id"] == sha256_of(image_file)
    assert api.post(f"{job}/phase", data={"PHASE": "RUN"}, follow_redirects=False).status_code == 303
    other = {"f": ("x.fits", psf_file.read_bytes())}
    late = post(api, f"{job}/parameters", {"UPLOAD": "image,param:f"}, other)
    assert late.status_code == 403 and "only while a job is PENDING" in late.text
    assert kept(api)["images"] == [sha256_of(image_file)], "nothing was kept of the file that came too late"


def tar_without_images() -> bytes:
    target = io.BytesIO()
    with tarfile.open(fileobj=target, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("001.fits"))
    return target.getvalue()


IMAGE = {"KIND": "deconvolve", "UPLOAD": "image,param:f"}
REFUSED = [
    ("an address", {**IMAGE, "UPLOAD": "image,http://127.0.0.1:8765/metrics"}, 400, "are not fetched"),
    ("no such part", {**IMAGE, "UPLOAD": "image,param:g"}, 400, "expected a part 'g' with a file"),
    ("no UPLOAD", {"KIND": "deconvolve"}, 400, "expected UPLOAD=NAME,param:f"),
    ("another kind", {**IMAGE, "KIND": "psf-fit"}, 400, "(transit); got 'image'"),
    ("twice", {**IMAGE, "UPLOAD": "image,param:f;image,param:f"}, 400, "expected one image; got several"),
    ("field twice", {**IMAGE, "KIND": ["deconvolve", "deconvolve"]}, 400, "expected KIND once"),
]  # fmt: skip


FILES: list[tuple[str, str, str, bytes, int, str]] = [
    ("no FITS", "deconvolve", "image", b"hello, I am an image", 415, "expected a FITS file"),
    ("too large", "deconvolve", "image", b"SIMPLE  =" + bytes(2 * 2**20), 413, "at most 2097152 bytes"),
    ("no transit.json", "psf-fit", "transit", tar_without_images(), 422, "expected a file transit.json"),
]
BOUNDARY = "multipart/form-data; boundary=x"
PART = b'--x\r\nContent-Disposition: form-data; name="f"; filename="a"\r\n\r\nSIMPLE  =\r\n'
BROKEN: list[tuple[str, str, bytes, str]] = [
    ("cut", BOUNDARY, PART, "it ended before its last boundary"),
    ("twice", BOUNDARY, PART * 2 + b"--x--", "in parts of different names"),
    ("no name", BOUNDARY, PART.replace(b'name="f"; ', b"") + b"--x--", "expected a name for every part"),
    ("field", BOUNDARY, b'--x\r\nContent-Disposition: form-data; name="a"\r\n\r\n\xff\r\n--x--', "in UTF-8"),
]


def test_nothing_stays_of_a_refused_form(
    api: TestClient, settings: Settings, image_file: Path, psf_file: Path
) -> None:
    def refused(name: str, answer: httpx.Response, status: int, told: str) -> None:
        assert answer.status_code == status and told in answer.text, (name, answer.text)
        assert answer.headers["content-type"].startswith("text/plain"), name
        assert kept(api) == NOTHING and len(document(api.get(JOBS))) == 0, name
        assert temporary(settings) == [] and list((settings.data_dir / "blobs").rglob("*/*")) == [], name

    for name, fields, status, told in REFUSED:
        refused(name, post(api, JOBS, fields, {"f": ("sun.fits", image_file.read_bytes())}), status, told)
    for name, kind, part, content, status, told in FILES:
        answer = post(api, JOBS, {"KIND": kind, "UPLOAD": f"{part},param:f"}, {"f": ("x", content)})
        refused(name, answer, status, told)
    for name, media_type, body, told in BROKEN:
        answer = api.post(JOBS, content=body, headers={"Content-Type": media_type})
        refused(name, answer, 400, told)
    both: dict[str, str | list[str]] = {**IMAGE, "UPLOAD": "image,param:f;psf,param:g"}
    files = {"f": ("sun.fits", image_file.read_bytes()), "g": ("psf.fits", b"a letter")}
    refused("one of two files is bad", post(api, JOBS, both, files), 415, "")


@pytest.mark.usefixtures("one_minute")
def test_a_file_needs_the_scope_and_counts_for_its_owner(settings: Settings, image_file: Path) -> None:
    files = {"f": ("sun.fits", image_file.read_bytes())}
    fields: dict[str, str | list[str]] = dict(IMAGE)
    with keyed(settings, submissions_per_minute=2) as service:
        reader = service.client("ann", Scope.READ)
        assert post(reader, JOBS, fields, files).status_code == 403
        ann, bob = service.client("ann"), service.client("bob")
        assert post(ann, JOBS, fields, files).status_code == 303
        assert post(ann, JOBS, fields, files).status_code == 303, "one request is counted once"
        assert post(ann, JOBS, fields, files).status_code == 429
        assert kept(bob) == NOTHING
        (row,) = service.catalogue.page(ImageRow, owner="ann", limit=2)
        assert row.bytes == image_file.stat().st_size
        assert service.catalogue.owners.usage("ann", 0).used_bytes == row.bytes
    small = settings.model_copy(update={"upload_mib_per_minute": 1})
    with keyed(small) as service:
        large = {"f": ("sun.fits", image_file.read_bytes() + bytes(2**20))}
        assert post(service.client("ann"), JOBS, fields, large).status_code == 429
