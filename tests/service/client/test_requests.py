"""The client's requests that no command makes: contents of files, estimates, keys, and the events of an owner."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

from service.client.errors import ServiceError
from service.client.http import Client
from tests.conftest import write_image, write_psf
from tests.service.api.live import running
from tests.service.keyed import Keyed
from workers.catalogue.access.keys import Scope
from workers.settings import Settings

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def client(api: TestClient) -> Iterator[Client]:
    """A client of the application in this process."""
    with Client("http://testserver", transport=api._transport) as made:
        yield made


@pytest.fixture
def image_id(client: Client, tmp_path: Path) -> str:
    write_image(tmp_path / "sun.fits", shape=(48, 64))
    identity: str = client.upload_image(tmp_path / "sun.fits")["id"]
    return identity


@pytest.fixture
def psf_id(client: Client, tmp_path: Path) -> str:
    write_psf(tmp_path / "psf.fits")
    identity: str = client.upload_psf(tmp_path / "psf.fits")["id"]
    return identity


@pytest.fixture
def product_id(client: Client, image_id: str, psf_id: str, run_jobs: Callable[[], None]) -> str:
    job = client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method={"name": "linear"})
    run_jobs()
    return str(client.job(job["id"])["result"].rpartition("/")[2])


def test_contents_of_files(client: Client, image_id: str, product_id: str, tmp_path: Path) -> None:
    stored = fits.getdata(tmp_path / "sun.fits").astype(np.float32)
    whole = client.pixels("image", image_id)
    np.testing.assert_array_equal(whole, stored)
    assert whole.dtype == np.float32 and whole.flags.writeable
    part = client.pixels("image", image_id, x=4, y=8, width=20, height=10)
    np.testing.assert_array_equal(part, stored[8:18, 4:24])
    means = client.pixels("image", image_id, step=4)
    np.testing.assert_allclose(means, stored.reshape(12, 4, 16, 4).mean((1, 3)), rtol=1e-6)
    client.download(f"/v1/products/{product_id}/file", tmp_path / "product.fits")
    quality = client.pixels("product", product_id, "quality")
    np.testing.assert_array_equal(quality, fits.getdata(tmp_path / "product.fits", "QUALITY"))
    for more, code in (({"plane": "error"}, "no-such-plane"), ({"x": 64}, "window-outside")):
        with pytest.raises(ServiceError) as refused:
            client.pixels("product", product_id, **more)  # type: ignore[arg-type]
        assert refused.value.code == code

    [primary] = client.image_header(image_id)
    header = fits.getheader(tmp_path / "sun.fits")
    assert [card[0] for card in primary["cards"]] == [card.keyword for card in header.cards]
    assert ["TELESCOP", header["TELESCOP"], header.comments["TELESCOP"]] in primary["cards"]
    listed = client.product_header(product_id)
    assert [one["index"] for one in listed] == list(range(len(listed)))
    assert "QUALITY" in [one["name"] for one in listed]
    assert "DCNVMETH" in {card[0] for card in listed[0]["cards"]}
    client.thumbnail(product_id, tmp_path / "small.png")
    assert (tmp_path / "small.png").read_bytes().startswith(PNG)


def test_an_estimate_starts_no_job(client: Client, image_id: str, psf_id: str) -> None:
    asked = {"image_id": image_id, "psf_id": psf_id, "method": {"name": "linear"}}
    told = client.estimate("deconvolve", **asked)
    assert told["psf"]["id"] == psf_id and told["estimate"]["seconds"] > 0 and told["existing"] is None
    assert told["result_id"] == client.result_id("deconvolve", **asked)
    assert list(client.jobs()) == []


def test_keys_are_made_listed_and_revoked(service: Keyed) -> None:
    own = service.key("ann", Scope.READ, Scope.SUBMIT)
    with Client("http://testserver", key=own, transport=service.api._transport) as client:
        made = client.make_key(["read"], label="laptop", lasts_days=2)
        listed = list(client.keys())
        assert [one["id"] for one in listed] == [made["id"], own.split("_")[1]]
        assert listed[0]["label"] == "laptop" and "key" not in listed[0]
        assert client.revoke_key(made["id"])["state"] == "revoked"
        with pytest.raises(ServiceError) as unknown:
            client.revoke_key("0" * 16)
        assert unknown.value.code == "no-such-key"


def test_the_events_of_an_owner_tell_of_every_job_and_of_named_ones(settings: Settings) -> None:
    with running(settings.model_copy(update={"stream_s": 1.0})) as live:
        first, lease = live.job()
        live.catalogue.jobs.complete(lease, "/v1/psfs/x")
        events = live.client.events(jobs=[first, "0" * 32])
        seen = [next(events), next(events)]
        assert {(name, told["id"]) for name, told in seen} == {("job", first), ("gone", "0" * 32)}
        second, _ = live.job()
        name, told = next(events)  # of a later stream, because each one lasts a second
        assert (name, told["id"], told["phase"]) == ("job", second, "EXECUTING")
        events.close()  # type: ignore[attr-defined]
