"""Keys that are made with other keys, and lists of keys."""

from __future__ import annotations

import pytest
from sqlalchemy import update

from tests.workers.databases import change
from workers.catalogue.access.keys import Scope, TooManyKeys
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
