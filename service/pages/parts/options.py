"""The options of a deconvolution: in a form, in the address of the page of an image, and in the request for the job."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

from service.pages.parts import methods
from service.pages.parts.forms import Sent, filled, noise, text, ticked, wanted_job
from workers.contract.kinds import JobRequest

_BOXES = ("other_channel", "again")
_NAMES = ("psf_id", "method", "steps", "error_draws", "photon_gain_dn", "read_noise_dn", *_BOXES)


def wanted(image_id: str, asked: Sent) -> JobRequest:
    """The request for a job. Raises ``Problem`` 422 for a wrong option."""
    parameters = {
        "image_id": image_id,
        "psf_id": text(asked, "psf_id") or None,
        "method": methods.chosen(asked),
        "error_draws": text(asked, "error_draws") or 0,
        **noise(asked),
        **ticked(asked, *_BOXES),
    }
    return wanted_job("deconvolve", parameters)


def shown(asked: Sent) -> dict[str, Any]:
    """The options as the form shows them again."""
    values = {name: text(asked, name) for name in _NAMES}
    return values | {"error_draws": values["error_draws"] or "0", "changed": any(values.values())}


def address(image_id: str, asked: Sent) -> str:
    """The page of an image with these options."""
    given = filled(asked, *_NAMES)
    return f"/images/{image_id}" + (f"?{urlencode(given)}" if given else "")


def address_of(parameters: Mapping[str, Any]) -> str:
    """The page of an image, with the options of a deconvolution. parameters: the resolved parameters of its job."""
    method, figures = parameters["method"], parameters.get("noise") or {}
    chosen = parameters.get("picked_for") is None and parameters.get("psf_recipe") is None
    options = {
        "psf_id": parameters["psf_id"] if chosen else "",
        "method": method["name"],
        "steps": str(method["steps"]),
        "error_draws": str(parameters.get("error_draws") or ""),
        **{name: f"{value:g}" for name, value in figures.items()},
        **{name: "1" if parameters.get(name) else "" for name in _BOXES},
    }
    return address(parameters["image_id"], options)
