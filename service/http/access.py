"""Decides who may use the service: everybody, or only clients with a key.

By default a service bound to a loopback address is open, and any other service requires keys.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from service.client.address import is_loopback
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

log = logging.getLogger(__name__)
LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


class NoKeyYet(Exception):
    """The service requires keys, but none exists. The message says how to make one."""


@dataclass(frozen=True)
class Access:
    """Whether requests need a key, and which host names requests may use. hosts is None if any name is allowed."""

    keys: bool
    hosts: frozenset[str] | None

    @classmethod
    def of(cls, settings: Settings, bound_to: str) -> Access:
        """Read the settings. Without a setting, the service is open only on a loopback address."""
        keys = not is_loopback(bound_to) if settings.access is None else settings.access == "keys"
        named = frozenset(settings.host_names)
        if "*" in named or not (named or (not keys and is_loopback(bound_to))):
            return cls(keys, None)
        return cls(keys, named | LOOPBACK_NAMES | {bound_to.lower()})


def check_can_serve(settings: Settings, host: str, catalogue: Catalogue) -> None:
    """Before a server listens, check that somebody can use the server. Raises ``NoKeyYet`` if the server needs keys
    by default and no key exists."""
    access = Access.of(settings, host)
    if not access.keys:
        if not is_loopback(host):
            log.warning(
                "open on %s: everybody who can reach this address has full access (HELIOPSF_ACCESS=open)",
                host,
            )
        return
    if catalogue.keys.any_good():
        return
    how = "heliopsf key create --owner NAME --scope read --scope submit"
    if settings.access == "keys":
        log.warning("no key exists yet, so every request will be refused; make a key: %s", how)
        return
    raise NoKeyYet(
        f"{host} can be reached from other machines, so every request needs a key, and no key exists yet. Make a key:\n"
        f"  {how}\n"
        "To work without keys, serve on 127.0.0.1 (only this machine), or set HELIOPSF_ACCESS=open (everybody has access)."
    )
