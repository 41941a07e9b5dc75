"""How much one caller may ask for in a minute: reads, submissions, bytes sent in.

Counted where all servers see it (in Redis) if the broker is one, in this process else. Each caller has an allowance
of its own, so that one script gone wild does not keep the others waiting.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass
from enum import StrEnum

from limits import RateLimitItem, RateLimitItemPerMinute
from limits.errors import StorageError
from limits.storage import MemoryStorage, storage_from_string
from limits.strategies import SlidingWindowCounterRateLimiter

from service.http.problems import Problem
from workers.settings import Settings

log = logging.getLogger(__name__)
WINDOW_S = 60
MIB = 2**20
_REDIS = ("redis://", "rediss://")
_PATIENCE_S = 1.0
_AWAY_S = 10.0  # so long nobody asks a Redis that did not answer


class Bucket(StrEnum):
    """What is counted."""

    READS = "reads"
    SUBMISSIONS = "submissions"
    UPLOADS = "upload-mib"


@dataclass(frozen=True)
class Allowance:
    """What a caller may ask for in a minute, and what is left of it now."""

    bucket: Bucket
    limit: int
    left: int
    reset_s: int

    @property
    def headers(self) -> dict[str, str]:
        """As answers tell it, in the words of the IETF's draft on rate limit headers."""
        return {
            "RateLimit-Policy": f'"{self.bucket}";q={self.limit};w={WINDOW_S}',
            "RateLimit": f'"{self.bucket}";r={self.left};t={self.reset_s}',
        }


class Rates:
    """Allowances of all callers, by the settings; a limit of 0 is none."""

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
        """Count against a caller's allowance; ``Problem`` 429 where it is used up. None: there is no limit.

        What costs more than a minute's whole allowance needs all of it, so that it can be had at all.
        """
        item = self._items.get(bucket)
        if item is None or time.monotonic() < self._away_until:
            return None
        try:
            limiter = self._limit_by()
            granted = limiter.hit(item, bucket, who, cost=min(cost, item.amount))
            reset_at, left = limiter.get_window_stats(item, bucket, who)
        except StorageError as error:
            # Let in, not shut out: limits keep the service quick, they do not keep anybody from anything (keys
            # do that), and the loss of what counts should not be the loss of the service.
            self._away_until = time.monotonic() + _AWAY_S
            log.warning("rates are not counted for %g s, Redis does not answer: %s", _AWAY_S, error)
            return None
        allowance = Allowance(bucket, item.amount, left, max(1, math.ceil(reset_at - time.time())))
        if not granted:
            raise _too_many(allowance)
        return allowance

    def take_bytes(self, who: str, count: int) -> Allowance | None:
        """As ``take``, for bytes sent in."""
        return self.take(Bucket.UPLOADS, who, math.ceil(count / MIB))

    def _limit_by(self) -> SlidingWindowCounterRateLimiter:
        if self._limiter is None:
            if self._url is None:
                self._limiter = SlidingWindowCounterRateLimiter(MemoryStorage())
            else:
                patience = {"socket_connect_timeout": _PATIENCE_S, "socket_timeout": _PATIENCE_S}
                storage = storage_from_string(self._url, wrap_exceptions=True, **patience)
                self._limiter = SlidingWindowCounterRateLimiter(storage)
        return self._limiter


def _too_many(allowance: Allowance) -> Problem:
    unit = {Bucket.READS: "requests", Bucket.SUBMISSIONS: "submissions", Bucket.UPLOADS: "MiB sent in"}
    return Problem(
        429,
        "too-many-requests",
        f"expected at most {allowance.limit} {unit[allowance.bucket]} a minute; got more: try again in "
        f"{allowance.reset_s} s",
        headers={"Retry-After": str(allowance.reset_s), **allowance.headers},
    )
