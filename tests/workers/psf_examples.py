"""Rows of PSFs and products for tests of the catalogue, without files."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from typing import Any

import pytest

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ProductRow, PsfRow
from workers.contract.psf_status import Pin, StatusChange
from workers.versions import PsfStatus, Validity, iso, series_of

OWNER = "local"
ALWAYS = Validity()


def identity(name: str) -> str:
    """An id that a test can name."""
    return hashlib.sha256(name.encode()).hexdigest()


def psf(
    name: str,
    *,
    instrument: str | None = "hri_euv",
    channel: str | None = "174",
    kind: str = "total",
    owner: str = OWNER,
    **values: Any,
) -> PsfRow:
    """A draft."""
    given = {
        "created_at": time.time(),
        "name": name,
        "version": f"0.1.0+{name}",
        "status": PsfStatus.DRAFT,
        "origin": "built",
        "file_sha256": identity(f"file of {name}"),
        "bytes": 1,
        "preview_sha256": None,
        "details": {},
        **values,
    }
    series = series_of(instrument, channel, kind)
    return PsfRow(
        owner=owner,
        id=identity(name),
        instrument=instrument,
        channel=channel,
        kind=kind,
        series=series,
        **given,
    )


def product(name: str, psf_name: str, *, owner: str = OWNER, **values: Any) -> ProductRow:
    """A product of an image of the same name."""
    given = {"created_at": time.time(), "details": {}, **values}
    return ProductRow(
        owner=owner,
        id=identity(f"product {name}"),
        kind="deconvolved-image",
        image_id=identity(f"image {name}"),
        psf_id=identity(psf_name),
        psf_version="0.1.0",
        file_sha256=identity(f"file {name}"),
        bytes=1,
        preview_sha256=identity("preview"),
        **given,
    )


def certify(
    catalogue: Catalogue, name: str, version: str, validity: Validity | None = None, **asked: Any
) -> PsfRow:
    """Certify the PSF of this name."""
    change = StatusChange(
        status=PsfStatus.CERTIFIED, reason="tested", version=version, **between(validity), **asked
    )
    return catalogue.psfs.change(identity(name), OWNER, change, "tester")


def deprecate(catalogue: Catalogue, name: str, successor: str | None = None) -> PsfRow:
    """Deprecate the PSF of this name."""
    named = None if successor is None else identity(successor)
    change = StatusChange(status=PsfStatus.DEPRECATED, reason="worse", successor=named)
    return catalogue.psfs.change(identity(name), OWNER, change, "tester")


def pin(name: str, validity: Validity | None = None) -> Pin:
    """The PSF of this name, for a range of times."""
    return Pin(psf_id=identity(name), **between(validity))


def between(validity: Validity | None) -> dict[str, Any]:
    """A range as a client sends it."""
    return {} if validity is None else {"valid_from": iso(validity.start), "valid_to": iso(validity.end)}


def years(start: int | None, end: int | None) -> Validity:
    """From the first of January of a year to that of another."""
    return Validity.of(*(None if year is None else f"{year}-01-01" for year in (start, end)))


def header_of(date: str | None, **cards: Any) -> dict[str, Any]:
    """What the upload of an image of HRI_EUV is kept with, as far as a PSF is found by it."""
    known = {
        "instrument": "hri_euv", "telescop": None, "instrume": "EUI", "detector": "HRI_EUV", "wavelnth": 174.0,
        "gain_mode": None, "date_obs": date, "content": "image", "cards": {"DETECTOR": "HRI_EUV", "WAVELNTH": 174.0},
    }  # fmt: skip
    return known | cards


def refused(code: str, change: Callable[[], object]) -> str:
    """The message of the DataError with this code that a call raises."""
    with pytest.raises(DataError) as caught:
        change()
    assert caught.value.code == code, caught.value.message
    return caught.value.message
