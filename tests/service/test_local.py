"""The service in this process: it reads the user's files where they are, and copies none."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

import heliopsf
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.fits.psfs import write_psf as write_built
from psfcore.fits.stored_psf import cutout
from psfcore.instruments import files
from psfcore.psf_sampling import rebinned
from psfcore.transit.archive import pack
from service.client.errors import ServiceError
from service.local import LocalService, LocalStore, local_service
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.conftest import upload
from tests.transit_files import write_transit
from workers.cache_folder import psf_cache
from workers.files.store import sha256_of
from workers.settings import Settings


def test_files_are_served_where_they_are_and_read_only_as_they_were(tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    store = LocalStore(tmp_path / "data")
    digest = store.add_file(tmp_path / "image.fits")
    assert digest == sha256_of(tmp_path / "image.fits")
    assert store.path(digest) == (tmp_path / "image.fits").resolve()
    assert list(store.blobs()) == []
    os.utime(tmp_path / "image.fits", ns=(1, 1))
    with pytest.raises(OSError, match=r"image\.fits changed while it was read"):
        store.path(digest)


def test_a_folder_is_read_in_place_and_an_archive_is_unpacked(tmp_path: Path) -> None:
    folder = write_transit(tmp_path / "transit")
    pack(folder, tmp_path / "transit.tar")
    limits, store = Settings().archive_limits, LocalStore(tmp_path / "data")
    digest = store.add_folder(folder).sha256
    with store.unpacked(digest, limits) as place:
        assert place == folder.resolve()
    assert list(store.blobs()) == [] and (folder / "transit.json").is_file()
    (folder / "transit.json").touch()
    with pytest.raises(OSError, match="changed"), store.unpacked(digest, limits):
        pass
    other = LocalStore(tmp_path / "other")
    assert other.add_file(tmp_path / "transit.tar") == digest
    with other.unpacked(digest, limits) as place:
        assert place != folder.resolve() and (place / "transit.json").is_file()
    assert not place.exists()
    with local_service() as service, pytest.raises(ServiceError) as caught:
        service.upload_transit(tmp_path)
    assert caught.value.code == "no-manifest"


def test_a_product_does_not_replace_its_image_and_may_have_no_picture(tmp_path: Path) -> None:
    image = tmp_path / "image.fits"
    write_image(image)
    write_psf(tmp_path / "psf.fits")
    before = sha256_of(image)
    with local_service(previews=False) as service:
        psf_id = service.upload_psf(tmp_path / "psf.fits")["id"]
        for overwrite in (False, True):
            with pytest.raises(ServiceError) as caught:
                service.deconvolve(image, image, psf_id=psf_id, steps=1, overwrite=overwrite)
            assert caught.value.code == "output-is-input"
            assert sha256_of(image) == before
        product = service.deconvolve(image, psf_id=psf_id, steps=1)
        for part in ("preview", "thumbnail"):
            service.download(product[part], tmp_path / f"{part}.png")
    assert (tmp_path / "preview.png").read_bytes() == (tmp_path / "thumbnail.png").read_bytes()


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The file of a PSF that a service built, and its id."""
    folder = tmp_path_factory.mktemp("built")
    (folder / "small.toml").write_text(SMALL_INSTRUMENT)
    with local_service() as service:
        return folder / "p.fits", service.build_psf(folder / "small.toml", folder / "p.fits", size=64)["id"]


def test_the_file_of_a_built_psf_keeps_its_id_and_that_of_its_products(
    built: tuple[Path, str], api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    psf, identity = built
    write_image(tmp_path / "i.fits", WAVELNTH=171)
    with local_service() as service:
        assert service.upload_psf(psf)["id"] == heliopsf.read_psf(psf).provenance["psf_id"] == identity
        product = service.deconvolve(tmp_path / "i.fits", tmp_path / "o.fits", psf_id=identity, steps=1)
        assert fits.getheader(tmp_path / "o.fits")["PSFID"] == identity
        assert service.upload_psf(psf, name="another")["id"] == sha256_of(psf), (
            "described anew: as in a service"
        )
    # The service that built the PSF gives the product the same id.
    build = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 64}}
    assert api.post("/v1/jobs", json=build).status_code == 202
    run_jobs()
    wanted = {"image_id": upload(api, tmp_path / "i.fits"), "psf_id": upload(api, psf, "/v1/psfs")}
    wanted |= {"method": {"name": "richardson-lucy", "steps": 1}}
    asked = api.post("/v1/jobs/identity", json={"kind": "deconvolve", "parameters": wanted}).json()
    assert (wanted["psf_id"], asked["result_id"]) == (identity, product["id"])


def test_a_file_that_was_changed_does_not_keep_the_id(built: tuple[Path, str], tmp_path: Path) -> None:
    limits, file = FitsLimits(max_pixels=2**20), built[0]

    def pixel(changed: Path) -> None:
        shutil.copyfile(file, changed)
        with fits.open(changed, mode="update") as hdus:
            hdus[0].data[3, 3] += np.float32(1e-6)

    def card(changed: Path) -> None:
        shutil.copyfile(file, changed)
        fits.setval(changed, "PSFNAME", value="mine")

    def no_checksums(changed: Path) -> None:
        with fits.open(file) as hdus:
            for hdu in hdus:
                del hdu.header["CHECKSUM"]
            hdus.writeto(changed)

    changes: dict[str, Callable[[Path], object]] = {
        "pixel": pixel,
        "card": card,
        "no checksums": no_checksums,
        "rebinned": lambda changed: write_built(changed, rebinned(read_psf(file, limits), 2)),
        "cutout": lambda changed: cutout(file, 32, limits).write(changed),
        "rewritten": lambda changed: write_built(changed, read_psf(file, limits)),
    }
    with local_service() as service:
        for name, change in changes.items():
            change(tmp_path / f"{name}.fits")
            digest = sha256_of(tmp_path / f"{name}.fits")
            assert service.upload_psf(tmp_path / f"{name}.fits")["id"] == digest != built[1], name


def _built(folder: Path) -> tuple[dict[str, Any], list[str], bytes]:
    """Build the small PSF in a new local service: its description, the stages of the job, and the file."""
    stages: list[str] = []
    (folder / "small.toml").write_text(SMALL_INSTRUMENT)
    with local_service() as service:
        psf = service.build_psf(
            folder / "small.toml",
            folder / "psf.fits",
            size=64,
            progress=lambda stage, step, steps: stages.append(stage),
            overwrite=True,
        )
        assert service.ask(psf["id"], "curve", radii=[1.0])["radii_px"] == [1.0]
    return psf, stages, (folder / "psf.fits").read_bytes()


def test_a_psf_is_built_once_and_is_the_same_afterwards(tmp_path: Path) -> None:
    first, stages, content = _built(tmp_path)
    assert "building the PSF" in stages
    again, stages, same = _built(tmp_path)
    assert "building the PSF" not in stages
    assert same == content
    assert again | {"created_at": None} == first | {"created_at": None}
    for file in psf_cache().folder.glob("*.fits"):
        file.write_bytes(content[:-1] + b"?")
    _, stages, same = _built(tmp_path)
    assert "building the PSF" in stages and same == content, "a damaged file of the cache is not used"


def test_a_deconvolution_builds_the_total_psf_and_a_later_command_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "instruments"
    folder.mkdir()
    smaller = SMALL_INSTRUMENT.replace("pixels = 512", "pixels = 128")
    (folder / "small.toml").write_text(f'{smaller}\n[match]\nDETECTOR = "SMALL"\n')
    monkeypatch.setattr(files, "_FOLDER", folder)
    files.match_table.cache_clear()
    write_image(tmp_path / "image.fits", DETECTOR="SMALL", WAVELNTH=171, CDELT1=2.0, CDELT2=2.0)

    def product(service: LocalService, name: str) -> tuple[str, list[str]]:
        stages: list[str] = []
        made = service.deconvolve(
            tmp_path / "image.fits",
            tmp_path / name,
            steps=1,
            progress=lambda stage, step, steps: stages.append(stage),
        )
        return made["psf_id"], stages

    with local_service() as service:
        psf_id, stages = product(service, "first.fits")
        assert "building the PSF" in stages
        assert service.get(f"/v1/psfs/{psf_id}")["details"]["components"] == []
    with local_service() as service:
        assert product(service, "second.fits")[0] == psf_id
        assert service.get(f"/v1/psfs/{psf_id}")["details"]["components"] == []
        psf = service.build_psf("small", tmp_path / "psf.fits")  # in a catalogue that has the total PSF
        assert psf["id"] == psf_id and "DIFFRACTION" in psf["details"]["components"]
        assert service.ask(psf_id, "curve", radii=[1.0])["radii_px"] == [1.0]
    with local_service() as service:
        _, stages = product(service, "third.fits")
        assert "building the PSF" not in stages
        assert service.build_psf("small", tmp_path / "same.fits")["details"]["components"]
    first, second, third = ((tmp_path / f"{name}.fits").read_bytes() for name in ("first", "second", "third"))
    assert first == second == third
    assert (tmp_path / "psf.fits").read_bytes() == (tmp_path / "same.fits").read_bytes()
    files.match_table.cache_clear()


def test_a_psf_that_python_built_is_used_and_a_cache_that_cannot_be_written_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "small.toml").write_text(SMALL_INSTRUMENT)
    heliopsf.build_psf(tmp_path / "small.toml", size=64)
    used, stages, content = _built(tmp_path)
    assert "building the PSF" not in stages
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(tmp_path / "file"))
    built, stages, same = _built(tmp_path)
    assert "building the PSF" in stages and same == content
    assert "not kept for later commands" in caplog.text
    assert used["id"] == built["id"] and used["details"]["provenance"] == built["details"]["provenance"]


def test_the_command_loads_neither_the_web_framework_nor_what_only_other_commands_need(
    tmp_path: Path,
) -> None:
    write_image(tmp_path / "image.fits")
    write_psf(tmp_path / "psf.fits")
    script = (
        "import sys, json, atexit\n"
        "atexit.register(lambda: print(json.dumps(sorted(sys.modules))))\n"
        "from service.cli.main import main\n"
        "main(['deconvolve', 'image.fits', '-o', 'sharp.fits', '--psf', 'psf.fits', '--steps', '1', '--local'])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(heliopsf.__file__).parents[1])},
        check=True,
        capture_output=True,
        text=True,
    )
    loaded = set(json.loads(done.stdout.splitlines()[-1]))
    unwanted = {"fastapi", "matplotlib", "alembic", "celery", "httpx"}
    unwanted |= {f"scipy.{part}" for part in ("fft", "integrate", "ndimage", "optimize")}
    assert "workers.tasks.deconvolve" in loaded and loaded & unwanted == set()
