"""Every VOTable as the validators of STILTS judge it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.service.vo.made import add_product

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
