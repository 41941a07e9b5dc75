"""Ids in the parameters of any kind are checked when the job is submitted."""

from __future__ import annotations

import pytest

from psfcore.errors import DataError
from tests.workers.psf_examples import OWNER, psf
from workers.catalogue.catalogue import Catalogue
from workers.contract.kinds import Kind, Result
from workers.contract.requests import Parameters
from workers.intake.requests import Asked, resolve_by_ids

UNKNOWN = "f" * 64


class Two(Parameters):
    """Parameters with two PSFs, and ids that may be missing."""

    psf_id: str
    other_psf_id: str | None = None
    reference_transit_id: str | None = None
    no_id: str = UNKNOWN


def resolved(catalogue: Catalogue, **parameters: str) -> Parameters:
    kind = Kind("two", task="", result=Result.REPORT, parameters=Two, resolved=Two)
    return resolve_by_ids(Asked(kind, Two(**parameters), catalogue, OWNER, ()))


def test_every_id_is_checked(catalogue: Catalogue) -> None:
    known = catalogue.add(psf("one"))[0].id
    assert resolved(catalogue, psf_id=known, other_psf_id=known) == Two(psf_id=known, other_psf_id=known)
    for name, code in (("other_psf_id", "no-such-psf"), ("reference_transit_id", "no-such-transit")):
        with pytest.raises(DataError, match=UNKNOWN) as caught:
            resolved(catalogue, **({"psf_id": known} | {name: UNKNOWN}))
        assert caught.value.code == code
