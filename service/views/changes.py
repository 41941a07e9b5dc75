"""What every record of a past change says."""

from __future__ import annotations

from pydantic import BaseModel


class PastChange(BaseModel):
    """A change that was recorded: when (s since 1970), by whom, and why."""

    at: float
    by: str
    reason: str
