"""Sessions of browsers. A session begins when a person logs in with a key, and allows what the key allows.

A browser keeps the token of its session in a cookie. The token consists of 256 random bits, and the database stores only its
hash. A session ends at its own time, when its key expires or is revoked, or when the person logs out.
"""

from __future__ import annotations

import hashlib
import secrets
import time

from sqlalchemy import ColumnElement, String, and_, delete, or_, select
from sqlalchemy.engine import CursorResult
from sqlalchemy.orm import Mapped, Session, mapped_column

from workers.catalogue.access.keys import KeyRefused, Keys, good_keys
from workers.catalogue.database import Database
from workers.catalogue.tables import Base, KeyRow

MOST_OF_A_KEY = 50  # sessions of one key; a further login closes the oldest


class SessionRow(Base):
    """A session of a browser. The id is the SHA-256 of the token; forms of the session contain ``form_token``."""

    __tablename__ = "browser_sessions"
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    key_id: Mapped[str] = mapped_column(String(16), index=True)
    form_token: Mapped[str] = mapped_column(String(43))
    created_at: Mapped[float]
    expires_at: Mapped[float] = mapped_column(index=True)


class Sessions:
    """The table of sessions; each method is one transaction."""

    def __init__(self, database: Database, keys: Keys) -> None:
        self._database, self._keys = database, keys

    def open(self, key: KeyRow, lasts_s: float) -> str:
        """Begin a session of a valid key; returns the token.

        The session lasts ``lasts_s`` seconds, but not longer than the key.
        """
        token, now = secrets.token_urlsafe(32), time.time()
        until = now + lasts_s
        row = SessionRow(
            id=_hash(token),
            key_id=key.id,
            form_token=secrets.token_urlsafe(32),
            created_at=now,
            expires_at=until if key.expires_at is None else min(until, key.expires_at),
        )
        with self._database.writing.begin() as session:
            _close_oldest(session, key.id)
            session.add(row)
        return token

    def find(self, token: str) -> tuple[SessionRow, KeyRow]:
        """The session of a token, and its key. Records the use of the key.

        Raises ``KeyRefused`` with the code "session-ended", or with the reason for which the key is not valid.
        """
        with self._database.reading() as session:
            row = session.get(SessionRow, _hash(token))
            key = None if row is None else session.get(KeyRow, row.key_id)
        if row is None or key is None or row.expires_at <= time.time():
            # If the key is not valid either, check_valid raises the reason, which says more than "session-ended".
            if key is not None:
                self._keys.check_valid(key)
            raise KeyRefused("session-ended", "expected an open session; yours has ended: log in again")
        self._keys.check_valid(key)
        return row, key

    def is_open(self, identity: str) -> bool:
        """Whether the session with this id and its key are valid now."""
        with self._database.reading() as session:
            found = select(SessionRow.id).where(SessionRow.id == identity, ~_ended())
            return session.scalars(found).first() is not None

    def close(self, token: str) -> bool:
        """End the session of a token. Returns False if there is none."""
        return self._delete(SessionRow.id == _hash(token)) > 0

    def sweep(self) -> int:
        """Delete the sessions that have expired, and those whose key is not valid any more; returns their number."""
        return self._delete(_ended())

    def _delete(self, which: ColumnElement[bool]) -> int:
        with self._database.writing.begin() as session:
            result = session.execute(delete(SessionRow).where(which))
            assert isinstance(result, CursorResult)
            return result.rowcount


def _ended() -> ColumnElement[bool]:
    return or_(SessionRow.expires_at <= time.time(), SessionRow.key_id.not_in(good_keys()))


def _close_oldest(session: Session, key_id: str) -> None:
    """Delete the oldest sessions of a key, so that a new session can be added. MOST_OF_A_KEY - 1 sessions stay."""
    newest_first = (SessionRow.created_at.desc(), SessionRow.id)
    newest = (
        select(SessionRow.id)
        .where(SessionRow.key_id == key_id)
        .order_by(*newest_first)
        .limit(MOST_OF_A_KEY - 1)
    )
    session.execute(delete(SessionRow).where(and_(SessionRow.key_id == key_id, SessionRow.id.not_in(newest))))


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
