"""The objects that all endpoints share: settings, catalogue, store and reconciler. Each application makes them once.

``Access`` says who may use the service. By default a service bound to a loopback address is open, and any other service
requires keys.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated
from weakref import WeakValueDictionary

from fastapi import Depends, Request

from psfcore.fits.viewing.planes import Planes
from service.client.errors import is_loopback
from service.http.gate import Gate
from service.http.lookout import Lookout
from service.http.problems import as_problems
from service.http.rates import AtOnce, Rates
from workers.catalogue.catalogue import Catalogue, Row
from workers.checks import Watch
from workers.files.store import Store
from workers.lookup import row_of
from workers.settings import Settings

if TYPE_CHECKING:
    from workers.broker.reconciler import Reconciler


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
    by default and no key exists.
    """
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
        "To work without keys, serve on 127.0.0.1 (only this machine), or set HELIOPSF_ACCESS=open (everybody has "
        "access)."
    )


@dataclass(frozen=True)
class State:
    """Objects that exist as long as the application runs."""

    settings: Settings
    catalogue: Catalogue
    store: Store
    reconciler: Reconciler
    access: Access
    rates: Rates
    streams: AtOnce
    requests: AtOnce
    pixels: Gate  # for pixels and whole files: decodings, cut-outs, inspections of uploads
    stored: Gate  # for headers, and for calls of the store, which may not answer
    planes: Planes
    lookouts: WeakValueDictionary[str, Lookout] = field(
        default_factory=WeakValueDictionary
    )  # by owner, as long as they have streams
    watch: Watch = field(default_factory=Watch)
    started_at: float = field(default_factory=time.time)

    def row(self, table: type[Row], identity: str, owner: str) -> Row:
        """The owner's row with this id. Raises ``Problem`` 404 if there is none."""
        with as_problems():
            return row_of(self.catalogue, table, identity, owner)


def state_of(request: Request) -> State:
    """The objects of the application that answers a request."""
    state = request.app.state.heliopsf
    assert isinstance(state, State)
    return state


Shared = Annotated[State, Depends(state_of)]
