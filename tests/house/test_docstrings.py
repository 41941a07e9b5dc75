"""The docstrings of what `heliopsf` offers have the sections of numpydoc, and name every parameter, result and
field."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import fields

from numpydoc.docscrape import NumpyDocString
from numpydoc.validate import validate

import heliopsf

OWN = ("heliopsf", "psfcore", "service", "workers")
SUMMARY = 88  # characters of the first line
# Checks of numpydoc that are off, and why.
OFF = {
    "ES01": "a summary that says everything needs no more sentences",
    "EX01": "the tutorials are the examples, and they run",
    "PR03": "parameters with one meaning share an entry, wherever they stand in the signature",
    "SA01": "the reference shows related names together",
}
# Classes that only the package makes: their fields are attributes, not parameters (PR01).
RESULTS = (heliopsf.Convolution, heliopsf.Deconvolution, heliopsf.GapDiagnosis, heliopsf.ScatterFit)


def _names() -> Iterator[str]:
    """Every public name, and every public method and property: as the class of this project that documents it has
    it."""
    for public in heliopsf.__all__:
        yield f"heliopsf.{public}"
        value = getattr(heliopsf, public)
        for name in dir(value) if isinstance(value, type) else ():
            homes = [kind for kind in value.__mro__ if name in vars(kind)]
            if name.startswith("_") or not homes or not hasattr(vars(homes[0])[name], "__get__"):
                continue
            home = next((kind for kind in homes if vars(kind)[name].__doc__), homes[0])
            if home.__module__.partition(".")[0] in OWN:
                yield f"{home.__module__}.{home.__qualname__}.{name}"


def test_docstrings_have_the_sections_of_numpydoc() -> None:
    results = {f"heliopsf.{kind.__name__}" for kind in RESULTS}
    wrong = {}
    for name in dict.fromkeys(_names()):
        answer = validate(name)
        off = {*OFF, "PR01"} if name in results else OFF
        wrong[name] = [error for error in answer["errors"] if error[0] not in off]
        summary = answer["docstring"].strip().partition("\n")[0]
        wrong[name] += [summary] if len(summary) > SUMMARY else []
    assert len(wrong) > 100
    assert {name: errors for name, errors in wrong.items() if errors} == {}


def test_the_fields_of_results_are_described() -> None:
    for kind in RESULTS:
        entries = NumpyDocString(inspect.getdoc(kind))["Attributes"]
        assert all(entry.type and entry.desc for entry in entries), kind
        named = [name for entry in entries for name in entry.name.split(", ")]
        assert sorted(named) == sorted(field.name for field in fields(kind)), kind
