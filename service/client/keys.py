"""The client's requests about keys."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any


class KeysClient(ABC):
    """The requests about keys, for a service that requires keys.

    Every method raises ``service.client.errors.ServiceError``; its ``code`` is the reason ("keys-not-used", "scope-missing", ...).
    """

    @abstractmethod
    def _json(self, method: str, address: str, **options: Any) -> dict[str, Any]:
        """The answer to a request."""

    @abstractmethod
    def _all(self, address: str, filters: dict[str, str]) -> Iterator[dict[str, Any]]:
        """All items of a list."""

    def make_key(
        self,
        scopes: Sequence[str],
        *,
        label: str = "",
        lasts_days: float | None = None,
        owner: str | None = None,
    ) -> dict[str, Any]:
        """Make a key; returns its description. Only this answer contains the whole key, under "key".

        scopes: "read", "submit", "certify", "bulk", "admin"; not more than your own key allows. lasts_days: lifetime, days;
        default: as long as your own key. owner: another owner than your own needs the scope admin.
        """
        body = {"scopes": list(scopes), "label": label, "lasts_days": lasts_days, "owner": owner}
        return self._json("POST", "/v1/keys", json=body)

    def keys(self, owner: str | None = None) -> Iterator[dict[str, Any]]:
        """Your keys without their secrets, newest first. owner: another owner, or "*" for all; needs the scope admin."""
        return self._all("/v1/keys", {} if owner is None else {"owner": owner})

    def revoke_key(self, key_id: str, *, and_made: bool = False) -> dict[str, Any]:
        """Revoke a key; returns its description. and_made: also revoke all keys that were made with it."""
        query = {"and_made": "true" if and_made else "false"}
        return self._json("DELETE", f"/v1/keys/{key_id}", params=query)
