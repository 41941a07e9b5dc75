"""Who may use the service: API keys of owners, and sessions of browsers.

A key has the form ``hpsf_ID_SECRET``. It is shown once, when it is made. The id is public: lists and logs show it. A
session begins when a person logs in with a key, and allows what the key allows; the browser keeps the token of its
session in a cookie. The session ends at its own time, when its key expires or is revoked, or when the person logs out.

Secrets of keys and tokens of sessions consist of 256 random bits, and the database stores only their hashes. A password
can be guessed; these bits cannot. Therefore one round of SHA-256 is enough to protect them.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import re
import secrets
import time
from collections.abc import Collection, Sequence
from enum import StrEnum

from sqlalchemy import ColumnElement, Select, String, delete, func, or_, select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Mapped, Session, mapped_column

from workers.catalogue.database import Database, Queries, is_away, newest_first
from workers.catalogue.quotas import lock_owner
from workers.catalogue.tables import Base, KeyRow

log = logging.getLogger(__name__)
OWNER = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
OWNER_RULE = (
    "1 to 64 characters: lower-case letters, digits, '.', '_' and '-'; the first character is a letter or a "
    "digit"
)
LABEL_LENGTH = 80
_KEY = re.compile(r"hpsf_([0-9a-f]{16})_([A-Za-z0-9_-]{43})", re.ASCII)
MOST_SESSIONS_OF_A_KEY = 50  # a further login closes the oldest
_USE_NOTED_EVERY_S = 60.0  # the time of use is written at most once a minute, not for every request
_NOBODY = hashlib.sha256(b"nobody").hexdigest()


class Scope(StrEnum):
    """What a key allows. No scope includes another."""

    READ = "read"
    SUBMIT = "submit"
    CERTIFY = "certify"
    BULK = "bulk"
    ADMIN = "admin"


MEANINGS = {
    Scope.READ: "read and download the owner's data",
    Scope.SUBMIT: "upload files, submit jobs, cancel them, make and revoke keys",
    Scope.CERTIFY: "certify and deprecate PSFs, and change contexts",
    Scope.BULK: "start bulk runs",
    Scope.ADMIN: "read the metrics, act for any owner (header X-Owner), and manage the keys of all owners",
}


class KeyRefused(Exception):
    """A key is not valid. ``code`` and the message give the reason; they never contain the key."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code, self.message = code, message


class TooManyKeys(Exception):
    """An owner already has the largest allowed number of valid keys."""


class Keys(Queries):
    """The table of keys."""

    def make(
        self,
        owner: str,
        scopes: Collection[Scope],
        *,
        label: str = "",
        expires_at: float | None = None,
        made_by: str | None = None,
        most: int | None = None,
    ) -> str:
        """Make a key and return it; it cannot be shown again.

        If ``most`` is given, only the newest ``most`` of the owner's revoked and expired keys are kept; the older ones
        are deleted.

        Parameters
        ----------
        made_by
            The id of the key with which the new key is made.
        most
            The largest number of valid keys of the owner; None: no limit.

        Raises
        ------
        ValueError
            The owner has a bad name, or there are no scopes.
        TooManyKeys
            The owner already has ``most`` valid keys. No key is then deleted.
        """
        if not OWNER.fullmatch(owner):
            raise ValueError(f"expected an owner of {OWNER_RULE}; got {owner!r}")
        if not scopes:
            raise ValueError(
                "expected at least one scope; got none, and a key without a scope allows nothing"
            )
        identity, secret = secrets.token_hex(8), secrets.token_urlsafe(32)
        row = KeyRow(
            id=identity,
            owner=owner,
            secret_sha256=_hash(secret),
            scopes=sorted(scopes),
            label=label[:LABEL_LENGTH],
            created_at=time.time(),
            expires_at=expires_at,
            made_by=made_by,
        )
        with self._database.writing.begin() as session:
            if most is not None:
                _make_room(session, owner, most)
            session.add(row)
        return f"hpsf_{identity}_{secret}"

    def check(self, key: str) -> KeyRow:
        """Return the row of a valid key, and record the time of its use. Raises ``KeyRefused``."""
        parts = _KEY.fullmatch(key)
        if parts is None:
            raise KeyRefused(
                "bad-key", "expected a key of the form hpsf_ID_SECRET; got something else: copy the whole key"
            )
        row = self.get(parts[1])
        same = hmac.compare_digest(_hash(parts[2]), _NOBODY if row is None else row.secret_sha256)
        if row is None or not same:
            raise KeyRefused(
                "bad-key",
                "expected a key of this service; this key is not known to the service: ask the operator for a key",
            )
        self.check_valid(row)  # only a caller who knows the secret is told the reasons
        return row

    def check_valid(self, row: KeyRow) -> None:
        """Check that a key is neither revoked nor expired, and record the time of its use. Raises ``KeyRefused``."""
        now = time.time()
        if row.revoked_at is not None:
            raise KeyRefused("key-revoked", f"key {row.id} was revoked: ask the operator for a new one")
        if row.expires_at is not None and row.expires_at <= now:
            raise KeyRefused("key-expired", f"key {row.id} has expired: ask the operator for a new one")
        if row.last_used_at is None or row.last_used_at < now - _USE_NOTED_EVERY_S:
            unnoted = or_(KeyRow.last_used_at.is_(None), KeyRow.last_used_at < now - _USE_NOTED_EVERY_S)
            use = update(KeyRow).where(KeyRow.id == row.id, unnoted)
            try:
                self._database.change(use.values(last_used_at=now))
            except SQLAlchemyError as error:
                if not is_away(error):
                    raise
                # A database that only reads can still answer this request.
                log.warning("could not record the use of key %s: %s", row.id, str(error).split("\n")[0])

    def get(self, identity: str) -> KeyRow | None:
        """The row of a key, valid or not; None if there is no key with this id."""
        return self._database.row(KeyRow, identity)

    def page(
        self, owner: str | None, *, limit: int, after: tuple[float, str] | None = None
    ) -> Sequence[KeyRow]:
        """One page of a list of keys, newest first.

        Parameters
        ----------
        owner
            The owner of the keys; None: the keys of all owners.
        after
            (created_at, id) of the last key of the page before; None for the first page.
        """
        query = select(KeyRow)
        if owner is not None:
            query = query.where(KeyRow.owner == owner)
        return self._database.all(newest_first(query, (KeyRow.created_at, KeyRow.id), limit, after))

    def all(self) -> Sequence[KeyRow]:
        """All keys, including revoked and expired ones, oldest first."""
        return self._database.all(select(KeyRow).order_by(KeyRow.created_at, KeyRow.id))

    def revoke(self, identity: str, *, and_made: bool = False) -> bool:
        """Revoke a key. The next request with it is refused. Returns False if there is no key with this id.

        Parameters
        ----------
        and_made
            Whether to revoke also all keys that were made with this key, directly or with one of the keys made with it.
        """
        revoked_at = func.coalesce(KeyRow.revoked_at, time.time())
        with self._database.writing.begin() as session:
            newest = session.scalars(select(KeyRow.id).where(KeyRow.id == identity)).all()
            ids = set(newest)
            while and_made and newest:
                made = select(KeyRow.id).where(KeyRow.made_by.in_(newest), KeyRow.id.not_in(ids))
                newest = session.scalars(made).all()
                ids.update(newest)
            session.execute(update(KeyRow).where(KeyRow.id.in_(ids)).values(revoked_at=revoked_at))
        return bool(ids)

    def any_good(self) -> bool:
        """Whether any key is valid now."""
        return self._database.any(_good_keys())

    def is_good(self, identity: str) -> bool:
        """Whether the key with this id is valid now: neither revoked nor expired."""
        return self._database.any(_good_keys().where(KeyRow.id == identity))


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
        of_key = SessionRow.key_id == key.id
        newest = select(SessionRow.id).where(of_key).order_by(SessionRow.created_at.desc(), SessionRow.id)
        kept = newest.limit(MOST_SESSIONS_OF_A_KEY - 1)
        with self._database.writing.begin() as session:
            session.execute(delete(SessionRow).where(of_key, SessionRow.id.not_in(kept)))
            session.add(row)
        return token

    def find(self, token: str) -> tuple[SessionRow, KeyRow]:
        """The session of a token, and its key. Records the use of the key.

        Raises ``KeyRefused`` with the code "session-ended", or with the reason for which the key is not valid.
        """
        with self._database.reading() as session:
            row = session.get(SessionRow, _hash(token))
            key = None if row is None else session.get(KeyRow, row.key_id)
        if key is not None:  # the reason why a key is not valid says more than "session-ended"
            self._keys.check_valid(key)
        if row is None or key is None or row.expires_at <= time.time():
            raise KeyRefused("session-ended", "expected an open session; yours has ended: log in again")
        return row, key

    def is_open(self, identity: str) -> bool:
        """Whether the session with this id and its key are valid now."""
        return self._database.any(select(SessionRow.id).where(SessionRow.id == identity, ~_ended()))

    def close(self, token: str) -> bool:
        """End the session of a token. Returns False if there is none."""
        return self._database.change(delete(SessionRow).where(SessionRow.id == _hash(token))) > 0

    def sweep(self) -> int:
        """Delete the sessions that have expired, and those whose key is not valid any more; returns their number."""
        return self._database.change(delete(SessionRow).where(_ended()))


def _make_room(session: Session, owner: str, most: int) -> None:
    """Raise ``TooManyKeys`` if an owner already has ``most`` valid keys.

    Otherwise keep only the newest ``most`` of the owner's revoked and expired keys, and delete the older ones. The keys
    that a deleted key made then count as made by the key that had made it, so that ``revoke`` still reaches them.
    """
    lock_owner(session, owner)  # simultaneous requests are counted one after the other
    good = _good_keys().where(KeyRow.owner == owner)
    if len(session.scalars(good.limit(most)).all()) >= most:
        raise TooManyKeys
    ended = select(KeyRow.id).where(KeyRow.owner == owner, KeyRow.id.not_in(good))
    surplus = session.scalars(ended.order_by(KeyRow.created_at.desc()).offset(most)).all()
    for identity in surplus:
        maker = session.scalar(select(KeyRow.made_by).where(KeyRow.id == identity))
        session.execute(update(KeyRow).where(KeyRow.made_by == identity).values(made_by=maker))
    session.execute(delete(KeyRow).where(KeyRow.id.in_(surplus)))


def _good_keys() -> Select[str]:
    """The ids of all keys that are valid now."""
    return select(KeyRow.id).where(
        KeyRow.revoked_at.is_(None), or_(KeyRow.expires_at.is_(None), KeyRow.expires_at > time.time())
    )


def _ended() -> ColumnElement[bool]:
    return or_(SessionRow.expires_at <= time.time(), SessionRow.key_id.not_in(_good_keys()))


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
