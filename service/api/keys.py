"""The keys of an owner: ``/v1/keys``.

A client can make further keys for its owner. A new key has only scopes of the key of the request, and does not last
longer than this key. So nobody can gain rights by making keys. With a key of scope ``admin``, a client can make keys
for any owner, with any scopes and any lifetime.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel, ConfigDict, Field, model_validator

from service.http.callers import Caller, KeyFirst, Reading, Submitting
from service.http.paging import Page, Paging
from service.http.problems import RESPONSES, Problem, problem
from service.http.state import Shared
from service.views import RowView
from workers.catalogue.access import LABEL_LENGTH, OWNER, Scope, TooManyKeys
from workers.catalogue.tables import KeyRow
from workers.lookup import no_such
from workers.texts import Line

MOST_KEYS = 100  # an owner with this number of valid keys cannot make more
DAY_S = 86_400.0
LATEST = 253_402_300_799  # the end of the year 9999, seconds since 1970
EVERYBODY = "*"

router = APIRouter(prefix="/v1/keys", tags=["keys"], responses=RESPONSES, route_class=KeyFirst)
KeyId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", description="the id of a key: the part after `hpsf_`")]
OwnerName = Annotated[str, Field(pattern=f"^{OWNER.pattern}$")]


class NewKey(BaseModel):
    """A key to make."""

    model_config = ConfigDict(extra="forbid")

    label: Line = Field(
        "",
        max_length=LABEL_LENGTH,
        description="a note for lists, such as the purpose of the key",
    )
    scopes: list[Scope] = Field(
        min_length=1,
        max_length=len(Scope),
        description="scopes of the new key; your own key must have them, or the scope admin",
    )
    expires_at: float | None = Field(
        None,
        ge=0,
        le=LATEST,
        description="time at which the key expires, seconds since 1970; default: when your own key expires",
    )
    lasts_days: float | None = Field(
        None, gt=0, le=36_500, description="lifetime of the key in days, instead of expires_at"
    )
    owner: OwnerName | None = Field(
        None,
        description="owner of the key; to name another owner than your own, your key needs the scope admin",
    )

    @model_validator(mode="after")
    def _one_end(self) -> NewKey:
        if self.expires_at is not None and self.lasts_days is not None:
            raise ValueError("expected expires_at or lasts_days; got both: leave one out")
        return self


class KeyView(RowView):
    """A key, without its secret."""

    id: str
    owner: str
    label: str
    scopes: list[Scope]
    state: Literal["valid", "expired", "revoked"]
    created_at: float
    expires_at: float | None = Field(description="null: the key is valid until it is revoked")
    revoked_at: float | None
    last_used_at: float | None = Field(description="time of the last use, to the minute; null: never used")
    made_by: str | None = Field(description="id of the key that made this key; null: the operator made it")

    @classmethod
    def of(cls, row: KeyRow) -> KeyView:
        """The description of a key, from its row in the catalogue. It does not contain the secret key."""
        return cls.of_columns(row, state=_state(row))


class MadeKey(KeyView):
    """A new key with its secret."""

    key: str = Field(description="the whole key; this is the only answer that contains it")


@router.get("", summary="List keys")
def list_keys(
    paging: Paging,
    caller: Reading,
    state: Shared,
    owner: Annotated[
        str | None,
        Query(
            pattern=rf"^(\*|{OWNER.pattern})$",
            description="owner of the keys; `*`: all owners. To list the keys of another owner, you need the scope "
            "admin",
        ),
    ] = None,
) -> Page[KeyView]:
    """Your keys, newest first, including expired and revoked keys."""
    _check_used(state)
    owner = owner or caller.owner
    _check_for(caller, owner)
    rows = state.catalogue.keys.page(None if owner == EVERYBODY else owner, **paging.query)
    return paging.page(rows, KeyView.of)


@router.post("", status_code=201, summary="Make a key")
def make_key(body: NewKey, response: Response, caller: Submitting, state: Shared) -> MadeKey:
    """Make a key. Only this answer contains the whole key. If your own key does not have the scope admin, the new key
    can have only scopes of your own key, and does not last longer than your own key.
    """
    _check_used(state)
    owner = body.owner or caller.owner
    _check_for(caller, owner)
    _check_scopes(caller, body.scopes, "make a key with fewer scopes, or ask the operator")
    expires_at = _end(state, caller, body)
    try:
        key = state.catalogue.keys.make(
            owner,
            set(body.scopes),
            label=body.label,
            expires_at=expires_at,
            made_by=caller.name,
            most=MOST_KEYS,
        )
    except TooManyKeys as error:
        raise Problem(
            409,
            "too-many-keys",
            f"expected at most {MOST_KEYS} valid keys of an owner; {owner} already has that number: revoke a key "
            "that is not used",
        ) from error
    row = state.catalogue.keys.get(key.split("_")[1])
    assert row is not None
    response.headers["Cache-Control"] = "no-store"
    response.headers["Location"] = f"/v1/keys/{row.id}"
    return MadeKey(key=key, **KeyView.of(row).model_dump())


@router.get("/{key_id}", summary="Show a key")
def get_key(key_id: KeyId, caller: Reading, state: Shared) -> KeyView:
    """A key without its secret."""
    return KeyView.of(_find(state, caller, key_id))


@router.delete("/{key_id}", summary="Revoke a key")
def revoke_key(
    key_id: KeyId,
    caller: Submitting,
    state: Shared,
    and_made: Annotated[
        bool,
        Query(
            description="also revoke all keys that were made with this key, for example because it was stolen"
        ),
    ] = False,
) -> KeyView:
    """Revoke a key. From now on, the service refuses requests with this key, and ends its logins in browsers and its
    event streams. Jobs that were submitted with the key continue. To revoke a key with scopes that your own key does
    not have, you need the scope admin.
    """
    row = _find(state, caller, key_id)
    _check_scopes(caller, map(Scope, row.scopes), "use a key with these scopes, or ask the operator")
    state.catalogue.keys.revoke(key_id, and_made=and_made)
    state.catalogue.sessions.sweep()
    return KeyView.of(_find(state, caller, key_id))


def _state(row: KeyRow) -> Literal["valid", "expired", "revoked"]:
    if row.revoked_at is not None:
        return "revoked"
    return "expired" if row.expires_at is not None and row.expires_at <= time.time() else "valid"


def _find(state: Shared, caller: Caller, key_id: str) -> KeyRow:
    """The row of a key. Raises ``Problem`` 404 if the caller has no such key and is no administrator."""
    _check_used(state)
    row = state.catalogue.keys.get(key_id)
    if row is None or (row.owner != caller.owner and Scope.ADMIN not in caller.scopes):
        raise problem(no_such("key", key_id))
    return row


def _check_used(state: Shared) -> None:
    if not state.access.keys:
        raise Problem(
            409,
            "keys-not-used",
            "expected a service that requires keys; this one is open to everybody and uses no keys: send requests "
            "without a key",
        )


def _check_for(caller: Caller, owner: str) -> None:
    if owner != caller.owner and Scope.ADMIN not in caller.scopes:
        raise Problem(
            403,
            "scope-missing",
            f"expected your own name as the owner, or a key with the scope '{Scope.ADMIN}'; got {owner[:64]!a}",
        )


def _check_scopes(caller: Caller, scopes: Iterable[Scope], advice: str) -> None:
    lacking = set(scopes) - caller.scopes
    if lacking and Scope.ADMIN not in caller.scopes:
        raise Problem(
            403,
            "scope-missing",
            f"expected scopes of your own key ({', '.join(sorted(caller.scopes))}); got also "
            f"{', '.join(sorted(lacking))}: {advice}",
        )


def _end(state: Shared, caller: Caller, body: NewKey) -> float | None:
    """The end of a new key. Raises ``Problem`` 422 if this end is in the past, and 403 if it is later than the end of
    the caller's key.
    """
    now = time.time()
    end = body.expires_at if body.lasts_days is None else now + body.lasts_days * DAY_S
    if end is not None and end <= now:
        raise Problem(
            422, "end-in-the-past", f"expected an end in the future; got {end:.0f}: choose a later one"
        )
    own = state.catalogue.keys.get(caller.name)
    latest = None if own is None or Scope.ADMIN in caller.scopes else own.expires_at
    if latest is None:
        return end
    if end is not None and end > latest:
        raise Problem(
            403,
            "outlives-its-maker",
            f"expected an end that is not later than that of your own key ({latest:.0f}); got {end:.0f}: choose an "
            "earlier end, or ask the operator for a key",
        )
    return latest if end is None else end
