"""Connections to PostgreSQL that end instead of waiting for ever for a server, or for a network, that sends nothing.

The server ends a statement after STATEMENT_S. If even its error does not arrive, the connection is lost: the client
closes it after ``silence_s``. The settings of TCP find a lost host; they do not find a proxy that answers for it.
"""

from __future__ import annotations

import math
import time
from typing import Any, TypeVar

from psycopg import Connection, OperationalError
from psycopg.abc import PQGen
from sqlalchemy import Connection as SqlConnection
from sqlalchemy import Engine, create_engine, event
from sqlalchemy.engine import make_url

POOL_S = 10.0  # longest time that a thread waits until another one returns its connection
PING_S = 5.0  # longest silence outside transactions: before each of them, the pool asks whether the connection works
STATEMENT_S = 30.0  # longest time of a statement, also if it waits for a lock
SILENCE_S = STATEMENT_S + 5.0  # longest silence in a transaction
# As libpq names them: a host that sends nothing for 25 s, or that acknowledges nothing for 20 s (ms here), is lost.
TCP = {
    "connect_timeout": 5,
    "keepalives": 1,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 20_000,
}
Value = TypeVar("Value")


class PatientConnection(Connection[Any]):
    """A connection that closes itself, and raises OperationalError, if the server sends nothing for ``silence_s``."""

    silence_s = PING_S

    def wait(self, gen: PQGen[Value], *args: Any, **options: Any) -> Value:
        """Wait for an operation as psycopg does, while the server sends something."""
        return super().wait(self._heard(gen), *args, **options)

    def _heard(self, operation: PQGen[Value]) -> PQGen[Value]:
        heard_at = time.monotonic()
        try:
            awaited = next(operation)
            while True:
                ready = yield awaited  # psycopg sends a zero after each 0.1 s without news
                if ready:
                    heard_at = time.monotonic()
                elif time.monotonic() - heard_at > self.silence_s:
                    self.close()
                    raise OperationalError(f"timeout: PostgreSQL sent nothing for {self.silence_s:g} s")
                awaited = operation.send(ready)
        except StopIteration as end:
            value: Value = end.value
            return value


def open_postgres(url: str, **options: Any) -> Engine:
    """Make an engine for PostgreSQL. What the query of the URL sets, such as ``connect_timeout``, goes before TCP.

    The execution option ``unhurried`` lifts the limits of a transaction, for upgrades of the tables.
    """
    unset = {name: value for name, value in TCP.items() if name not in make_url(url).query}
    engine = create_engine(url, pool_pre_ping=True, pool_timeout=POOL_S, connect_args=unset, **options)

    @event.listens_for(engine, "do_connect")
    def _connect(
        _dialect: object, _record: object, arguments: list[str], named: dict[str, Any]
    ) -> PatientConnection:
        return PatientConnection.connect(*arguments, **named)

    @event.listens_for(engine, "connect")
    def _limit(connection: PatientConnection, _record: object) -> None:
        # Not among the options of the connection, which poolers such as PgBouncer refuse.
        connection.autocommit = True
        connection.execute(f"SET statement_timeout = '{STATEMENT_S:g}s'")
        connection.autocommit = False

    @event.listens_for(engine, "begin")
    def _begin(connection: SqlConnection) -> None:
        unhurried = connection.get_execution_options().get("unhurried", False)
        patient = connection.connection.dbapi_connection
        assert isinstance(patient, PatientConnection)
        patient.silence_s = math.inf if unhurried else SILENCE_S
        if unhurried:
            connection.exec_driver_sql("SET LOCAL statement_timeout = 0")

    @event.listens_for(engine, "reset")
    def _reset(connection: PatientConnection, _record: object, _state: object) -> None:
        connection.silence_s = PING_S

    return engine
