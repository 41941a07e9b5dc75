"""Forms: their fields become the parameters of a request, by the names, types and limits of the request's own
fields.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Annotated, Any, TypeVar, cast
from urllib.parse import urlencode

from annotated_types import Ge, Le, MultipleOf
from fastapi import Depends, Request, Response
from fastapi.responses import RedirectResponse
from markupsafe import Markup
from pydantic import BaseModel, TypeAdapter, ValidationError
from starlette.datastructures import FormData, UploadFile

from service.api.jobs import submit_job
from service.http.callers import Caller
from service.http.guard import check_text
from service.http.problems import Problem
from service.http.state import State
from workers.contract.kinds import KINDS, JobRequest
from workers.contract.requests import METHOD_MODELS, METHODS, DefaultMethod
from workers.contract.suggestions import explained

Sent = Mapping[str, str | UploadFile]
Checked = TypeVar("Checked")


async def _sent_form(request: Request) -> FormData:
    form = await request.form()
    check_text(*(value for value in form.values() if isinstance(value, str)))
    return form


# The fields of the form of a request. It follows the caller in the parameters of a route, so that nothing is read for
# strangers.
SentForm = Annotated[FormData, Depends(_sent_form)]
# The options of a deconvolution in the form and in the address of the page of an image.
_OPTIONS = ("psf_id", "method", "steps", "error_draws", "photon_gain_dn", "read_noise_dn")
_BOXES = ("other_channel", "again")
_ATTRIBUTES = {Ge: ("min", "ge"), Le: ("max", "le"), MultipleOf: ("step", "multiple_of")}
_adapter = cache(TypeAdapter)


def text(form: Sent, name: str) -> str:
    """The text of a field, without spaces around it; empty if the form has no such field."""
    value = form.get(name, "")
    return value.strip() if isinstance(value, str) else ""


def filled(form: Sent, *names: str) -> dict[str, str]:
    """The fields that are not empty. Empty fields are left out, so that they get their defaults."""
    return {name: text(form, name) for name in names if text(form, name)}


def parameters(model: type[BaseModel], form: Sent) -> dict[str, object]:
    """The parameters of a request in a form, by the names of the fields of its model.

    A browser sends no field for an empty box. Therefore a box that the form does not send is false: the form of a
    request must have every box whose default is true. Raises ``Problem`` 422 for noise figures that are no numbers.
    """
    boxes = [name for name, field in model.model_fields.items() if field.annotation is bool]
    others = model.model_fields.keys() - {*boxes, "noise"}
    noise = _noise(form) if "noise" in model.model_fields else {}
    return {**filled(form, *others), **{name: bool(text(form, name)) for name in boxes}, **noise}


def _noise(form: Sent) -> dict[str, object]:
    """The noise figures of a form; no parameter if both fields are empty. The request itself accepts only numbers."""
    figures = checked(dict[str, float], filled(form, "photon_gain_dn", "read_noise_dn"))
    return {"noise": figures} if figures else {}


def number_field(kind: str, name: str) -> Markup:
    """The attributes of an input for a number of a request: its type, name and limits."""
    model = KINDS[kind].parameters
    assert model is not None
    field = model.model_fields.get(name) or DefaultMethod.model_fields[name]
    limits = {_ATTRIBUTES[type(one)]: one for one in field.metadata if type(one) in _ATTRIBUTES}
    attributes = {attribute: getattr(one, limit) for (attribute, limit), one in limits.items()}
    return Markup(" ").join(
        Markup('{}="{}"').format(*one) for one in {"type": "number", "name": name, **attributes}.items()
    )


def checked(model: Callable[..., Checked], values: Mapping[str, object], *, above: int = 0) -> Checked:
    """The model with these values, or what a function returns for them.

    Parameters
    ----------
    above
        How many names to remove from the start of each field's path (``loc``), because they are levels of the model and
        not fields of the form.

    Raises
    ------
    Problem
        Status 422; the error names each wrong field.
    """
    try:
        return cast("Checked", _adapter(model).validate_python(dict(values)))
    except ValidationError as error:
        lines = [
            f"{'.'.join(map(str, one['loc'][above:])) or 'the form'}: {explanation}"
            for one, explanation in explained(error.errors(), model)
        ]
        raise Problem(422, "invalid-request", "; ".join(lines)) from error


def job_request(kind: str, values: Mapping[str, object]) -> JobRequest:
    """The request for a job with these parameters. Raises ``Problem`` 422, which names each wrong parameter."""
    body = {"kind": kind, "parameters": dict(values)}
    return checked(JobRequest, body, above=len(("kind", "parameters")))


def start_job(kind: str, values: Mapping[str, object], caller: Caller, state: State) -> Response:
    """Submit a job, and go to its page. Equal requests lead to the same job."""
    request = job_request(kind, values)
    job = submit_job(request, Response(), caller, state)
    return RedirectResponse(f"/jobs/{job.id}", 303)


# --- the options of a deconvolution -----------------------------------------------------------------------


def usual_steps() -> dict[str, int]:
    """The default number of steps of each method; the default method first."""
    return {name: model.model_fields["steps"].default for name, model in METHOD_MODELS.items()}


def chosen_method(form: Sent) -> dict[str, str]:
    """The parameter ``method`` of a request. If the form gives no number of steps, the method's default applies."""
    return {"name": text(form, "method") or METHODS[0], **filled(form, "steps")}


def deconvolution(image_id: str, form: Sent) -> JobRequest:
    """The request for the deconvolution of an image. Raises ``Problem`` 422 for a wrong option."""
    model = KINDS["deconvolve"].parameters
    assert model is not None
    values = parameters(model, form) | {"image_id": image_id, "method": chosen_method(form)}
    return job_request("deconvolve", values)


def shown_options(form: Sent) -> dict[str, object]:
    """The options as the form shows them again."""
    values = {name: text(form, name) for name in (*_OPTIONS, *_BOXES)}
    return values | {"error_draws": values["error_draws"] or "0", "changed": any(values.values())}


def image_address(image_id: str, form: Sent) -> str:
    """The page of an image with these options."""
    given = filled(form, *_OPTIONS, *_BOXES)
    return f"/images/{image_id}" + (f"?{urlencode(given)}" if given else "")


def address_of(resolved: Mapping[str, Any]) -> str:
    """The page of an image, with the options of a deconvolution. ``resolved`` contains the resolved parameters of its
    job.
    """
    method, figures = resolved["method"], resolved.get("noise") or {}
    chosen = resolved.get("picked_for") is None and resolved.get("psf_recipe") is None
    options = {
        "psf_id": resolved["psf_id"] if chosen else "",
        "method": method["name"],
        "steps": str(method["steps"]),
        "error_draws": str(resolved.get("error_draws") or ""),
        **{name: f"{value:g}" for name, value in figures.items()},
        **{name: "1" if resolved.get(name) else "" for name in _BOXES},
    }
    return image_address(resolved["image_id"], options)
