"""The errors that a client raises."""

from __future__ import annotations


class ServiceError(Exception):
    """A request was refused, a job failed, or no service answered. The message says why.

    status: HTTP status; None if there was no answer. code: the reason as a word, such as "no-such-psf".
    retry_after_s: time after which the service asks to try again, s.
    """

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


class WaitInterrupted(KeyboardInterrupt):
    """Control-C during a wait for a job or a bulk run, which goes on without the client.

    what: "job" or "bulk". identity: its id. server: address of the service.
    """

    def __init__(self, what: str, identity: str, server: str) -> None:
        super().__init__(f"the wait was interrupted; {what} {identity} goes on at {server}")
        self.what, self.identity, self.server = what, identity, server
