"""Forms: which fields become parameters, and how wrong ones are refused."""

from __future__ import annotations

import pytest

from service.http.problems import Problem
from service.pages.parts.forms import filled, noise, ticked, wanted_job


def test_empty_fields_keep_their_defaults_and_boxes_say_yes_or_no() -> None:
    form = {"shape": " core ", "seed": "", "correct": "1"}
    assert filled(form, "shape", "seed", "runs") == {"shape": "core"}
    assert ticked(form, "correct", "shapes") == {"correct": True, "shapes": False}


def test_noise_figures_become_numbers() -> None:
    assert noise({"photon_gain_dn": "6.5", "read_noise_dn": "2"}) == {
        "noise": {"photon_gain_dn": 6.5, "read_noise_dn": 2.0}
    }
    assert noise({"photon_gain_dn": ""}) == {}
    with pytest.raises(Problem, match="as numbers in DN; got many"):
        noise({"photon_gain_dn": "many"})


def test_a_wrong_parameter_is_named() -> None:
    job = wanted_job("psf-build", {"instrument": "hri_euv", "size": "128"})
    assert job.kind == "psf-build" and job.parameters.size == 128
    with pytest.raises(Problem, match="size: Input should be") as refused:
        wanted_job("psf-build", {"instrument": "hri_euv", "size": "wide"})
    assert refused.value.status == 422
    with pytest.raises(Problem, match=r"method: expected name to be one of richardson-lucy, .*; got 'magic'"):
        wanted_job("deconvolve", {"image_id": "0" * 64, "method": {"name": "magic"}})
