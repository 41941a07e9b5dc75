"""Commands with ``--local``: files are read where they are, built PSFs are kept, and the results are those of a
service."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner
from fastapi.testclient import TestClient

import heliopsf
from psfcore.errors import DataError
from psfcore.files import sha256_of
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.fits.psfs import write_psf as write_built
from psfcore.fits.stored_psf import write_cutout
from psfcore.instruments import files
from psfcore.psf_sampling import rebinned
from psfcore.transit.archive import pack
from service.cli.local import local
from service.cli.main import main
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.conftest import upload
from tests.transit_files import write_transit
from workers.machine import psf_cache


def test_files_are_read_in_place_and_only_as_they_were(tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    write_psf(tmp_path / "psf.fits")
    folder = write_transit(tmp_path / "transit")
    pack(folder, tmp_path / "transit.tar")
    with local() as service:
        image, psf = (
            service.upload_image(tmp_path / "image.fits"),
            service.upload_psf(tmp_path / "psf.fits"),
        )
        assert image["id"] == sha256_of(tmp_path / "image.fits")
        with pytest.raises(DataError, match=r"no-noise-model.*--noise"):
            service.submit(
                "deconvolve", image_id=image["id"], method={"name": "linear", "stop": "discrepancy"}
            )
        job = service.submit("deconvolve", image_id=image["id"], psf_id=psf["id"])
        os.utime(tmp_path / "image.fits", ns=(1, 1))
        with pytest.raises(OSError, match=r"image\.fits changed while it was read"):
            service.wait(job)
        in_place, archive = (
            service.upload_transit(path)["id"] for path in (folder, tmp_path / "transit.tar")
        )
        assert in_place == archive
        with service.inputs.transits[archive].folder() as place:
            assert place != folder.resolve() and (place / "transit.json").is_file()
        assert not place.exists()
        service.upload_transit(folder)
        with service.inputs.transits[in_place].folder() as place:
            assert place == folder.resolve()
        (folder / "transit.json").touch()
        with pytest.raises(OSError, match="changed"), service.inputs.transits[in_place].folder():
            pass
        with pytest.raises(DataError, match="no-manifest"):
            service.upload_transit(tmp_path)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The file of a PSF that a service built, and its id."""
    folder = tmp_path_factory.mktemp("built")
    (folder / "small.toml").write_text(SMALL_INSTRUMENT)
    with local() as service:
        return folder / "p.fits", service.build_psf(folder / "small.toml", folder / "p.fits", size=64)["id"]


def test_the_file_of_a_built_psf_keeps_its_id_and_that_of_its_products(
    built: tuple[Path, str], api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    psf, identity = built
    write_image(tmp_path / "i.fits", WAVELNTH=171)
    with local() as service:
        assert service.upload_psf(psf)["id"] == heliopsf.read_psf(psf).provenance["psf_id"] == identity
        product = service.deconvolve(tmp_path / "i.fits", tmp_path / "o.fits", psf_id=identity, steps=1)
        assert fits.getheader(tmp_path / "o.fits")["PSFID"] == identity
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

    def cut(changed: Path) -> None:
        with changed.open("wb") as target:
            write_cutout(file, 32, limits, target)

    changes: dict[str, Callable[[Path], object]] = {
        "pixel": pixel,
        "card": card,
        "rebinned": lambda changed: write_built(changed, rebinned(read_psf(file, limits), 2)),
        "cutout": cut,
        "rewritten": lambda changed: write_built(changed, read_psf(file, limits)),
    }
    with local() as service:
        for name, change in changes.items():
            change(tmp_path / f"{name}.fits")
            digest = sha256_of(tmp_path / f"{name}.fits")
            assert service.upload_psf(tmp_path / f"{name}.fits")["id"] == digest != built[1], name


def _note(stages: list[str], stage: str, step: int, steps: int) -> None:
    stages.append(stage)


def _built(folder: Path) -> tuple[str, list[str], bytes]:
    """Build the small PSF as a new command: its id, the stages, and the file."""
    stages: list[str] = []
    (folder / "small.toml").write_text(SMALL_INSTRUMENT)
    with local() as service:
        psf = service.build_psf(
            folder / "small.toml",
            folder / "psf.fits",
            size=64,
            preview=folder / "psf.png",
            progress=partial(_note, stages),
            overwrite=True,
        )
    return psf["id"], stages, (folder / "psf.fits").read_bytes()


def test_a_psf_is_built_once_and_is_the_same_afterwards_and_for_python(tmp_path: Path) -> None:
    identity, stages, content = _built(tmp_path)
    assert "building the PSF" in stages
    assert _built(tmp_path) == (identity, [], content)
    psf_cache().clear()
    heliopsf.build_psf(tmp_path / "small.toml", size=64)
    assert _built(tmp_path) == (identity, [], content)


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
    for name in ("first", "second", "third"):
        stages: list[str] = []
        told = partial(_note, stages)
        with local() as service:
            product = service.deconvolve(tmp_path / "image.fits", tmp_path / name, steps=1, progress=told)
            if name == "second":
                assert service.build_psf("small", tmp_path / "psf.fits")["id"] == product["psf_id"]
        assert ("building the PSF" in stages) == (name == "first")
    assert len({(tmp_path / name).read_bytes() for name in ("first", "second", "third")}) == 1
    assert "DIFFRACTION" in heliopsf.read_psf(tmp_path / "psf.fits").components
    files.match_table.cache_clear()


def test_an_id_or_a_context_without_a_service_is_told(image_file: Path, tmp_path: Path) -> None:
    asked = ["deconvolve", str(image_file), "-o", str(tmp_path / "o.fits"), "--local"]
    for option, value in (("--psf", "0123456789"), ("--context", "years")):
        done = CliRunner().invoke(main, [*asked, option, value])
        assert done.exit_code == 1 and "service" in done.output and value in done.output, done.output
