"""An application that asks for keys, for the tests of who may do what."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fastapi.testclient import TestClient

from service.app import create_app
from workers.catalogue.access import Scope
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

ALL = frozenset(Scope)


@dataclass(frozen=True)
class Keyed:
    """The application, reached without a key by ``api``, and its catalogue."""

    api: TestClient
    catalogue: Catalogue

    def key(self, owner: str, *scopes: Scope, lasts_s: float | None = None) -> str:
        """A new key; with all scopes but the administrator's where none is named."""
        wanted = set(scopes) or ALL - {Scope.ADMIN}
        expires_at = None if lasts_s is None else time.time() + lasts_s
        return self.catalogue.keys.make(owner, wanted, expires_at=expires_at)

    def client(self, owner: str, *scopes: Scope) -> TestClient:
        """The same application, asked with a key of this owner's."""
        client = TestClient(self.api.app, raise_server_exceptions=False)
        client.headers["Authorization"] = f"Bearer {self.key(owner, *scopes)}"
        return client


@contextmanager
def keyed(settings: Settings, **changes: object) -> Iterator[Keyed]:
    """The application for these settings, in which every request needs a key."""
    asks = settings.model_copy(update={"access": "keys", **changes})
    with TestClient(create_app(asks), raise_server_exceptions=False) as api:
        yield Keyed(api, api.app.state.heliopsf.catalogue)  # type: ignore[attr-defined]


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}
