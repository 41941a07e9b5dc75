"""The fields of a form that choose the method of deconvolution and its steps."""

from __future__ import annotations

from typing import Any, get_args

from annotated_types import Ge, Le

from service.pages.parts.forms import Sent, text
from workers.contract.requests import Method, RichardsonLucy

USUAL = RichardsonLucy()


def choices() -> dict[str, Any]:
    """The default number of steps of each method (the default method first), and the smallest and the largest number of
    steps."""
    models = get_args(get_args(Method)[0])
    limits = RichardsonLucy.model_fields["steps"].metadata
    return {
        "usual_steps": {
            get_args(model.model_fields["name"].annotation)[0]: model.model_fields["steps"].default
            for model in models
        },
        "least_steps": next(one.ge for one in limits if isinstance(one, Ge)),
        "most_steps": next(one.le for one in limits if isinstance(one, Le)),
    }


def chosen(form: Sent) -> dict[str, str]:
    """The parameter ``method`` of a request. If the form gives no number of steps, the method's default applies."""
    method = {"name": text(form, "method") or USUAL.name}
    steps = text(form, "steps")
    return method | ({"steps": steps} if steps else {})
