"""Requests made from the description of the interface itself: nothing fails, and all is as described.

Ids that are made up name nothing, so about every other one is replaced by one of a thing that is there.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from schemathesis.checks import (
    content_type_conformance,
    ignored_auth,
    negative_data_rejection,
    not_a_server_error,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from schemathesis.schemas import BaseSchema

from service.app import create_app
from service.openapi import description
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.serving import serving
from workers.catalogue.access import Scope
from workers.settings import Settings

# The same requests each time, however slow the machine is.
STEADY: dict[str, Any] = {
    "deadline": None,
    "database": None,
    "derandomize": True,
    "suppress_health_check": list(HealthCheck),
    "phases": [Phase.explicit, Phase.generate],
}
CHECKS = [
    negative_data_rejection,
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    ignored_auth,
]
# The requests are made when the test runs. Made while tests are collected, they take each worker of xdist ten seconds.
DESCRIBED = schemathesis.pytest.from_fixture("described")
# Requests that are not derived from each property of a schema. The longest test makes those too: they take minutes.
QUICKLY_DESCRIBED = schemathesis.pytest.from_fixture("described_without_coverage")
LONGEST_ADDRESS = 60_000  # characters
KNOWN: dict[str, str] = {}
FILES: dict[str, bytes] = {}


def openapi(*, coverage: bool) -> BaseSchema:
    """The description of the interface.

    coverage: whether requests are also derived from each property of a schema, hundreds for a large body.
    """
    schema = schemathesis.openapi.from_dict(json.loads(description()))
    # A list with far too many members is refused for its size, before they are counted. 412: without the version of
    # tus.
    refusals = schema.config.checks.negative_data_rejection
    refusals.expected_statuses = [*refusals.expected_statuses, "412", "413"]
    schema.config.phases.coverage.enabled = coverage
    return schema


@pytest.fixture(scope="module")
def described() -> BaseSchema:
    return openapi(coverage=True)


@pytest.fixture(scope="module")
def described_without_coverage() -> BaseSchema:
    return openapi(coverage=False)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """A server with some of everything, its address and a key."""
    folder = tmp_path_factory.mktemp("described")
    asks = Settings(
        data_dir=folder / "data", database_url=None, broker_url="filesystem://", access="keys", reads_per_minute=0,
        submissions_per_minute=0, max_upload_mib=2, uws_max_wait_s=0.05, stream_s=0.05, lease_s=100_000,
    )  # fmt: skip
    app = create_app(asks)
    with serving(app, log_level="error") as port:
        url = f"http://127.0.0.1:{port}"
        catalogue = app.state.heliopsf.catalogue
        catalogue.census.announce("host:1", time.time() + 10_000, "1")
        headers = {"Authorization": "Bearer " + catalogue.keys.make("ann", set(Scope))}
        with httpx.Client(base_url=url, headers=headers) as client:
            seed(client, folder)
        yield {"base_url": url, "headers": headers}


def seed(client: httpx.Client, folder: Path) -> None:
    """Make some of everything, and note its ids by the names that they have in addresses and requests."""
    write_image(folder / "image.fits", DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV")
    write_psf(folder / "psf.fits")
    for name, address in (("image", "/v1/images"), ("psf", "/v1/psfs")):
        FILES[name] = (folder / f"{name}.fits").read_bytes()
        sent = client.post(address, content=FILES[name])
        KNOWN[f"{name}_id"] = sent.raise_for_status().json()["id"]
    KNOWN["other_id"] = KNOWN["psf_id"]
    body = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 128}}
    KNOWN["job_id"] = client.post("/v1/jobs", json=body).raise_for_status().json()["id"]
    bulk = {"images": [KNOWN["image_id"]], "psf_id": KNOWN["psf_id"]}
    KNOWN["bulk_id"] = client.post("/v1/bulk", json=bulk).raise_for_status().json()["id"]
    pending = client.post("/uws/jobs", data={"KIND": "deconvolve", "image_id": KNOWN["image_id"]})
    KNOWN["uws"] = pending.headers["location"].rpartition("/")[2]


@schemathesis.serializer("application/fits")
def as_they_are(_context: Any, value: Any) -> bytes:
    """Files go as the bytes that they are. What was made up is no FITS: some begin like it, and some become an
    image."""
    content = (
        value if isinstance(value, bytes) else str(getattr(value, "data", value)).encode("utf-8", "replace")
    )
    return (content, b"SIMPLE  =" + content, FILES["image"])[sum(content) % 3]


@schemathesis.serializer("application/offset+octet-stream")
def as_parts(_context: Any, value: Any) -> bytes:
    """Parts of an upload are any bytes."""
    return (
        value if isinstance(value, bytes) else str(getattr(value, "data", value)).encode("utf-8", "replace")
    )


@schemathesis.hook
def map_case(context: Any, case: Any) -> Any:
    """About every other id becomes one that is there; which, follows from what was made up."""
    uws = case.operation.path.startswith("/uws")
    if uws and case.operation.path.endswith("{job_id}") and case.method != "GET":
        return case  # the one that is there is not destroyed: others ask for it too
    if isinstance(case.path_parameters, dict):
        case.path_parameters = {
            name: _known("uws" if uws else name, value) for name, value in case.path_parameters.items()
        }
    body = case.body
    if isinstance(body, dict) and isinstance(body.get("parameters"), dict):
        case.body = body | {
            "parameters": {name: _known(name, value) for name, value in body["parameters"].items()}
        }
    return case


def _known(name: str, value: Any) -> Any:
    """An id that was made up, or one that is there. What is no id stays none: it is to be refused."""
    is_id = isinstance(value, str) and (name == "uws" or re.fullmatch(r"[0-9a-f]{8,64}", value))
    return KNOWN[name] if is_id and name in KNOWN and sum(value.encode("utf-8", "replace")) % 2 else value


def ask(case: Any, service: dict[str, Any]) -> None:
    """Send a request as it was made up, and look at the answer."""
    if len(case.formatted_path) + len(urlencode(case.query or {}, doseq=True)) > LONGEST_ADDRESS:
        # The server reads 64 KiB of one and hangs up while the rest is sent: its answer may be lost on the way.
        return
    case.call_and_validate(
        base_url=service["base_url"], headers=service["headers"], checks=CHECKS, allow_redirects=False
    )


@QUICKLY_DESCRIBED.parametrize()
@settings(max_examples=1, **STEADY)  # one, because there are many operations
def test_the_service_is_as_it_is_described(case: Any, service: dict[str, Any]) -> None:
    ask(case, service)


@pytest.mark.slow
@DESCRIBED.parametrize()
@settings(max_examples=100, **STEADY)
def test_the_service_is_as_it_is_described_for_long(case: Any, service: dict[str, Any]) -> None:
    ask(case, service)
