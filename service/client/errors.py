"""The errors that a client raises."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class ServiceError(Exception):
    """A request was refused, a job failed, or no service answered. The message says why.

    status: HTTP status; None if there was no answer. code: the reason as a word, such as "no-such-psf".
    retry_after_s: time after which the service asks to try again, s. fields: further fields of the problem document, such as
    ``psfs`` of "no-psf-for-instrument".
    """

    def __init__(
        self,
        message: str,
        *,
        status: int | None = None,
        code: str | None = None,
        retry_after_s: float | None = None,
        fields: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(message)
        self.status, self.code, self.retry_after_s = status, code, retry_after_s
        self.fields = dict(fields or {})


def error_lines(message: str, fields: Mapping[str, Any]) -> list[str]:
    """An error as lines to print: the message; then the PSFs that could fit the image and the next steps, if the
    error contains them."""
    lines = [message]
    if fields.get("instruments"):
        lines.append("Instruments whose PSF can be built:")
        lines += [
            f"  {one['name']:<12} {one['wavelength_angstrom']:g} angstrom, {one['plate_scale_arcsec']:g} arcsec/px{_same(one)}"
            for one in fields["instruments"]
        ]
    if "psfs" in fields:
        lines.append(
            "PSFs of the catalogue that could fit:"
            if fields["psfs"]
            else "No PSF of the catalogue could fit."
        )
        lines += [
            f"  {one['id']}  {one['name']} {one['version']} ({one['status']}){_same(one)}"
            for one in fields["psfs"]
        ]
    if fields.get("ways"):
        lines.append("What to do next:")
        lines += [f"  {number}. {one['text']}" for number, one in enumerate(fields["ways"], 1)]
    return lines


def _same(one: Mapping[str, Any]) -> str:
    same = ", ".join(str(what).replace("_", " ") for what in one["same"])
    return f"; same {same} as the image" if same else ""


class WaitInterrupted(KeyboardInterrupt):
    """Control-C was pressed during a wait for a job or a bulk run. The job or bulk run continues without the client.

    what: "job" or "bulk". identity: the id of the job or bulk run. server: address of the service. others: ids of
    further jobs that continue.
    """

    def __init__(self, what: str, identity: str, server: str, others: tuple[str, ...] = ()) -> None:
        named = (
            f"{what} {identity} goes on" if not others else f"{what}s {', '.join((identity, *others))} go on"
        )
        super().__init__(f"the wait was interrupted; {named} at {server}")
        self.what, self.identity, self.server, self.others = what, identity, server, others
