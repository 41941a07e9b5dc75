"""Settings that are lists of names."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from workers.settings import Settings


def test_proxies_are_addresses_and_networks() -> None:
    assert Settings(trusted_proxies="").proxies == ()
    assert Settings(trusted_proxies=" 127.0.0.1, 10.0.0.0/8,::1,").proxies == (
        "127.0.0.1",
        "10.0.0.0/8",
        "::1",
    )


@pytest.mark.parametrize("wrong", ["*", "proxy.example.org", "10.0.0.1/8", "127.0.0.1 10.0.0.1"])
def test_other_names_of_proxies_are_refused(wrong: str) -> None:
    """A name that uvicorn does not know as an address would silently match nothing."""
    with pytest.raises(ValidationError, match="expected IP addresses or networks"):
        Settings(trusted_proxies=wrong)


def test_names_of_hosts_are_in_lower_case() -> None:
    assert Settings(allowed_hosts=" Sun.Example.org , *").host_names == ("sun.example.org", "*")
