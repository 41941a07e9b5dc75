"""The address that ``serve`` tells for a browser."""

from __future__ import annotations

import pytest

from service.cli.serve import browser_address


def test_a_browser_is_sent_to_an_address_that_it_can_open(subtests: pytest.Subtests) -> None:
    for listens, open in (
        ("http://127.0.0.1:8765", "http://127.0.0.1:8765"),
        ("http://[::1]:80", "http://[::1]:80"),
        ("http://sun.example.org:9000", "http://sun.example.org:9000"),
        ("http://0.0.0.0:8765", "http://localhost:8765"),
        ("http://[::]:8765", "http://localhost:8765"),
    ):
        with subtests.test(str((listens, open))):
            assert browser_address(listens) == open
