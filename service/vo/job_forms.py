"""Checks the parameters of jobs that UWS clients send. Each is a text in a form, and is checked against the contract.

An input of a job is named by the id that it has since its upload: a form contains no file, and the standard parameter
UPLOAD (IVOA DALI 1.1) is refused.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, from_json

from psfcore.errors import DataError
from service.http.problems import Problem
from service.http.quotas import check_room
from service.http.state import State
from service.vo.parameters import NO_XML, UPLOAD_FIRST, bad, shown
from workers.contract.kinds import KINDS, REQUESTS
from workers.contract.suggestions import did_you_mean, explained
from workers.intake import estimates
from workers.intake.requests import resolve


def kind_of(form: dict[str, str]) -> str:
    """Remove KIND from a form and return it.

    Raises ``Problem`` if clients cannot request jobs of this kind, and if the form has the parameter UPLOAD.
    """
    if "upload" in form:
        raise bad(f"expected a form without UPLOAD; got {shown(form['upload'])}: {UPLOAD_FIRST}")
    kind = form.pop("kind", None)
    if kind is None or kind not in REQUESTS:
        hint = did_you_mean(kind or "", REQUESTS)
        raise bad(f"expected KIND, one of {', '.join(REQUESTS)}; got {shown(kind)}{hint}")
    return kind


def check(kind: str, given: dict[str, str]) -> None:
    """Raise ``Problem`` for a wrong parameter of a PENDING job; parameters may still be missing."""
    _values, errors = _understood(kind, given)
    wrong = [e for e in errors if e["loc"] and not (e["type"] == "missing" and len(e["loc"]) == 1)]
    if wrong:
        raise _wrong(kind, wrong)


def resolved(
    state: State, owner: str, kind: str, given: dict[str, str]
) -> tuple[dict[str, object], str, dict[str, float]]:
    """Resolved parameters of a job, the identity of its result, and its estimate.

    Raises ``Problem`` 400 if the parameters are wrong or the job would exceed the limits on memory or time, and 507 if
    the owner's quota is full.
    """
    check_room(state, owner)
    values, errors = _understood(kind, given)
    if errors:
        raise _wrong(kind, errors)
    asked = REQUESTS[kind].model_validate({"kind": kind, "parameters": values})
    try:
        parameters, key = resolve(asked, state.catalogue, owner, added_effects=state.settings.added_effects)
        return parameters, key, estimates.checked(kind, parameters, state.catalogue, owner, state.settings)
    except DataError as error:
        raise bad(error.message) from error


def _understood(kind: str, given: dict[str, str]) -> tuple[dict[str, object], list[ErrorDetails]]:
    """The parameters, and an error for each parameter that the contract does not accept.

    Each parameter is a text. If the contract accepts the text as it is (a name, a number, true or false), the text is
    kept. Otherwise the text is read as JSON.
    """
    for name, text in given.items():
        if NO_XML.search(text):
            raise bad(f"{name}: expected characters that XML can hold, got {shown(text)}")
    values: dict[str, object] = dict(given)
    for name in {str(error["loc"][0]) for error in _errors(kind, values) if error["loc"]} & given.keys():
        with suppress(ValueError):
            values[name] = from_json(given[name], allow_inf_nan=False)
    return values, _errors(kind, values)


def _errors(kind: str, values: dict[str, object]) -> list[ErrorDetails]:
    try:
        _model(kind).model_validate(values)
    except ValidationError as error:
        return error.errors(include_url=False)
    return []


def _wrong(kind: str, errors: Iterable[ErrorDetails]) -> Problem:
    lines = []
    for error, message in explained(errors, _model(kind)):
        name = "/".join(map(str, error["loc"])) or kind
        if error["type"] == "missing":
            lines.append(f"{name}: expected a value, got none")
        elif error["type"] in ("extra_forbidden", "union_tag_invalid"):
            lines.append(f"{name}: {message}")
        else:
            lines.append(f"{name}: {message}; got {shown(error['input'])}")
    return bad("\n".join(lines))


def _model(kind: str) -> type[BaseModel]:
    model = KINDS[kind].parameters
    assert model is not None
    return model
