"""Keys and sessions of browsers in the catalogue: lists of keys, what opens a session, and everything that ends one."""

from __future__ import annotations

import hashlib
import time

import pytest
from sqlalchemy import select, update

from tests.workers.databases import change, rows
from workers.catalogue.access import MOST_SESSIONS_OF_A_KEY, KeyRefused, Scope, SessionRow, TooManyKeys
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import KeyRow


def made(catalogue: Catalogue, owner: str = "ann", **more: object) -> str:
    """The id of a new key."""
    return catalogue.keys.make(owner, {Scope.READ}, **more).split("_")[1]  # type: ignore[arg-type]


def valid(catalogue: Catalogue) -> set[str]:
    return {row.id for row in catalogue.keys.all() if catalogue.keys.is_good(row.id)}


def test_revoking_a_key_can_revoke_all_that_was_made_with_it(catalogue: Catalogue) -> None:
    first = made(catalogue)
    second = made(catalogue, made_by=first)
    third = made(catalogue, "bob", made_by=second)
    other = made(catalogue, made_by=made(catalogue))
    everything = valid(catalogue)
    assert catalogue.keys.revoke(third) and valid(catalogue) == everything - {third}
    assert catalogue.keys.revoke(first) and valid(catalogue) == everything - {third, first}
    assert catalogue.keys.revoke(first, and_made=True)
    assert valid(catalogue) == everything - {first, second, third} and other in valid(catalogue)
    assert not catalogue.keys.revoke("0" * 16, and_made=True)


def test_a_list_of_keys_has_pages_of_one_owner_or_of_all(catalogue: Catalogue) -> None:
    anns, bobs = [made(catalogue) for _ in range(3)], made(catalogue, "bob")
    first = catalogue.keys.page("ann", limit=2)
    assert [row.id for row in first] == [anns[2], anns[1]]
    rest = catalogue.keys.page("ann", limit=2, after=(first[1].created_at, first[1].id))
    assert [row.id for row in rest] == [anns[0]]
    assert {row.id for row in catalogue.keys.page(None, limit=9)} == {*anns, bobs}


def test_an_owner_has_a_largest_number_of_valid_keys(catalogue: Catalogue) -> None:
    for _ in range(3):
        made(catalogue, most=3)
    with pytest.raises(TooManyKeys):
        made(catalogue, most=3)
    made(catalogue, "bob", most=3)
    made(catalogue)  # the operator is not held to it


def test_old_keys_that_ended_are_forgotten(catalogue: Catalogue) -> None:
    ids = [made(catalogue) for _ in range(5)]
    bobs = made(catalogue, "bob")
    change(catalogue, update(KeyRow).values(revoked_at=1.0))
    new = made(catalogue, most=2)
    assert {row.id for row in catalogue.keys.all()} == {*ids[3:], bobs, new}


def test_a_forgotten_key_does_not_hide_the_keys_that_it_made(catalogue: Catalogue) -> None:
    """Whoever revokes a stolen key also reaches what was made with keys that it made and that are forgotten."""
    stolen = made(catalogue)
    second = made(catalogue, made_by=stolen)
    third = made(catalogue, made_by=second)
    fourth = made(catalogue, "bob", made_by=third)
    for identity in (second, third):
        catalogue.keys.revoke(identity)
    for _ in range(2):
        catalogue.keys.revoke(made(catalogue, most=1 + len(valid(catalogue))))
    made(catalogue, most=2)
    assert not {second, third} & {row.id for row in catalogue.keys.all()}
    catalogue.keys.revoke(stolen, and_made=True)
    assert fourth not in valid(catalogue)


DAY_S = 86_400.0


def key_of(catalogue: Catalogue, owner: str = "ann", lasts_s: float | None = None) -> KeyRow:
    expires_at = None if lasts_s is None else time.time() + lasts_s
    return catalogue.keys.check(catalogue.keys.make(owner, {Scope.READ}, expires_at=expires_at))


def stored(catalogue: Catalogue) -> list[SessionRow]:
    return rows(catalogue, select(SessionRow).order_by(SessionRow.created_at))


def refusal(catalogue: Catalogue, token: str) -> str:
    with pytest.raises(KeyRefused) as refused:
        catalogue.sessions.find(token)
    assert len(token) < 9 or token not in refused.value.message
    return refused.value.code


def test_a_session_is_found_by_its_token_and_only_a_hash_is_stored(catalogue: Catalogue) -> None:
    ann, bob = key_of(catalogue), key_of(catalogue, "bob")
    tokens = [catalogue.sessions.open(key, DAY_S) for key in (ann, bob)]
    assert len(set(tokens)) == 2 and all(len(token) == 43 for token in tokens), "256 bits"
    for token, key in zip(tokens, (ann, bob), strict=True):
        found, its_key = catalogue.sessions.find(token)
        assert (its_key.id, its_key.owner) == (key.id, key.owner)
        assert found.id == hashlib.sha256(token.encode()).hexdigest()
        assert catalogue.sessions.is_open(found.id)
        assert token not in (found.id, found.form_token)
    assert len({row.form_token for row in stored(catalogue)}) == 2
    assert refusal(catalogue, tokens[0][:-1]) == refusal(catalogue, "0") == "session-ended"
    assert refusal(catalogue, stored(catalogue)[0].id) == "session-ended", "the stored hash is no token"


def test_a_session_never_lasts_longer_than_its_key_and_records_its_use(catalogue: Catalogue) -> None:
    for lasts_s, expected_s in ((60, 60), (9 * DAY_S, DAY_S), (None, DAY_S)):
        token = catalogue.sessions.open(key_of(catalogue, lasts_s=lasts_s), DAY_S)
        change(catalogue, update(KeyRow).values(last_used_at=1.0))
        session, key = catalogue.sessions.find(token)
        assert session.expires_at - time.time() == pytest.approx(expected_s, abs=10)
        (row,) = (one for one in catalogue.keys.all() if one.id == key.id)
        assert row.last_used_at == pytest.approx(time.time(), abs=10)


def test_a_session_ends_at_its_time_is_swept_and_can_be_closed(catalogue: Catalogue) -> None:
    token, other = (catalogue.sessions.open(key_of(catalogue), DAY_S) for _ in range(2))
    assert catalogue.sessions.close(token) and not catalogue.sessions.close(token)
    assert refusal(catalogue, token) == "session-ended"
    assert catalogue.sessions.find(other) and catalogue.sessions.sweep() == 0
    change(catalogue, update(SessionRow).values(expires_at=time.time() - 1))
    assert refusal(catalogue, other) == "session-ended"
    assert not catalogue.sessions.is_open(stored(catalogue)[0].id)
    assert catalogue.sessions.sweep() == 1 and stored(catalogue) == []


@pytest.mark.parametrize(("column", "code"), [("revoked_at", "key-revoked"), ("expires_at", "key-expired")])
def test_a_key_that_ends_takes_its_sessions_along(catalogue: Catalogue, column: str, code: str) -> None:
    token = catalogue.sessions.open(key_of(catalogue), DAY_S)
    change(catalogue, update(KeyRow).values(**{column: time.time() - 1}))
    other = catalogue.sessions.open(key_of(catalogue, "bob"), DAY_S)
    assert refusal(catalogue, token) == code
    assert not catalogue.sessions.is_open(stored(catalogue)[0].id)
    assert catalogue.sessions.sweep() == 1
    assert refusal(catalogue, token) == "session-ended"
    assert catalogue.sessions.find(other)[1].owner == "bob"


def test_the_oldest_sessions_of_a_key_give_way(catalogue: Catalogue) -> None:
    key, other = key_of(catalogue), key_of(catalogue)
    kept = catalogue.sessions.open(other, DAY_S)
    tokens = [catalogue.sessions.open(key, DAY_S) for _ in range(MOST_SESSIONS_OF_A_KEY + 2)]
    assert len(stored(catalogue)) == MOST_SESSIONS_OF_A_KEY + 1
    assert [refusal(catalogue, token) for token in tokens[:2]] == 2 * ["session-ended"]
    assert all(catalogue.sessions.find(token) for token in (*tokens[2:], kept))
