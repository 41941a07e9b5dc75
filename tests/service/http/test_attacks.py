"""The table of bad requests: each is a clear refusal, takes little memory and time, and leaves nothing behind."""

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
from tests.service.conftest import refusal, settings_in, upload
from tests.service.http.attacks import ARCHIVES, FILES, MIB, REQUESTS, Attack
from tests.service.keyed import Keyed, keyed
from tests.workers.jobs import run_job
from workers.contract.jobs import Phase
from workers.files.store import Store
from workers.run.runner import Runner, load_tasks

MOST_MIB = 64.0  # of memory more than before: an upload may be 8 MiB, and headers 4
MOST_S = 10.0  # of processor time: what else the machine does counts for nothing


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    limits = {"max_upload_mib": 8, "max_psf_mib": 8, "max_transit_mib": 8, "max_transit_unpacked_mib": 64}
    settings = settings_in(tmp_path_factory.mktemp("attacked"), max_pixels=2**26, **limits)
    with keyed(settings) as running:
        yield running


@pytest.fixture(scope="module")
def data(service: Keyed) -> Path:
    """The folder of the service."""
    folder: Path = service.api.app.state.heliopsf.settings.data_dir
    return folder


@dataclass
class Memory:
    """The most memory that a block took beyond what there was before."""

    mib: float = 0.0


@contextmanager
def measured(*, traced: bool = True) -> Iterator[Memory]:
    """By Python's own count (slow), and by the system's, which also sees what libraries take but not what is used
    again."""
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


def files_in(data: Path) -> set[Path]:
    return {path for folder in ("tmp", "blobs") for path in (data / folder).rglob("*") if path.is_file()}


@pytest.mark.parametrize("table", [REQUESTS, FILES, ARCHIVES], ids=["requests", "files", "archives"])
def test_attacks_are_refused_and_cost_little(service: Keyed, data: Path, table: list[Attack]) -> None:
    ann, before = service.client("ann"), files_in(data)
    for attack in table:
        content = None if attack.content is None else attack.content()
        started = time.process_time()
        with measured(traced=table is not REQUESTS) as memory:
            answer = ann.request(
                attack.method,
                attack.address,
                headers=attack.headers,
                content=content,
                json=attack.json,
                follow_redirects=False,
            )
        took_s = time.process_time() - started
        text = f"{attack.name}: {answer.status_code} {answer.text[:500]}"
        assert answer.headers["content-type"] == "application/problem+json", text
        problem = answer.json()
        assert answer.status_code == problem["status"] == attack.status, text
        assert problem["type"] == f"urn:heliopsf:{attack.code}" and problem["detail"], text
        assert len(answer.content) < 20_000, text
        for secret in ("Traceback", "sqlalchemy", "/work/", "site-packages", "root:x", str(Path.home())):
            assert secret not in answer.text, text
        assert memory.mib < MOST_MIB and took_s < MOST_S, (attack.name, memory.mib, took_s)
        assert files_in(data) == before, attack.name
    for address in ("/v1/jobs", "/v1/images", "/v1/transits", "/v1/psfs"):
        assert ann.get(address).json()["items"] == []
    assert service.api.get("/healthz").status_code == 200


def test_a_bad_file_is_refused_wherever_and_however_it_is_sent(service: Keyed) -> None:
    ann = service.client("sender")
    for attack in FILES:
        if attack.name in ("a script", "nothing", "a cube", "more than may be sent"):
            content = attack.content()
            for where in ("/v1/images", "/v1/psfs"):
                for options in ({"content": content}, {"files": {"file": ("bad.fits", content)}}):
                    assert "expected" in refusal(ann.post(where, **options), attack.status, attack.code)


def test_tiles_that_lie_pass_the_header_and_end_the_job_within_bounds(
    service: Keyed, data: Path, psf_file: Path
) -> None:
    """A few kilobytes that unfold to 128 MiB: the header says 64 x 64 px, so that only who reads the pixels can
    tell."""
    ann = service.client("liar")
    answer = ann.post("/v1/images", content=lying_tiles(gzip.compress(bytes(128 * MIB), 6)))
    assert answer.status_code == 201, answer.text
    psf_id = upload(ann, psf_file, "/v1/psfs")
    body = {"kind": "deconvolve", "parameters": {"image_id": answer.json()["id"], "psf_id": psf_id}}
    job = ann.post("/v1/jobs", json=body).json()
    settings = service.api.app.state.heliopsf.settings
    runner = Runner(settings, service.catalogue, Store(data))
    load_tasks()  # as a worker does; without other tests before this one, their libraries would be counted below
    with measured() as memory:
        run_job(runner, service.catalogue, job["id"])
    assert memory.mib < 64
    ended = ann.get(f"/v1/jobs/{job['id']}").json()
    assert ended["phase"] == Phase.ERROR
    assert (ended["error"]["fault"], ended["error"]["code"]) == ("user", "unreadable-pixels")


NAMES = (
    "../../evil.fits",
    "..\\evil.fits",
    "a\r\nSet-Cookie: x=1",
    "\x01evil\u202e",
    "x" * 5000,
    '"; rm -rf /',
)


def test_no_name_of_a_client_s_or_a_header_s_is_in_a_path_or_in_a_header(
    service: Keyed, data: Path, tmp_path: Path
) -> None:
    """The label is kept for people; where the file is, and what a download is called, comes of hashes alone."""
    ann = service.client("names")
    y, x = np.indices((64, 64)) - 32
    for number, name in enumerate(NAMES):
        printable = "".join(c for c in name if " " <= c <= "~")[:60]
        header = fits.Header({"PSFNAME": printable, "PSFVERS": printable, "OBJECT": printable})
        kernel = np.exp(-0.5 * (x**2 + y**2)) + number * 1e-9
        fits.PrimaryHDU((kernel / kernel.sum()).astype("f4"), header).writeto(
            tmp_path / "psf.fits", overwrite=True
        )
        content = (tmp_path / "psf.fits").read_bytes()
        for address in ("/v1/images", "/v1/psfs"):
            answer = ann.post(address, params={"filename": name}, content=content)
            assert answer.status_code == 201, name
            about = answer.json()
            label = about.get("filename") or about.get("details", {}).get("filename") or ""
            assert len(label) <= 200 and label.isprintable() and "/" not in label and "\\" not in label
        download = ann.get(f"{answer.headers['Location']}/file")
        expected = f'attachment; filename="psf-{answer.json()["id"][:12]}.fits"'
        assert download.headers["Content-Disposition"] == expected and "Set-Cookie" not in download.headers
        names = {path.name for path in (data / "blobs").rglob("*") if path.is_file()}
        assert hashlib.sha256(content).hexdigest() in names
        assert all(len(one) == 64 and set(one) <= set("0123456789abcdef") for one in names)
    assert [path.name for path in tmp_path.iterdir()] == ["psf.fits"]
    # pytest's own folders beside this one may have such a word in their names
    assert not [path for folder in (data, *data.parents[:2]) for path in folder.glob("evil*")]
