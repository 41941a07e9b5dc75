"""One table of attacks: each is a clear refusal, takes little memory and little time, and leaves nothing behind."""

from __future__ import annotations

import gzip
import hashlib
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from tests.fits_bombs import lying_tiles
from tests.service.conftest import upload
from tests.service.http.attacks import BOMBS, MIB, TABLE, Attack
from tests.service.keyed import Keyed, keyed
from workers.contract.phases import Phase
from workers.files.store import Store
from workers.run.registry import load_tasks
from workers.run.runner import Runner
from workers.settings import Settings

MOST_MIB = 64.0  # of memory more than before: an upload may be 8 MiB, and headers 4
MOST_S = 10.0  # of processor time: what else the machine does counts for nothing


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("attacked"),
        database_url=None,
        broker_url="filesystem://",
        allowed_hosts="testserver",
        max_upload_mib=8,
        max_transit_mib=8,
        max_transit_unpacked_mib=64,
    )
    with keyed(settings) as running:
        yield running


@dataclass
class Memory:
    """The most memory that a block took beyond what there was before."""

    mib: float = 0.0


@contextmanager
def measured(*, traced: bool = True) -> Iterator[Memory]:
    """By Python's own count (slow), and by the system's, which also sees what libraries take but not what is used again."""
    memory = Memory()
    Path("/proc/self/clear_refs").write_text("5")  # the system's peak starts anew
    before_kib = status_kib("VmRSS")
    if traced:
        tracemalloc.start()
    try:
        yield memory
    finally:
        counted = tracemalloc.get_traced_memory()[1] / MIB
        tracemalloc.stop()
        memory.mib = max(counted, (status_kib("VmHWM") - before_kib) / 1024)


def status_kib(name: str) -> int:
    """A figure of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1])


def test_there_are_many() -> None:
    assert len(TABLE) >= 120 and len({attack.name for attack in TABLE}) == len(TABLE)


@pytest.mark.parametrize("attack", TABLE, ids=lambda attack: attack.name)
def test_an_attack_is_refused_and_costs_little(service: Keyed, attack: Attack) -> None:
    ann = service.client("ann")
    content = None if attack.content is None else attack.content()
    started = time.process_time()
    with measured(traced=attack in BOMBS) as memory:
        answer = ann.request(
            attack.method,
            attack.address,
            headers=attack.headers,
            content=content,
            json=attack.json,
            follow_redirects=False,
        )
    took_s, took_mib = time.process_time() - started, memory.mib
    assert answer.status_code == attack.status, answer.text[:500]
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["type"] == f"urn:heliopsf:{attack.code}", problem
    assert problem["status"] == attack.status and problem["detail"]
    assert len(answer.content) < 20_000
    for secret in ("Traceback", "sqlalchemy", "/work/", "site-packages", "root:x", str(Path.home())):
        assert secret not in answer.text
    assert took_mib < MOST_MIB and took_s < MOST_S, (took_mib, took_s)
    files = service.api.app.state.heliopsf.settings.data_dir  # type: ignore[attr-defined]
    assert [p for folder in ("tmp", "blobs") for p in (files / folder).rglob("*") if p.is_file()] == []


def test_after_all_that_the_service_is_as_it_was(service: Keyed) -> None:
    ann = service.client("ann")
    for address in ("/v1/jobs", "/v1/images", "/v1/transits", "/v1/psfs"):
        assert ann.get(address).json()["items"] == []
    assert service.api.get("/healthz").status_code == 200


@pytest.mark.parametrize("column", ["COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"])
def test_tiles_that_lie_pass_the_header_and_end_the_job_within_bounds(
    service: Keyed, psf_file: Path, column: str
) -> None:
    """Half a megabyte that unfolds to 537: the header says 64 x 64 px, so that only who reads the pixels can tell."""
    ann = service.client(f"ann-{column.lower()[:4]}")
    content = lying_tiles(gzip.compress(bytes(537_000_000)), column=column)
    assert len(content) < 0.6 * MIB
    sent = ann.post("/v1/images", content=content)
    assert sent.status_code == 201, sent.text
    psf_id = upload(ann, psf_file, "/v1/psfs")
    body = {"kind": "deconvolve", "parameters": {"image_id": sent.json()["id"], "psf_id": psf_id}}
    job = ann.post("/v1/jobs", json=body).json()
    settings = service.api.app.state.heliopsf.settings  # type: ignore[attr-defined]
    runner = Runner(settings, service.catalogue, Store(settings.data_dir))
    load_tasks()  # as a worker does; without other tests before this one, their libraries would be counted below
    with measured() as memory:
        runner.run(job["id"])
    assert memory.mib < 64
    ended = ann.get(f"/v1/jobs/{job['id']}").json()
    assert ended["phase"] == Phase.ERROR
    assert (ended["error"]["fault"], ended["error"]["code"]) == ("user", "tile-too-large")


@pytest.mark.parametrize(
    "name",
    [
        "../../evil.fits",
        "/etc/passwd",
        "..\\evil.fits",
        "a\r\nSet-Cookie: x=1",
        "\x00evil",
        "evil\u202e",
        "x" * 5000,
        '"; rm -rf /',
        "%2e%2e%2fevil",
    ],
)
def test_no_name_of_a_client_s_or_a_header_s_is_in_a_path_or_in_a_header(
    service: Keyed, tmp_path: Path, name: str
) -> None:
    """The label is kept for people; where the file is, and what a download is called, comes of hashes alone."""
    ann = service.client("ann")
    printable = "".join(c for c in name if " " <= c <= "~")[:60]
    header = fits.Header({"PSFNAME": printable, "PSFVERS": printable, "OBJECT": printable})
    y, x = np.indices((64, 64)) - 32
    kernel = np.exp(-0.5 * (x**2 + y**2)) + len(name) * 1e-9
    fits.PrimaryHDU((kernel / kernel.sum()).astype("f4"), header).writeto(tmp_path / "psf.fits")
    content = (tmp_path / "psf.fits").read_bytes()
    data = service.api.app.state.heliopsf.settings.data_dir  # type: ignore[attr-defined]
    for address in ("/v1/images", "/v1/psfs"):
        sent = ann.post(address, params={"filename": name}, content=content)
        assert sent.status_code in (200, 201)
        about = sent.json()
        label = about.get("filename") or about.get("details", {}).get("filename") or ""
        assert len(label) <= 200 and label.isprintable() and "/" not in label and "\\" not in label
    download = ann.get(f"{sent.headers['Location']}/file")
    assert (
        download.headers["Content-Disposition"] == f'attachment; filename="psf-{sent.json()["id"][:12]}.fits"'
    )
    assert "Set-Cookie" not in download.headers
    names = {path.name for path in data.rglob("*") if path.is_file() and "blobs" in path.parts}
    assert hashlib.sha256(content).hexdigest() in names
    assert all(len(one) == 64 and set(one) <= set("0123456789abcdef") for one in names)
    assert {path.name for path in tmp_path.iterdir()} <= {data.name, "psf.fits"}
    above = [
        data,
        *data.parents[:2],
    ]  # pytest's own folders beside this one may have such a word in their names
    assert not [found for folder in above for found in folder.glob("evil*")]
