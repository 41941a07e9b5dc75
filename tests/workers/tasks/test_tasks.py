"""Tasks as functions on a temporary store: right results and clear errors."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.deconvolve import whole
from psfcore.deconvolve.methods.registry import method_names
from psfcore.errors import DataError
from psfcore.fits.product.planes import read_planes
from service.cli.options import METHODS
from service.client.http import ServiceError
from service.local import LocalService
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.contract.phases import Phase
from workers.run import attempt
from workers.settings import Settings
from workers.tasks import deconvolve as deconvolve_task


def test_a_product_names_its_inputs_and_keeps_the_header(
    local: LocalService, image_file: Path, psf_file: Path, tmp_path: Path
) -> None:
    psf = local.upload_psf(psf_file)
    product = local.deconvolve(
        image_file, tmp_path / "out.fits", psf_id=psf["id"], preview=tmp_path / "p.png"
    )
    with fits.open(tmp_path / "out.fits", checksum=True) as hdus:
        header, pixels = hdus[0].header, hdus[0].data
    assert header["PSFID"] == psf["id"] and header["PSFVERS"] == psf["version"]
    assert header["INPSHA"] == product["image_id"] and header["PRODID"] == product["id"]
    assert header["DCNVMETH"] == "richardson-lucy" and header["DCNVITER"] == 20
    assert header["TELESCOP"] == "TEST" and header["XPOSURE"] == 2.0
    assert "CHECKSUM" in header and "DATASUM" in header
    before = fits.getdata(image_file)
    assert pixels.shape == before.shape
    assert pixels.max() > 1.2 * before.max()
    assert pixels.sum() == pytest.approx(before.sum(), rel=1e-4)
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_progress_comes_step_by_step(local: LocalService, image_file: Path, psf_file: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    psf_id = local.upload_psf(psf_file)["id"]
    local.deconvolve(image_file, psf_id=psf_id, steps=4, progress=lambda *at: seen.append(at))
    assert [at for at in seen if at[0] == "deconvolving"] == [("deconvolving", n, 4) for n in (1, 2, 3, 4)]


def test_an_identical_request_is_not_computed_again(
    local: LocalService, image_file: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    psf_id = local.upload_psf(psf_file)["id"]
    first = local.deconvolve(image_file, psf_id=psf_id)
    monkeypatch.delattr(deconvolve_task, "Work")
    assert local.deconvolve(image_file, psf_id=psf_id) == first


@pytest.mark.parametrize("threads", [1, 2])
def test_a_worker_with_one_thread_draws_in_that_thread(
    settings: Settings, image_file: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    """A second thread would slow down the worker beside it."""
    of_threads: dict[str, int] = {}

    def noted(where: object, name: str) -> None:
        real = getattr(where, name)

        def wrapped(*arguments: Any, **named: Any) -> Any:
            of_threads[name] = threading.get_ident()
            return real(*arguments, **named)

        monkeypatch.setattr(where, name, wrapped)

    noted(deconvolve_task, "save_preview")
    noted(whole, "measure_changes")
    local = LocalService(settings.model_copy(update={"worker_threads": threads}))
    local.deconvolve(image_file, psf_id=local.upload_psf(psf_file)["id"])
    local.close()
    assert (of_threads["save_preview"] == of_threads["measure_changes"]) == (threads == 1)


def test_a_job_redelivered_after_its_end_does_nothing(
    local: LocalService, settings: Settings, image_file: Path, psf_file: Path
) -> None:
    image_id, psf_id = local.upload_image(image_file)["id"], local.upload_psf(psf_file)["id"]
    job = local.wait(local.submit("deconvolve", image_id=image_id, psf_id=psf_id))
    local.wait(job)
    rows = Catalogue(settings.catalogue_url).page(ProductRow, owner=DEFAULT_OWNER, limit=10)
    assert len(rows) == 1
    assert local.wait(job)["attempt"] == 1


@pytest.mark.parametrize(
    ("value", "code"), [(np.nan, "all-nan"), (0.0, "no-signal")], ids=["all NaN", "all zero"]
)
def test_pixels_that_cannot_be_used_are_the_users_error(
    local: LocalService, psf_file: Path, tmp_path: Path, value: float, code: str
) -> None:
    image = tmp_path / "bad.fits"
    fits.PrimaryHDU(np.full((64, 64), value, "f4")).writeto(image)
    with pytest.raises(ServiceError) as caught:
        local.deconvolve(image, psf_id=local.upload_psf(psf_file)["id"])
    assert caught.value.code == code
    assert "expected" in str(caught.value)


def test_a_psf_that_sums_to_three_is_the_users_error(local: LocalService, tmp_path: Path) -> None:
    write_psf(tmp_path / "three.fits", scale=3.0)
    with pytest.raises(DataError, match="expected"):
        local.upload_psf(tmp_path / "three.fits")


def test_a_built_psf_carries_its_provenance(local: LocalService, tmp_path: Path) -> None:
    file = tmp_path / "small.toml"
    file.write_text(SMALL_INSTRUMENT)
    psf = local.build_psf(file, tmp_path / "psf.fits", size=256, preview=tmp_path / "psf.png")
    assert psf["status"] == "draft" and psf["instrument"] == "small"
    provenance = psf["details"]["provenance"]
    assert len(provenance["instrument_file_sha256"]) == 64
    assert provenance["software_version"] and provenance["algorithm_version"]
    with fits.open(tmp_path / "psf.fits") as hdus:
        assert hdus[0].header["PSFVERS"] == psf["version"]
        assert hdus[0].data.shape == (256, 256)
    assert (tmp_path / "psf.png").read_bytes().startswith(b"\x89PNG")


def test_a_cancelled_job_stops_at_its_next_step(
    local: LocalService, settings: Settings, psf_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempt, "REPORT_EVERY_S", 0.0)
    write_image(tmp_path / "i.fits")
    image_id, psf_id = local.upload_image(tmp_path / "i.fits")["id"], local.upload_psf(psf_file)["id"]
    job = local.submit("deconvolve", image_id=image_id, psf_id=psf_id)
    catalogue = Catalogue(settings.catalogue_url)
    steps: list[int] = []

    def cancel_at_five(stage: str, step: int, _steps: int) -> None:
        steps.append(step)
        if (stage, step) == ("deconvolving", 5):
            catalogue.jobs.cancel(job["id"])

    with pytest.raises(ServiceError, match="cancelled"):
        local.wait(job, progress=cancel_at_five)
    row = catalogue.jobs.get(job["id"])
    assert row is not None and row.phase == Phase.ABORTED
    assert max(steps) == 5
    assert catalogue.page(ProductRow, owner=DEFAULT_OWNER, limit=1) == []


def test_a_transient_failure_is_retried_a_limited_number_of_times(
    local: LocalService, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object) -> str:
        raise ConnectionError("storage away")

    monkeypatch.setattr("workers.tasks.psf_build.psf_build", away)
    job = local.submit("psf-build", instrument="hri_euv", size=64)
    catalogue = Catalogue(settings.catalogue_url)
    phases = []
    for _ in range(settings.max_attempts):
        local._runner.run(job["id"])
        row = catalogue.jobs.get(job["id"])
        assert row is not None
        phases.append(row.phase)
    assert phases == [Phase.QUEUED] * (settings.max_attempts - 1) + [Phase.ERROR]
    assert row.error is not None and row.error["fault"] == "transient"


def test_an_unexpected_exception_is_an_internal_error_and_is_logged(
    local: LocalService, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> str:
        raise ZeroDivisionError("ours")

    monkeypatch.setattr("workers.tasks.psf_build.psf_build", broken)
    with pytest.raises(ServiceError) as caught:
        local.build_psf("hri_euv", size=64)
    assert caught.value.code == "internal-error"
    assert "Traceback" in caplog.text


@pytest.mark.parametrize("method", METHODS)
def test_every_method_of_the_contract_runs_and_says_what_it_did(
    local: LocalService, image_file: Path, psf_file: Path, tmp_path: Path, method: str
) -> None:
    psf_id = local.upload_psf(psf_file)["id"]
    product = local.deconvolve(image_file, tmp_path / "o.fits", psf_id=psf_id, method=method, steps=3)
    details = product["details"]
    assert details["steps_done"] == 3 and details["method"]["name"] == method
    assert abs(details["flux_change_pct"]) < 5
    with fits.open(tmp_path / "o.fits") as hdus:
        assert hdus[0].header["DCNVMETH"] == method and hdus[0].header["DCNVEDGE"] == details["edges"]
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "QUALITY"]
        assert hdus["QUALITY"].data.shape == hdus[0].data.shape


def test_the_contract_holds_the_methods_that_psfcore_has() -> None:
    assert sorted(METHODS) == method_names()


def test_error_planes_need_known_noise(
    local: LocalService, image_file: Path, psf_file: Path, tmp_path: Path
) -> None:
    psf_id = local.upload_psf(psf_file)["id"]
    wanted = {"psf_id": psf_id, "steps": 3, "error_draws": 4}
    with pytest.raises(DataError) as caught:
        local.deconvolve(image_file, **wanted)
    assert caught.value.code == "no-noise-figures"
    product = local.deconvolve(image_file, tmp_path / "o.fits", noise=(6.0, 2.0), **wanted)
    error = read_planes(tmp_path / "o.fits")["ERROR"]
    assert error.shape == (96, 128) and (error > 0).all()
    assert product["details"]["noise_amplification"] > 1


@pytest.mark.filterwarnings("ignore")
def test_a_formula_as_a_name_and_a_garbage_detector_do_not_lose_the_product(
    local: LocalService, tmp_path: Path
) -> None:
    write_image(tmp_path / "image.fits", DETECTOR="$\\frac{$", FILLER="x" * 30)
    content = (tmp_path / "image.fits").read_bytes()
    at = content.index(b"FILLER  ")
    (tmp_path / "image.fits").write_bytes(content[:at] + b"INSTRUME= 3 2 x".ljust(80) + content[at + 80 :])
    write_psf(tmp_path / "psf.fits")
    with fits.open(tmp_path / "psf.fits", mode="update") as hdus:
        hdus[0].header["PSFNAME"] = "$\\frac{$"
    psf = local.upload_psf(tmp_path / "psf.fits")
    product = local.deconvolve(
        tmp_path / "image.fits",
        psf_id=psf["id"],
        steps=2,
        preview=tmp_path / "p.png",
        changes=tmp_path / "c.png",
    )
    assert product["id"] and (tmp_path / "p.png").stat().st_size > 0 < (tmp_path / "c.png").stat().st_size


def test_a_damaged_detector_is_not_named_in_the_title(local: LocalService, tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits", FILLER="x" * 30)
    content = (tmp_path / "image.fits").read_bytes()
    at = content.index(b"FILLER  ")
    (tmp_path / "image.fits").write_bytes(content[:at] + b"DETECTOR= 'open".ljust(80) + content[at + 80 :])
    write_psf(tmp_path / "psf.fits")
    psf = local.upload_psf(tmp_path / "psf.fits")
    assert local.deconvolve(tmp_path / "image.fits", psf_id=psf["id"], steps=2)["id"]
