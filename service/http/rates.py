"""Limits for each caller: reads, submissions and uploaded bytes per minute, and requests and streams that are open at
the same time. A caller is an owner with all keys of this owner, or an address if the service needs no key.

If the broker is Redis, all servers count together in Redis; otherwise each process counts alone. Each caller has
an allowance of its own, so that a runaway script does not delay the others.
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from weakref import WeakValueDictionary

from limits import RateLimitItem, RateLimitItemPerMinute
from limits.errors import StorageError
from limits.storage import MemoryStorage, storage_from_string
from limits.strategies import SlidingWindowCounterRateLimiter

from service.http.problems import Problem
from workers.settings import Settings

log = logging.getLogger(__name__)
WINDOW_S = 60
_REDIS = ("redis://", "rediss://")
_PATIENCE_S = 1.0
_AWAY_S = 10.0  # time after which a Redis that did not answer is asked again


class Bucket(StrEnum):
    """The quantities that are limited."""

    READS = "reads"
    SUBMISSIONS = "submissions"
    UPLOADS = "upload-mib"


UNITS = {Bucket.READS: "requests", Bucket.SUBMISSIONS: "submissions", Bucket.UPLOADS: "MiB of uploads"}


@dataclass(frozen=True)
class Allowance:
    """The amount that a caller may use in a minute, and the amount that is left."""

    bucket: Bucket
    limit: int
    left: int
    reset_s: int

    @property
    def headers(self) -> dict[str, str]:
        """The headers of an answer, as in the IETF draft on rate limit headers."""
        return {
            "RateLimit-Policy": f'"{self.bucket}";q={self.limit};w={WINDOW_S}',
            "RateLimit": f'"{self.bucket}";r={self.left};t={self.reset_s}',
        }


class Rates:
    """Allowances of all callers, from the settings; 0: unlimited."""

    def __init__(self, settings: Settings) -> None:
        per_minute = {
            Bucket.READS: settings.reads_per_minute,
            Bucket.SUBMISSIONS: settings.submissions_per_minute,
            Bucket.UPLOADS: settings.upload_mib_per_minute,
        }
        self._items: dict[Bucket, RateLimitItem] = {
            bucket: RateLimitItemPerMinute(amount, namespace="heliopsf")
            for bucket, amount in per_minute.items()
            if amount
        }
        self._url = settings.broker_url if settings.broker_url.startswith(_REDIS) else None
        self._limiter: SlidingWindowCounterRateLimiter | None = None
        self._away_until = 0.0

    def take(self, bucket: Bucket, who: str, cost: int = 1) -> Allowance | None:
        """Subtract a cost from a caller's allowance; returns None if there is no limit. Raises ``Problem`` 429 if the
        allowance is used up.

        A request that costs more than the allowance of a minute uses the whole allowance. Otherwise it would never be
        accepted.
        """
        item = self._items.get(bucket)
        if item is None or time.monotonic() < self._away_until:
            return None
        try:
            limiter = self._limit_by()
            granted = limiter.hit(item, bucket, who, cost=min(cost, item.amount))
            reset_at, left = limiter.get_window_stats(item, bucket, who)
        except StorageError as error:
            # Accept the request. The limits only keep the service fast, and keys protect it. Therefore the service must
            # work without limits.
            self._away_until = time.monotonic() + _AWAY_S
            log.warning("no rate limits for %g s because Redis does not answer: %s", _AWAY_S, error)
            return None
        allowance = Allowance(bucket, item.amount, left, max(1, math.ceil(reset_at - time.time())))
        if not granted:
            raise Problem(
                429,
                "too-many-requests",
                f"expected at most {allowance.limit} {UNITS[bucket]} per minute; got more: try again in "
                f"{allowance.reset_s} s",
                headers={"Retry-After": str(allowance.reset_s), **allowance.headers},
            )
        return allowance

    def _limit_by(self) -> SlidingWindowCounterRateLimiter:
        if self._limiter is None:
            patience = {"socket_connect_timeout": _PATIENCE_S, "socket_timeout": _PATIENCE_S}
            storage = (
                MemoryStorage()
                if self._url is None
                else storage_from_string(self._url, wrap_exceptions=True, **patience)
            )
            self._limiter = SlidingWindowCounterRateLimiter(storage)
        return self._limiter


class AtOnce:
    """Counts the requests or streams that each caller has open in this process, and limits their number."""

    def __init__(self, most: int, code: str, what: str) -> None:
        """Limit the requests or streams that each caller has open at the same time.

        Parameters
        ----------
        most
            The limit for each caller.
        code
            The code of the error if a caller exceeds the limit.
        what
            A plural for the message of this error, such as "requests".
        """
        self._most, self._code, self._what = most, code, what
        self._open: Counter[str] = Counter()
        self._lock = threading.Lock()

    def open(self, who: str) -> None:
        """Count a further request or stream of a caller. Raises ``Problem`` 429 if the caller already has ``most``
        open.
        """
        with self._lock:
            if self._open[who] >= self._most:
                raise Problem(
                    429,
                    self._code,
                    f"expected at most {self._most} {self._what} of one caller at the same time; got one more: wait "
                    "until one of them has ended",
                    headers={"Retry-After": "1"},
                )
            self._open[who] += 1

    def total(self) -> int:
        """The number that all callers together have open."""
        with self._lock:
            return self._open.total()

    def close(self, who: str) -> None:
        """Record that a request or stream of a caller has ended."""
        with self._lock:
            self._open[who] -= 1
            if not self._open[who]:
                del self._open[who]


class Turns:
    """Lets the requests of each caller do something one after the other. They wait in the event loop."""

    def __init__(self) -> None:
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    def of(self, who: str) -> asyncio.Lock:
        """The turn of a caller; there is none if nobody holds it or waits for it."""
        return self._turns.setdefault(who, asyncio.Lock())
