"""Many images into a folder: what is done is skipped, what fails is told, and the run goes on."""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

from service.cli.local import local
from service.client import errors
from service.client.errors import ServiceError, WaitInterrupted
from service.client.http import Client
from service.client.many import Outcome, deconvolve_many
from service.client.operations import Operations
from tests.conftest import write_image, write_psf

Run = Callable[..., list[Outcome]]


class Told(Client):
    """A client of the application in this process. A job runs when somebody waits for it; what happens is told."""

    def __init__(self, api: TestClient, run_jobs: Callable[[], None]) -> None:
        super().__init__("http://testserver", transport=api._transport)
        self.run_jobs, self.told = run_jobs, list[str]()
        self.psf_id, self.uploaded = "", 0

    def upload_image(self, path: str | Path) -> dict[str, Any]:
        self.uploaded += 1
        return super().upload_image(path)

    def submit(self, kind: str, *, queue: str | None = None, **parameters: Any) -> dict[str, Any]:
        self.told.append("submit")
        return super().submit(kind, queue=queue, **parameters)

    def wait(self, job: dict[str, Any], **more: Any) -> dict[str, Any]:
        self.told.append("wait")
        self.run_jobs()
        return super().wait(job, **more)

    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        super().download(address, path, overwrite=overwrite)
        self.told.append("download")

    def many(self, images: list[Path], folder: Path, **more: Any) -> Iterator[Outcome]:
        return deconvolve_many(self, images, folder, psf_id=self.psf_id, steps=1, **more)


@pytest.fixture(params=["http", "local"])
def service(request: pytest.FixtureRequest) -> Iterator[Operations]:
    """A service in this process, reached as over HTTP or directly."""
    if request.param == "http":
        yield Told(request.getfixturevalue("api"), request.getfixturevalue("run_jobs"))
    else:
        with local() as here:
            yield here


def test_a_job_without_a_result_is_told(service: Operations) -> None:
    with pytest.raises(ServiceError) as told:
        service.result_of({"id": "9" * 32, "kind": "deconvolve"}, {"result": None})
    assert told.value.code == "no-result" and "9" * 32 in str(told.value)


@pytest.fixture
def run(service: Operations, tmp_path: Path) -> Run:
    write_psf(tmp_path / "psf.fits")
    psf_id = service.upload_psf(tmp_path / "psf.fits")["id"]

    def run(*images: Path, **more: Any) -> list[Outcome]:
        return list(
            deconvolve_many(service, images, tmp_path / "out", **{"psf_id": psf_id, "steps": 1} | more)
        )

    return run


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    """Two images of one name, and a copy of the first under another name."""
    paths = [tmp_path / name for name in ("a/image.fits", "b/image.fits", "copy.fits")]
    for seed, path in enumerate(paths[:2]):
        path.parent.mkdir()
        write_image(path, seed=seed)
    shutil.copy(paths[0], paths[2])
    return paths


def test_each_image_has_one_product_and_none_is_made_twice(
    run: Run, service: Operations, images: list[Path], tmp_path: Path
) -> None:
    first = run(*images)
    assert [(one.existed, one.failure) for one in first] == [(False, None), (False, None), (True, None)]
    assert first[0].output == first[2].output, "the bytes of both are the same"
    outputs = sorted((tmp_path / "out").iterdir())
    assert len(outputs) == 2 and {one.output for one in first} == set(outputs)
    for one in first:
        assert one.output is not None and one.output.name.startswith("image-")
        assert fits.getheader(one.output)["INPSHA"] in (service.upload_image(one.image)["id"],)
    before = {path: path.stat().st_mtime_ns for path in outputs}
    again = run(*images)
    assert all(one.existed for one in again) and [one.output for one in again] == [
        one.output for one in first
    ]
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()} == before


@pytest.mark.parametrize("service", ["local"], indirect=True)
def test_a_product_is_known_by_its_header_and_not_by_its_name(
    run: Run, images: list[Path], tmp_path: Path
) -> None:
    (made,) = run(images[0])
    assert made.output is not None
    renamed = made.output.rename(tmp_path / "out" / "renamed.fits")
    (known,) = run(images[0])
    assert known.existed and known.output == renamed
    packed = tmp_path / "out" / "packed.fits.gz"
    packed.write_bytes(gzip.compress(renamed.read_bytes()))
    renamed.unlink()
    assert run(images[0])[0].output == packed
    shutil.copy(images[1], made.output)  # an image under the name of the product
    packed.unlink()
    (refused,) = run(images[0])
    assert refused.failure is not None and "the file exists" in refused.failure
    assert made.output.read_bytes() == images[1].read_bytes()
    (replaced,) = run(images[0], overwrite=True)
    assert replaced.failure is None and fits.getheader(made.output)["PRODID"]

    (other,) = run(images[0], steps=2)
    assert not other.existed and other.output != made.output, "other parameters"
    made.output.write_bytes(made.output.read_bytes()[:-2880])
    (refused,) = run(images[0])
    assert refused.failure is not None and not refused.existed, "a file that was cut"
    assert run(images[0], overwrite=True)[0].failure is None and run(images[0])[0].existed


@pytest.mark.parametrize("service", ["http"], indirect=True)
def test_failures_are_told_and_the_run_goes_on(
    run: Run, service: Operations, images: list[Path], tmp_path: Path
) -> None:
    (product,) = run(images[0])
    assert product.output is not None
    product_file = shutil.copy(product.output, tmp_path / "product.fits")
    seen: list[tuple[int, int]] = []
    named = (tmp_path / "gone.fits", product_file, images[1])
    failures = [one.failure or "" for one in run(*named, progress=lambda *step: seen.append(step))]
    assert "No such file" in failures[0] and "not deconvolved before" in failures[1] and failures[2] == ""
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert run(product_file, again=True)[0].failure is None


def test_nothing_is_sent_or_kept_twice(
    api: TestClient, run_jobs: Callable[[], None], images: list[Path], tmp_path: Path
) -> None:
    client = Told(api, run_jobs)
    write_psf(tmp_path / "psf.fits")
    parameters = {"psf_id": client.upload_psf(tmp_path / "psf.fits")["id"], "steps": 1}
    for _ in range(2):
        list(deconvolve_many(client, images, tmp_path / "out", **parameters))
        assert (client.uploaded, client.told.count("submit")) == (2, 2)
    with local() as here:
        parameters["psf_id"] = here.upload_psf(tmp_path / "psf.fits")["id"]
        list(deconvolve_many(here, images[:1], tmp_path / "other", **parameters))
        assert not here.inputs.results, "products stay in the folder only"


def test_an_error_that_concerns_every_image_ends_the_run(tmp_path: Path, images: list[Path]) -> None:
    with pytest.raises(ServiceError, match="no answer"), Client("http://127.0.0.1:9") as nobody:
        list(deconvolve_many(nobody, images, tmp_path / "out"))
    (tmp_path / "file").touch()
    with local() as here, pytest.raises(ServiceError, match="expected a folder"):
        list(deconvolve_many(here, images, tmp_path / "file"))


@pytest.fixture
def told(api: TestClient, run_jobs: Callable[[], None], tmp_path: Path) -> Told:
    client = Told(api, run_jobs)
    write_psf(tmp_path / "psf.fits")
    client.psf_id = client.upload_psf(tmp_path / "psf.fits")["id"]
    return client


@pytest.fixture
def five(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / f"{number}.fits" for number in range(5)]
    for seed, path in enumerate(paths):
        write_image(path, seed=seed)
    return paths


def test_a_service_has_a_few_jobs_at_a_time_and_a_process_one(
    told: Told, five: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, int]] = []
    outcomes = list(told.many(five, tmp_path / "out", progress=lambda *step: seen.append(step)))
    assert [one.image for one in outcomes] == five and all(one.failure is None for one in outcomes)
    collected = ["wait", "download"]
    assert told.told == ["submit"] * 4 + [*collected, "submit"] + collected * 4
    assert seen == [(number, 5) for number in range(6)]
    told.told.clear()
    monkeypatch.setattr(told, "jobs_at_once", 1)  # as that of a service in this process
    list(told.many(five[:2], tmp_path / "other"))
    assert told.told == ["submit", *collected] * 2
    with local() as here:
        assert here.jobs_at_once == 1


def test_outcomes_keep_the_order_of_the_images(told: Told, five: list[Path], tmp_path: Path) -> None:
    """A file that is refused, a job that fails, and products that exist, beside jobs in flight."""
    list(told.many(five[3:], tmp_path / "out"))
    with fits.open(five[1], mode="update") as opened:
        opened[0].data[:] = float("nan")
    five[2].write_text("Dear archive,\n" * 300)
    outcomes = list(told.many(five, tmp_path / "out"))
    assert [one.image for one in outcomes] == five
    assert [one.failure is not None for one in outcomes] == [False, True, True, False, False]
    assert [one.existed for one in outcomes] == [False] * 3 + [True, True]
    assert "finite" in str(outcomes[1].failure) and "expected a FITS file" in str(outcomes[2].failure)


def test_a_copy_of_an_image_in_flight_waits_for_it_and_follows_where_it_fails(
    told: Told, images: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (first, _, copy) = told.many(images, tmp_path / "out")
    assert copy.existed and copy.output == first.output and told.told.count("submit") == 2
    download, failures = told.download, [OSError(5, "the disk failed")]

    def fail_once(*given: Any, **more: Any) -> None:
        if failures:
            raise failures.pop()
        download(*given, **more)

    monkeypatch.setattr(told, "download", fail_once)
    (first, _, copy) = told.many(images, tmp_path / "other")
    assert first.failure == "the disk failed"
    assert copy.failure is None and not copy.existed and copy.output is not None and copy.output.is_file()


def test_a_full_quota_ends_the_run_after_the_jobs_in_flight(
    told: Told, five: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    submit = told.submit

    def full_after_two(kind: str, **parameters: Any) -> dict[str, Any]:
        if told.told.count("submit") == 2:
            raise ServiceError("expected free room in your quota", status=507, code="quota-exceeded")
        return submit(kind, **parameters)

    monkeypatch.setattr(told, "submit", full_after_two)
    outcomes: list[Outcome] = []
    with pytest.raises(ServiceError, match="expected free room"):
        outcomes.extend(told.many(five, tmp_path / "out"))
    assert [one.output for one in outcomes] == sorted((tmp_path / "out").iterdir())
    assert [one.image for one in outcomes] == five[:2]


def test_control_c_names_all_jobs_in_flight(
    told: Told, five: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[str] = []
    wait = told.wait

    def interrupt_the_second(job: dict[str, Any], **more: Any) -> dict[str, Any]:
        waited.append(job["id"])
        if len(waited) == 2:
            raise KeyboardInterrupt
        return wait(job, **more)

    monkeypatch.setattr(told, "wait", interrupt_the_second)
    with pytest.raises(WaitInterrupted, match=r"jobs .* go on at http://testserver") as stopped:
        list(told.many(five, tmp_path / "out"))
    named = (stopped.value.identity, *stopped.value.others)
    assert named[0] == waited[1] and len(set(named)) == 4 and waited[0] not in named


def test_a_busy_service_is_asked_again(
    told: Told, five: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[float] = []
    monkeypatch.setattr(errors.time, "sleep", waited.append)
    submit = told.submit
    answers = [ServiceError("later", status=429, retry_after_s=7.0), ServiceError("later", status=503)]

    def busy(kind: str, **parameters: Any) -> dict[str, Any]:
        if answers:
            raise answers.pop(0)
        return submit(kind, **parameters)

    monkeypatch.setattr(told, "submit", busy)
    (outcome,) = told.many(five[:1], tmp_path / "out")
    assert outcome.failure is None and waited[:2] == [7.0, 1.0]
