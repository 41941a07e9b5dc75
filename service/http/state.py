"""The objects that all endpoints share: settings, catalogue, store and reconciler. Each application makes them once."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import anyio
from fastapi import Depends, Request

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.fits.viewing.planes import Planes
from service.http.access import Access
from service.http.problems import problem
from service.http.rates import AtOnce, Rates
from workers.catalogue.catalogue import Catalogue, Row
from workers.files.store import Store
from workers.rows import row_of
from workers.settings import Settings

if TYPE_CHECKING:
    from workers.broker.reconciler import Reconciler


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
    # Limits how many cut-outs are made at once, because each keeps a core busy. Other requests wait without
    # using a thread.
    cutouts: anyio.CapacityLimiter
    # The same for decoding planes and headers.
    decoding: anyio.CapacityLimiter
    # The same for the inspection of uploads.
    inspecting: anyio.CapacityLimiter
    planes: Planes
    started_at: float = field(default_factory=time.time)

    @property
    def limits(self) -> FitsLimits:
        """Limits of accepted FITS files."""
        return FitsLimits(max_pixels=self.settings.max_pixels)

    def row(self, table: type[Row], identity: str, owner: str) -> Row:
        """The owner's row with this id. Raises ``Problem`` 404 if there is none."""
        try:
            return row_of(self.catalogue, table, identity, owner)
        except DataError as error:
            raise problem(error) from error


def state_of(request: Request) -> State:
    """The objects of the application that answers a request."""
    state = request.app.state.heliopsf
    assert isinstance(state, State)
    return state


Shared = Annotated[State, Depends(state_of)]
