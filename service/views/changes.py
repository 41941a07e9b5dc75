"""What every record of a past change says."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class PastChange(BaseModel):
    """A change that was recorded: when (s since 1970), by whom, and why. It is made from its row in the catalogue."""

    model_config = ConfigDict(from_attributes=True)

    at: float
    by: str
    reason: str
