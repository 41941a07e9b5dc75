"""Who is let in, as the operator decides it: everybody on this machine, or whoever has a key.

Nothing said, a service is open where it is bound to a loopback address, and asks for keys everywhere else.
"""

from __future__ import annotations

import ipaddress
import logging
from dataclasses import dataclass

from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

log = logging.getLogger(__name__)
LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


class NoKeyYet(Exception):
    """A service that asks for keys would start without any; the message says how to make one."""


@dataclass(frozen=True)
class Access:
    """Whether keys are asked for, and by which names the service is called. None: by any."""

    keys: bool
    hosts: frozenset[str] | None

    @classmethod
    def of(cls, settings: Settings, bound_to: str) -> Access:
        """As the settings say; where they say nothing, open on a loopback address alone."""
        keys = not is_loopback(bound_to) if settings.access is None else settings.access == "keys"
        named = frozenset(settings.host_names)
        if "*" in named or not (named or (not keys and is_loopback(bound_to))):
            return cls(keys, None)
        return cls(keys, named | LOOPBACK_NAMES | {bound_to.lower()})


def is_loopback(host: str) -> bool:
    """Whether an address is reached from its own machine alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name, of which nobody knows what it means elsewhere
        return False


def check_can_serve(settings: Settings, host: str, catalogue: Catalogue) -> None:
    """Before a server listens: ``NoKeyYet`` where others reach it, nobody said how they are let in, and no key is there."""
    access = Access.of(settings, host)
    if not access.keys:
        if not is_loopback(host):
            log.warning("open on %s: whoever reaches it may use all of it (HELIOPSF_ACCESS=open)", host)
        return
    if catalogue.keys.any_good():
        return
    how = "heliopsf key create --owner NAME --scope read --scope submit"
    if settings.access == "keys":
        log.warning("no key lets anybody in yet; make one: %s", how)
        return
    raise NoKeyYet(
        f"{host} can be reached from other machines, so every request needs a key, and there is none yet. Make one:\n"
        f"  {how}\n"
        "Without keys, serve on 127.0.0.1 (this machine alone), or set HELIOPSF_ACCESS=open to let everybody in."
    )
