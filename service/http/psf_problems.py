"""What is wrong with a request about versions, contexts or lineage, as HTTP says it."""

from __future__ import annotations

from typing import Any

from psfcore.errors import DataError
from service.http.problems import Problem

STATUS_OF = {
    "no-such-psf": 404,
    "no-such-image": 404,
    "no-such-product": 404,
    "no-such-context": 404,
    "no-psf-fits": 404,
    "several-psfs-fit": 409,
    "no-instrument": 409,
    "no-date": 409,
    "wrong-transition": 409,
    "version-taken": 409,
    "no-line": 409,
    "line-known": 409,
    "ranges-overlap": 409,
    "not-to-supersede": 409,
    "no-such-successor": 409,
    "successor-named": 409,
    "changed-meanwhile": 409,
    "name-taken": 409,
    "nothing-to-pin": 409,
}


def problem(error: DataError, **more: Any) -> Problem:
    """The answer for what was refused; ``more`` goes into its document."""
    return Problem(STATUS_OF.get(error.code, 422), error.code, error.message, **more)
