"""What a client says when a request was refused."""

from __future__ import annotations


class ServiceError(Exception):
    """The service refused a request, a job failed, or no service is there; the message says why."""

    def __init__(
        self,
        message: str,
        *,
        status: int | None = None,
        code: str | None = None,
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(message)
        self.status, self.code, self.retry_after_s = status, code, retry_after_s
