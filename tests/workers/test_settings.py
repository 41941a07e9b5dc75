"""Settings that are lists of names, and the memory that jobs may use by default."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from workers.settings import Settings


def test_proxies_are_addresses_and_networks() -> None:
    assert Settings(trusted_proxies="").proxies == ()
    given = Settings(trusted_proxies=" 127.0.0.1, 10.0.0.0/8,::1,").proxies
    assert given == ("127.0.0.1", "10.0.0.0/8", "::1")
    # A name that uvicorn does not know as an address would silently match nothing.
    for wrong in ("*", "proxy.example.org", "10.0.0.1/8", "127.0.0.1 10.0.0.1"):
        with pytest.raises(ValidationError, match="expected IP addresses or networks"):
            Settings(trusted_proxies=wrong)


def test_names_of_hosts_are_in_lower_case() -> None:
    assert Settings(allowed_hosts=" Sun.Example.org , *").host_names == ("sun.example.org", "*")


def test_the_largest_job_follows_from_memory_and_processes_unless_the_operator_sets_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("workers.settings.memory_bytes", lambda: 8 * 2**30)
    monkeypatch.delenv("HELIOPSF_MAX_JOB_MEMORY_MIB", raising=False)
    assert Settings(worker_processes=1).max_job_memory_mib == 6553
    assert Settings(worker_processes=4).max_job_memory_mib == 1638
    monkeypatch.setenv("HELIOPSF_MAX_JOB_MEMORY_MIB", "100000")
    assert Settings().max_job_memory_mib == 100_000
