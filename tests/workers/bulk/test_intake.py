"""Keys of bulk runs: an identical request finds the open run."""

from __future__ import annotations

from workers.bulk.intake import _key
from workers.contract.bulk import BulkRequest

IMAGE, PSF = "a" * 64, "b" * 64


def key(**parameters: object) -> str:
    request = BulkRequest.model_validate({"images": [IMAGE], "psf_id": PSF, "parameters": parameters})
    asked = request.model_dump(mode="json", exclude={"images", "context"}) | {"context": None}
    return _key(asked, [IMAGE])


def test_a_run_that_was_open_before_newer_parameters_existed_keeps_its_key() -> None:
    """The value was computed by commit a8b3a2c."""
    assert key() == "18e7adbbdff5a8734007058e3c39eb5e13a4227b4b987a13fad0c42ef3293710"
    assert key(other_channel=False, again=False) == key() != key(other_channel=True)
    assert key(again=True) != key()
