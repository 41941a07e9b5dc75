"""API keys of owners. A key is shown once, when it is made; the database stores only the hash of its secret.

A key has the form ``hpsf_ID_SECRET``. The id is public: lists and logs show it. The secret consists of 256 random bits.
A password can be guessed; these bits cannot. Therefore one round of SHA-256 is enough to protect the secret.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
from collections.abc import Collection, Sequence
from enum import StrEnum

from sqlalchemy import Select, func, or_, select, update

from workers.catalogue.database import Database
from workers.catalogue.tables import KeyRow

OWNER = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
LABEL_LENGTH = 80
_KEY = re.compile(r"hpsf_([0-9a-f]{16})_([A-Za-z0-9_-]{43})", re.ASCII)
_USE_NOTED_EVERY_S = 60.0  # the time of use is written at most once a minute, not for every request
_NOBODY = hashlib.sha256(b"nobody").hexdigest()


class Scope(StrEnum):
    """What a key allows. No scope includes another."""

    READ = "read"
    SUBMIT = "submit"
    CERTIFY = "certify"
    BULK = "bulk"
    ADMIN = "admin"


class KeyRefused(Exception):
    """A key is not valid. ``code`` and the message give the reason; they never contain the key."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code, self.message = code, message


class Keys:
    """The table of keys; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def make(
        self, owner: str, scopes: Collection[Scope], *, label: str = "", expires_at: float | None = None
    ) -> str:
        """Make a key and return it; it cannot be shown again. Raises ValueError for a bad owner or without scopes."""
        if not OWNER.fullmatch(owner):
            raise ValueError(
                f"expected an owner of lower-case letters, digits, '.', '_' and '-'; got {owner!r}"
            )
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
        )
        with self._database.writing.begin() as session:
            session.add(row)
        return f"hpsf_{identity}_{secret}"

    def check(self, key: str) -> KeyRow:
        """Return the row of a valid key, and record the time of its use. Raises ``KeyRefused``."""
        parts = _KEY.fullmatch(key)
        if parts is None:
            raise KeyRefused(
                "bad-key", "expected a key of the form hpsf_ID_SECRET; got something else: copy the whole key"
            )
        with self._database.reading() as session:
            row = session.get(KeyRow, parts[1])
        same = hmac.compare_digest(_hash(parts[2]), _NOBODY if row is None else row.secret_sha256)
        if row is None or not same:
            raise KeyRefused(
                "bad-key",
                "expected a key of this service; this key is not known to the service: ask the operator for a key",
            )
        now = time.time()
        # Only a caller who knows the secret is told these reasons.
        if row.revoked_at is not None:
            raise KeyRefused("key-revoked", f"key {row.id} was revoked: ask the operator for a new one")
        if row.expires_at is not None and row.expires_at <= now:
            raise KeyRefused("key-expired", f"key {row.id} has expired: ask the operator for a new one")
        if row.last_used_at is None or row.last_used_at < now - _USE_NOTED_EVERY_S:
            self._note_use(row.id, now)
        return row

    def all(self) -> Sequence[KeyRow]:
        """All keys, including revoked and expired ones, oldest first."""
        with self._database.reading() as session:
            return session.scalars(select(KeyRow).order_by(KeyRow.created_at, KeyRow.id)).all()

    def revoke(self, identity: str) -> bool:
        """Revoke a key. The next request with it is refused. Returns False if there is no key with this id."""
        revoked = update(KeyRow).where(KeyRow.id == identity)
        return bool(
            self._database.change(revoked.values(revoked_at=func.coalesce(KeyRow.revoked_at, time.time())))
        )

    def any_good(self) -> bool:
        """Whether any key is valid now."""
        with self._database.reading() as session:
            return session.scalars(_good().limit(1)).first() is not None

    def is_good(self, identity: str) -> bool:
        """Whether the key with this id is valid now: neither revoked nor expired."""
        with self._database.reading() as session:
            return session.scalars(_good().where(KeyRow.id == identity)).first() is not None

    def _note_use(self, identity: str, now: float) -> None:
        unnoted = or_(KeyRow.last_used_at.is_(None), KeyRow.last_used_at < now - _USE_NOTED_EVERY_S)
        self._database.change(update(KeyRow).where(KeyRow.id == identity, unnoted).values(last_used_at=now))


def _good() -> Select[str]:
    """The ids of all keys that are valid now."""
    return select(KeyRow.id).where(
        KeyRow.revoked_at.is_(None), or_(KeyRow.expires_at.is_(None), KeyRow.expires_at > time.time())
    )


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
