"""A database that cannot do its work now: by which error it is known, and for how long anybody waits for it."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator

import psycopg
import pytest
from sqlalchemy import make_url, text
from sqlalchemy.exc import DBAPIError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from tests.frozen_proxy import Proxy, proxy_of
from tests.workers.databases import BOTH, database, reading_only
from workers import checks
from workers.catalogue import postgres
from workers.catalogue.access import Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.database import is_away

PING_S, SILENCE_S = 1.0, 1.5


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Connections that wait for a short time."""
    monkeypatch.setattr(postgres.PatientConnection, "silence_s", PING_S)
    monkeypatch.setattr(postgres, "PING_S", PING_S)
    monkeypatch.setattr(postgres, "SILENCE_S", SILENCE_S)


@pytest.fixture
def proxied(quick: None, postgres_tables: str) -> Iterator[tuple[Catalogue, Proxy]]:
    """A catalogue whose connections go through a proxy."""
    url = make_url(postgres_tables)
    with proxy_of(url.host or "127.0.0.1", url.port or 5432) as proxy:
        here = url.set(host="127.0.0.1", port=proxy.port).render_as_string(hide_password=False)
        catalogue = Catalogue(here)
        yield catalogue, proxy
        catalogue.close()


def error_of(sqlstate: str) -> SQLAlchemyError:
    """The error that SQLAlchemy raises for a sqlstate of PostgreSQL."""
    original = psycopg.errors.lookup(sqlstate)("it said so")
    return DBAPIError.instance("UPDATE", {}, original, psycopg.Error)  # type: ignore[return-value]


def test_the_sqlstate_says_whether_the_database_is_away() -> None:
    away = {
        "25006": "a change where only reading is possible",
        "08006": "the connection failed",
        "40001": "serialization", "40P01": "deadlock",
        "53200": "out of memory", "53300": "too many connections",
        "57014": "statement_timeout", "57P01": "shutdown", "57P03": "starting up",
        "58030": "an error of the disk",
    }  # fmt: skip
    ours = {
        "23505": "unique violation", "42P01": "no such table", "42601": "syntax", "22003": "out of range",
        "42501": "no privilege", "25P02": "a failed transaction",
    }  # fmt: skip
    assert {state for state in away | ours if is_away(error_of(state))} == away.keys()


def test_an_error_without_a_sqlstate_is_of_a_server_that_did_not_answer_or_of_sqlite() -> None:
    for original in (psycopg.OperationalError("refused"), sqlite3.OperationalError("database is locked")):
        assert is_away(OperationalError("SELECT", {}, original))
    assert is_away(PoolTimeoutError("all connections are in use"))
    assert not is_away(ValueError("a fault of the software"))


def test_open_connections_that_fall_silent_are_replaced(proxied: tuple[Catalogue, Proxy]) -> None:
    catalogue, proxy = proxied
    with database(catalogue).reading(), database(catalogue).reading():
        catalogue.clock()
    proxy.freeze()
    started = time.monotonic()
    for _ in range(3):
        catalogue.clock()
        catalogue.check_writable()
    assert PING_S <= time.monotonic() - started < 3 * PING_S, "one is waited for, and all are replaced"


def test_a_statement_that_gets_no_answer_ends(proxied: tuple[Catalogue, Proxy]) -> None:
    catalogue, proxy = proxied
    with database(catalogue).writing() as session:
        session.execute(text("SELECT 1"))
        proxy.freeze()
        started = time.monotonic()
        with pytest.raises(OperationalError, match="timeout") as error:
            session.execute(text("SELECT 1"))
        assert SILENCE_S <= time.monotonic() - started < 2 * SILENCE_S
        assert is_away(error.value) and checks.database_said(error.value) == "no answer within the time limit"
    catalogue.clock()


def test_an_upgrade_has_no_limit_and_the_next_transaction_has_it_again(
    proxied: tuple[Catalogue, Proxy],
) -> None:
    catalogue, _ = proxied
    engine = database(catalogue).engine
    limits = []
    for unhurried in (False, True, False):
        with engine.execution_options(unhurried=unhurried).begin() as connection:
            limits.append(connection.execute(text("SHOW statement_timeout")).scalar_one())
            if unhurried:
                connection.execute(text("SELECT pg_sleep(:s)"), {"s": SILENCE_S + 0.3})
    assert limits == ["30s", "0", "30s"]


def test_what_the_url_sets_goes_before_our_settings(postgres_tables: str) -> None:
    engine = postgres.open_postgres(f"{postgres_tables}?keepalives_idle=77")
    with engine.connect() as connection:
        used = connection.connection.dbapi_connection.info.get_parameters()  # type: ignore[union-attr]
    engine.dispose()
    assert (used["keepalives_idle"], used["keepalives_count"], used["tcp_user_timeout"]) == (
        "77",
        "3",
        "20000",
    )


@pytest.mark.parametrize("catalogue", ["postgresql"], indirect=True)
def test_a_database_that_only_reads_is_told_and_still_reads(catalogue: Catalogue) -> None:
    key = catalogue.keys.make("ann", {Scope.READ})
    checks.database(catalogue)
    with reading_only(catalogue):
        checks.answers(catalogue)
        with pytest.raises(checks.Unusable, match=r"accepts no changes \(ReadOnlySqlTransaction\)"):
            checks.database(catalogue)
        with pytest.raises(SQLAlchemyError) as error:
            catalogue.jobs.submit("psf-build", {}, "k", "ann")
        assert is_away(error.value) and "only reads" in checks.database_said(error.value)
        assert catalogue.keys.check(key).owner == "ann", "the time of its use cannot be recorded now"
    checks.database(catalogue)


@BOTH
def test_the_check_of_changes_changes_nothing(catalogue: Catalogue) -> None:
    catalogue.census.announce("w", 1.0, "0.1")
    catalogue.check_writable()
    assert [row.version for row in catalogue.census.workers(3600.0)] == ["0.1"]
