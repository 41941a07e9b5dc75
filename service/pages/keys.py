"""The web page on which users list, make and revoke keys. The page shows a new key only once."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import ValidationError

from service.api.keys import KeyId, MadeKey, NewKey, list_keys, make_key, revoke_key
from service.http.callers import Caller
from service.http.paging import Cursor, Listing
from service.http.problems import Problem
from service.http.state import Shared, State
from service.pages.login import PageReading, PageSubmitting
from service.pages.rendering import page
from workers.catalogue.access import LABEL_LENGTH, MEANINGS, OWNER_RULE, Scope

PER_PAGE = 50
LIFETIMES_DAYS = (7, 30, 90, 365)
router = APIRouter(prefix="/keys", include_in_schema=False)
OwnerQuery = Annotated[str, Query(max_length=64)]


@router.get("")
def key_list(
    request: Request, caller: PageReading, state: Shared, owner: OwnerQuery = "", cursor: Cursor = None
) -> Response:
    """The keys of the caller. An administrator may name another owner."""
    if not state.access.keys:
        return page(request, "keys.html", used=False)
    return _page(request, caller, state, owner, cursor)


@router.post("")
def make(
    request: Request,
    response: Response,
    caller: PageSubmitting,
    state: Shared,
    scopes: Annotated[list[str] | None, Form()] = None,
    label: Annotated[str, Form()] = "",
    lasts_days: Annotated[str, Form()] = "",
    owner: Annotated[str, Form()] = "",
) -> Response:
    """Make a key, and show it."""
    try:
        body = NewKey.model_validate(
            {
                "scopes": scopes or [],
                "label": label[:LABEL_LENGTH],
                "lasts_days": lasts_days or None,
                "owner": owner or None,
            }
        )
    except ValidationError as error:
        raise _wrong_form(error) from error
    made = make_key(body, response, caller, state)
    return _page(request, caller, state, made.owner, made=made)


@router.post("/{key_id}/revoke")
def revoke(
    key_id: KeyId,
    caller: PageSubmitting,
    state: Shared,
    and_made: Annotated[bool, Form()] = False,
) -> Response:
    """Revoke a key, and show the list."""
    row = revoke_key(key_id, caller, state, and_made)
    return RedirectResponse("/keys" if row.owner == caller.owner else f"/keys?owner={row.owner}", 303)


def _page(
    request: Request,
    caller: Caller,
    state: State,
    owner: str,
    cursor: str | None = None,
    made: MadeKey | None = None,
) -> Response:
    found = list_keys(Listing(request, PER_PAGE, cursor), caller, state, owner or None)
    admin = Scope.ADMIN in caller.scopes
    return page(
        request,
        "keys.html",
        status=200 if made is None else 201,
        used=True,
        keys=found.items,
        next=found.next,
        made=made,
        owner=owner or caller.owner,
        admin=admin,
        may_make=Scope.SUBMIT in caller.scopes,
        own_id=caller.name,
        scopes=[(scope, MEANINGS[scope]) for scope in Scope if admin or scope in caller.scopes],
        chosen=(Scope.READ, Scope.SUBMIT),
        lifetimes=LIFETIMES_DAYS,
        label_length=LABEL_LENGTH,
    )


def _wrong_form(error: ValidationError) -> Problem:
    """The problem that says which fields of the form are wrong, and what to do."""
    wrong = {str(found["loc"][0]) for found in error.errors() if found["loc"]}
    advice = {
        "scopes": "expected at least one scope of the list: go back and choose what the key allows",
        "lasts_days": "expected a lifetime of the list: go back and choose one",
        "owner": f"expected an owner of {OWNER_RULE}: go back and correct the name",
    }
    said = [text for name, text in advice.items() if name in wrong] or [str(error)]
    return Problem(422, "invalid-request", "; ".join(said))
