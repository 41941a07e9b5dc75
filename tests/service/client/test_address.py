"""Addresses of services, as users write them."""

from __future__ import annotations

import httpx
import pytest

from service.client.address import service_address
from service.client.errors import ServiceError
from service.client.http import Client


def test_a_service_of_this_machine_needs_no_scheme() -> None:
    for said, url in (
        ("localhost:8791", "http://localhost:8791"),
        (" 127.0.0.1:8791 ", "http://127.0.0.1:8791"),
        ("[::1]:8791", "http://[::1]:8791"),
        ("localhost", "http://localhost"),
        ("http://sun.example:80", "http://sun.example:80"),
        ("https://sun.example/heliopsf", "https://sun.example/heliopsf"),
    ):
        assert service_address(said) == url


def test_other_addresses_are_refused_with_an_example() -> None:
    for said, told in (
        ("sun.example:8765", "write https://sun.example:8765"),
        ("10.0.0.7:8765", "https://10.0.0.7:8765"),
        ("ftp://localhost", "expected the address of a service"),
        ("localhost:port", "expected the address of a service"),
        ("http://", "expected the address of a service"),
        ("local host:1", "expected the address of a service"),
        ("http://localhost:99999", "expected the address of a service"),
        ("[::1:8791", "expected the address of a service"),
    ):
        with pytest.raises(ServiceError) as refused:
            service_address(said)
        assert refused.value.code == "bad-address" and told in str(refused.value), said


def test_an_error_says_how_to_start_a_service_at_this_address() -> None:
    def refuse(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("connection refused")

    for server, told in (
        ("localhost:8765", "`heliopsf serve` starts"),
        ("localhost:9321", "`heliopsf serve --port 9321` starts"),
        ("http://[::1]:9321", "`heliopsf serve --port 9321` starts"),
        ("http://localhost", "`heliopsf serve --port 80` starts"),
        ("https://localhost:9321", "ask the operator"),
        ("http://sun.example:8765", "ask the operator"),
    ):
        with (
            Client(server, transport=httpx.MockTransport(refuse)) as client,
            pytest.raises(ServiceError) as no,
        ):
            client.health()
        assert told in str(no.value), server


def test_the_client_takes_the_address_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_SERVER", "localhost:8791")
    with Client() as client:
        assert client.server == "http://localhost:8791"
