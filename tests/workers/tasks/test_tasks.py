"""Tasks as functions on a temporary store: right results, warnings and clear errors."""

from __future__ import annotations

import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.deconvolve import conditions, run, work
from psfcore.deconvolve.assess import pictures
from psfcore.deconvolve.assess.quality import QualityBit
from psfcore.drawing import plots
from service.client.http import ServiceError
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.in_process import InProcess
from tests.workers.jobs import job_row, run_job
from workers.contract.jobs import Phase
from workers.contract.requests import METHODS
from workers.run.runner import Runner
from workers.settings import Settings, software_version
from workers.tasks import deconvolve as deconvolve_task

OF_INPUT = {
    "FILENAME": "solo_L2_eui-hrieuv174-image_20220401T103005920_V01.fits",
    "DATE": "2022-04-19T17:47:09.475",
    "PARENT": "solo_L1_eui-hrieuv174-image_20220401T103005920_V01.fits",
    "CREATOR": "euiprep.py",
    "ORIGIN": "Royal Observatory of Belgium",
    "LEVEL": "L2",
    "VERSION": "01",
    "DATE-BEG": "2022-04-01T10:30:05.920",
}


def test_a_product_names_its_inputs_keeps_the_header_and_is_not_computed_again(
    local: InProcess, image_file: Path, psf_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    psf, steps = local.upload_psf(psf_file), []
    options = {"psf_id": psf["id"], "noise": (6.0, 2.0), "error_draws": 3}
    files = {"output": tmp_path / "out.fits", "preview": tmp_path / "p.png"}
    product = local.deconvolve(image_file, **files, **options, progress=lambda *step: steps.append(step))
    assert [step for stage, step, _ in steps if stage == "deconvolving"] == list(range(1, 21))
    draws = [step for stage, step, of in steps if stage == "error estimate" and of == 3]
    assert draws == [0, 0, 1, 2, 3]
    last = steps.index(("deconvolving", 20, 20))
    assert steps[last + 1] == ("error estimate", 0, 3), "at once, before the first of them is done"
    with fits.open(tmp_path / "out.fits", checksum=True) as hdus:
        header, pixels = hdus[0].header, hdus[0].data
    assert header["PSFID"] == psf["id"] and header["PSFVERS"] == psf["version"]
    assert header["INPSHA"] == product["image_id"] and header["PRODID"] == product["id"]
    assert header["DCNVMETH"] == "richardson-lucy" and header["DCNVITER"] == 20
    assert header["TELESCOP"] == "TEST" and header["XPOSURE"] == 2.0
    before = fits.getdata(image_file)
    assert pixels.shape == before.shape
    assert pixels.max() > 1.2 * before.max()
    assert pixels.sum() == pytest.approx(before.sum(), rel=1e-4)
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.delattr(deconvolve_task, "make")
    assert local.deconvolve(image_file, **options) == product


def test_equal_requests_give_equal_bytes(local: InProcess, psf_file: Path, tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits", **OF_INPUT)
    (tmp_path / "other name.fits").write_bytes((tmp_path / "image.fits").read_bytes())
    second = InProcess(Settings.apart(tmp_path / "second"))
    for name, service in (("image", local), ("other name", second)):
        psf_id = service.upload_psf(psf_file)["id"]
        output = tmp_path / f"{name}.out.fits"
        product = service.deconvolve(tmp_path / f"{name}.fits", output, psf_id=psf_id, steps=1)
    second.close()
    assert (tmp_path / "image.out.fits").read_bytes() == (tmp_path / "other name.out.fits").read_bytes()
    with warnings.catch_warnings(), fits.open(tmp_path / "image.out.fits", checksum=True) as hdus:
        warnings.simplefilter("error")
        for hdu in hdus:
            assert hdu.verify_checksum() == hdu.verify_datasum() == 1, hdu.name
        header = hdus[0].header
    assert header["FILENAME"] == product["details"]["filename"]
    assert header["FILENAME"] == f"{OF_INPUT['FILENAME'][:-5]}-{product['id'][:16]}.fits"
    assert header["PARENT"] == OF_INPUT["FILENAME"] and header["LEVEL"] == "L3"
    assert header["CREATOR"] == f"heliopsf {software_version()}"
    assert not {"DATE", "ORIGIN", "VERSION"} & set(header)
    assert header["DATE-BEG"] == OF_INPUT["DATE-BEG"]
    history = list(header["HISTORY"])
    assert product["image_id"] in history and f"input DATE: {OF_INPUT['DATE']}" in history


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

    noted(run, "draw_preview")
    noted(work, "measure_changes")
    local = InProcess(settings.model_copy(update={"worker_threads": threads}))
    local.deconvolve(image_file, psf_id=local.upload_psf(psf_file)["id"])
    local.close()
    assert (of_threads["draw_preview"] == of_threads["measure_changes"]) == (threads == 1)


def test_a_file_that_cannot_be_used(local: InProcess, psf_file: Path, tmp_path: Path) -> None:
    fits.PrimaryHDU(np.full((64, 64), np.nan, "f4")).writeto(tmp_path / "i.fits")
    with pytest.raises(ServiceError, match="expected") as caught:
        local.deconvolve(tmp_path / "i.fits", psf_id=local.upload_psf(psf_file)["id"])
    assert caught.value.code == "all-nan"


def test_a_built_psf_carries_its_provenance(local: InProcess, tmp_path: Path) -> None:
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


def test_a_transient_failure_is_retried_a_limited_number_of_times(
    local: InProcess, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object) -> str:
        raise ConnectionError("storage away")

    monkeypatch.setattr("workers.tasks.psf_build.psf_build", away)
    job = local.submit("psf-build", instrument="hri_euv", size=64)
    phases = []
    runner = Runner(settings, local.catalogue, local.store)
    for _ in range(settings.max_attempts):
        run_job(runner, local.catalogue, job["id"])
        row = job_row(local.catalogue, job["id"])
        phases.append(row.phase)
    assert phases == [Phase.QUEUED] * (settings.max_attempts - 1) + [Phase.ERROR]
    assert row.error is not None and row.error["fault"] == "transient"
    run_job(runner, local.catalogue, job["id"])
    assert job_row(local.catalogue, job["id"]).attempt == row.attempt, (
        "a message that comes again does nothing"
    )


def test_an_unexpected_exception_is_an_internal_error_and_is_logged(
    local: InProcess, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> str:
        raise ZeroDivisionError("ours")

    monkeypatch.setattr("workers.tasks.psf_build.psf_build", broken)
    with pytest.raises(ServiceError) as caught:
        local.build_psf("hri_euv", size=64)
    assert caught.value.code == "internal-error"
    assert "Traceback" in caplog.text


def test_every_method_runs_and_says_so(local: InProcess, psf_file: Path, tmp_path: Path) -> None:
    psf_id = local.upload_psf(psf_file)["id"]
    write_image(tmp_path / "i.fits", shape=(64, 64))
    for method in METHODS:
        output = tmp_path / f"{method}.fits"
        product = local.deconvolve(tmp_path / "i.fits", output, psf_id=psf_id, method=method, steps=2)
        details = product["details"]
        assert details["steps_done"] == 2 and details["method"]["name"] == method
        assert abs(details["flux_change_pct"]) < 5, method
        with fits.open(output) as hdus:
            assert hdus[0].header["DCNVMETH"] == method and hdus[0].header["DCNVEDGE"] == details["edges"]
            assert [hdu.name for hdu in hdus] == ["PRIMARY", "QUALITY"]
            assert hdus["QUALITY"].data.shape == hdus[0].data.shape


def with_card(path: Path, card: bytes, **cards: object) -> Path:
    """An image one of whose header cards is these bytes."""
    write_image(path, FILLER="x" * 30, **cards)
    content = path.read_bytes()
    at = content.index(b"FILLER  ")
    path.write_bytes(content[:at] + card.ljust(80) + content[at + 80 :])
    return path


@pytest.mark.filterwarnings("ignore")
def test_formulas_and_damaged_cards_lose_no_product(local: InProcess, tmp_path: Path) -> None:
    image = with_card(tmp_path / "image.fits", b"INSTRUME= 3 2 x", DETECTOR="$\\frac{$")
    write_psf(tmp_path / "psf.fits")
    fits.setval(tmp_path / "psf.fits", "PSFNAME", value="$\\frac{$")
    psf_id = local.upload_psf(tmp_path / "psf.fits")["id"]
    pictures = {"preview": tmp_path / "p.png", "changes": tmp_path / "c.png"}
    product = local.deconvolve(image, psf_id=psf_id, steps=2, **pictures)
    assert product["id"] and all(path.stat().st_size > 0 for path in pictures.values())
    damaged = with_card(tmp_path / "damaged.fits", b"DETECTOR= 'open")
    assert local.deconvolve(damaged, psf_id=psf_id, steps=2)["id"]


def test_jobs_share_prepared_psfs(local: InProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engines: list[object] = []
    real = conditions.new_engine
    monkeypatch.setattr(conditions, "new_engine", lambda *given: engines.append(given) or real(*given))
    write_psf(tmp_path / "psf.fits", size=62)  # of a size that no other test uses: a process shares them
    psf_id = local.upload_psf(tmp_path / "psf.fits")["id"]
    for seed in range(2):
        write_image(tmp_path / f"{seed}.fits", seed=seed)
        local.deconvolve(tmp_path / f"{seed}.fits", psf_id=psf_id, steps=2)
    assert len(engines) == 1


# Warnings -------------------------------------------------------------------------------------------


AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171}
FEW = {"steps": 2}


def test_saturation_seen_in_the_pixels(local: InProcess, psf_file: Path, tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits")
    pixels, cards = fits.getdata(tmp_path / "i.fits"), fits.getheader(tmp_path / "i.fits")
    fits.writeto(tmp_path / "i.fits", np.minimum(pixels, 120.0).astype("f4"), cards, overwrite=True)
    product = local.deconvolve(
        tmp_path / "i.fits", tmp_path / "o.fits", psf_id=local.upload_psf(psf_file)["id"], **FEW
    )
    full = fits.getdata(tmp_path / "i.fits") == 120.0
    with fits.open(tmp_path / "o.fits") as hdus:
        header, quality = hdus[0].header, hdus["QUALITY"].data
    np.testing.assert_array_equal((quality & QualityBit.SATURATED) > 0, full)
    band = product["details"]["edge_band_px"]
    inner = quality[band:-band, band:-band] if band else quality
    assert np.count_nonzero(inner == 0) > 0.8 * inner.size, "a good pixel has quality 0"
    assert (header["DCNVSATL"], header["DCNVSATF"]) == (120.0, "pixels")
    assert product["details"]["saturation"] == {"level": 120.0, "unit": "DN/s", "found": "pixels"}
    assert product["details"]["masked_pixels"]["saturated"] == np.count_nonzero(full) > 10


def test_warnings_about_the_inputs_are_in_header_and_details(local: InProcess, tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits", **{**AIA, "WAVELNTH": 193}, NSATPIX=7)
    write_psf(tmp_path / "p.fits")
    fits.writeto(tmp_path / "p.fits", fits.getdata(tmp_path / "p.fits"), fits.Header(AIA), overwrite=True)
    psf_id = local.upload_psf(tmp_path / "p.fits")["id"]
    product = local.deconvolve(
        tmp_path / "i.fits", tmp_path / "o.fits", psf_id=psf_id, other_channel=True, **FEW
    )
    assert {warning["code"] for warning in product["details"]["warnings"]} == {"saturation", "channel"}
    history = "".join(str(line) for line in fits.getheader(tmp_path / "o.fits")["HISTORY"])
    assert "WARNING (saturation): NSATPIX counts 7 saturated pixels" in history
    assert "WARNING (channel)" in history and "193 angstrom" in history


def test_pictures_name_the_unit_of_the_image(
    local: InProcess, image_file: Path, psf_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    units: list[str] = []
    for module, name in ((plots, "preview_png"), (pictures, "changes_png")):
        real = getattr(module, name)

        def noted(*arguments: Any, real: Any = real, **named: Any) -> None:
            units.append(named["unit"])
            real(*arguments, **named)

        monkeypatch.setattr(module, name, noted)
    fits.setval(image_file, "BUNIT", value="DN")
    psf_id = local.upload_psf(psf_file)["id"]
    local.deconvolve(image_file, psf_id=psf_id, changes=tmp_path / "changes.png", **FEW)
    assert units == ["DN in 2 s"] * 2
