"""Forms that start jobs: the fields of a form become the parameters of a request."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse
from pydantic import BaseModel, TypeAdapter, ValidationError
from starlette.datastructures import UploadFile

from service.api.jobs import submit_job
from service.http.callers import Caller
from service.http.problems import Problem
from service.http.state import State
from workers.contract.kinds import JobRequest
from workers.contract.suggestions import explained

Sent = Mapping[str, str | UploadFile]
_REQUEST: TypeAdapter[Any] = TypeAdapter(JobRequest)


def text(form: Sent, name: str) -> str:
    """The text of a field, without spaces around it; empty if the form has no such field."""
    value = form.get(name, "")
    return value.strip() if isinstance(value, str) else ""


def filled(form: Sent, *names: str) -> dict[str, str]:
    """The fields that are not empty. Empty fields are left out, so that they get their defaults."""
    return {name: text(form, name) for name in names if text(form, name)}


def ticked(form: Sent, *names: str) -> dict[str, bool]:
    """Whether each box is ticked. A browser sends no field for an empty box."""
    return {name: bool(text(form, name)) for name in names}


def noise(form: Sent) -> dict[str, Any]:
    """The noise figures of a form, as a parameter; no parameter if both fields are empty.

    Raises ``Problem`` 422 for a text that is no number; the request itself accepts only numbers.
    """
    given = filled(form, "photon_gain_dn", "read_noise_dn")
    try:
        figures = {name: float(value) for name, value in given.items()}
    except ValueError as error:
        raise Problem(
            422,
            "invalid-request",
            f"expected photon gain and read noise as numbers in DN; got {', '.join(given.values())}: correct the two fields",
        ) from error
    return {"noise": figures} if figures else {}


def checked(model: type[BaseModel], values: Mapping[str, Any]) -> Any:
    """The model with these values. Raises ``Problem`` 422, which names each wrong field."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise wrong_fields(error, model) from error


def wanted_job(kind: str, parameters: Mapping[str, Any]) -> JobRequest:
    """The request for a job. Raises ``Problem`` 422, which names each wrong parameter."""
    try:
        found: JobRequest = _REQUEST.validate_python({"kind": kind, "parameters": dict(parameters)})
    except ValidationError as error:
        raise wrong_fields(error, JobRequest, above=len(("kind", "parameters"))) from error
    return found


async def start_job(kind: str, parameters: Mapping[str, Any], caller: Caller, state: State) -> Response:
    """Submit a job, and go to its page. Equal requests lead to the same job."""
    asked = wanted_job(kind, parameters)
    job = await run_in_threadpool(lambda: submit_job(asked, Response(), caller, state))
    return RedirectResponse(f"/jobs/{job.id}", 303)


async def fields(request: Request) -> Sent:
    """The fields of the form that was sent."""
    return await request.form()


def wrong_fields(error: ValidationError, model: Any, *, above: int = 0) -> Problem:
    """The problem that names each wrong field.

    model: the model that refused the fields. above: how many names to remove from the start of each field's path
    (``loc``), because they are levels of the model and not fields of the form.
    """
    said = [
        f"{'.'.join(map(str, found['loc'][above:])) or 'the form'}: {told}"
        for found, told in explained(error.errors(), model)
    ]
    return Problem(422, "invalid-request", "; ".join(said))
