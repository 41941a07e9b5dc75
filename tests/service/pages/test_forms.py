"""Forms: which fields become parameters, and how wrong ones are refused."""

from __future__ import annotations

import pytest

from service.http.problems import Problem
from service.pages.forms import job_request, number_field, parameters
from workers.contract.requests import CrossValidate, GapDiagnose, Report


def test_the_fields_of_a_request_become_its_parameters() -> None:
    form = {"shape": " core ", "seed": "", "runs": "3", "form_token": "x", "transit": "y"}
    assert parameters(CrossValidate, form) == {"shape": "core", "runs": "3"}
    assert parameters(Report, {"shapes": "1"}) == {"shapes": True, "dark_offsets": False}
    figures = {"photon_gain_dn": "6.5", "read_noise_dn": "2"}
    noise = {"photon_gain_dn": 6.5, "read_noise_dn": 2.0}
    assert parameters(GapDiagnose, {"correct": "1", **figures}) == {"correct": True, "noise": noise}
    with pytest.raises(Problem, match="as numbers in DN; got many"):
        parameters(GapDiagnose, {"photon_gain_dn": "many"})


def test_an_input_has_the_limits_of_its_parameter() -> None:
    assert number_field("psf-build", "size") == 'type="number" name="size" min="64" max="4096" step="2"'
    assert number_field("deconvolve", "steps") == 'type="number" name="steps" min="1" max="200"'


def test_a_wrong_parameter_is_named() -> None:
    job = job_request("psf-build", {"instrument": "hri_euv", "size": "128"})
    assert job.kind == "psf-build" and job.parameters.size == 128
    with pytest.raises(Problem, match="size: Input should be") as refused:
        job_request("psf-build", {"instrument": "hri_euv", "size": "wide"})
    assert refused.value.status == 422
    with pytest.raises(Problem, match=r"method: expected name to be one of richardson-lucy, .*; got 'magic'"):
        job_request("deconvolve", {"image_id": "0" * 64, "method": {"name": "magic"}})
