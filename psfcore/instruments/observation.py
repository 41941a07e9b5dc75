"""What a header says of an observation, by which instruments and PSFs are compared with it."""

from __future__ import annotations

from typing_extensions import TypedDict


class Observation(TypedDict):
    """The values of a header that describe the observation, see `psfcore.fits.header.HeaderSummary`."""

    instrument: str | None
    telescop: str | None
    instrume: str | None
    detector: str | None
    wavelnth: float | None
    date_obs: str | None
    exposure_s: float | None
    unit: str | None
    cdelt1: float | None
    cdelt2: float | None
    gain_mode: str | None
