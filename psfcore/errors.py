"""Errors in the user's data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from importlib import import_module
from types import ModuleType

# If a module of heliopsf itself is missing, the installation is faulty.
_OWN = ("heliopsf", "psfcore", "workers", "service")
# The extra that installs a package; every other package that can be missing belongs to the service.
_EXTRAS = {"matplotlib": "plot", "jinja2": "plot", "markupsafe": "plot", "sunpy": "map", "s3fs": "s3"}
_EXTRAS |= {"opentelemetry": "traces", "pooch": "published"}
MOST_TOLD = 20  # if a request has many errors, only the texts of the first ones are given


class DataError(ValueError):
    """Data of the user that cannot be used.

    Parameters
    ----------
    code : str
        A stable word in kebab-case for programs, such as "all-nan".
    message : str
        A sentence for people: what was expected, what was found, and what to do next.
    fields : mapping of str to object, optional
        Further facts for programs, as JSON values.
    """

    def __init__(self, code: str, message: str, fields: Mapping[str, object] | None = None) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message
        self.fields = dict(fields or {})

    def __reduce__(self) -> tuple[type[DataError], tuple[str, str, dict[str, object]]]:
        return type(self), (self.code, self.message, self.fields)


class DataWarning(UserWarning):
    """A warning that data can be used, but that the result may be wrong.

    Parameters
    ----------
    code : str
        A stable word in kebab-case for programs, such as "uncertainty-dropped".
    message : str
        A sentence for people.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.message = message


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``; did you mean 'x'?``, or an empty text if no known name is close."""
    close = get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


class HeaderError(DataError):
    """The headers of a file show that the file cannot be used. No pixel was read."""


class MissingExtra(ImportError):
    """Packages that a function needs, which an extra of heliopsf installs, are missing.

    The message names the package and the extra.
    """


def module_of_extra(module: str) -> ModuleType:
    """Import a module that may need the packages of an extra, such as "plot".

    Raises MissingExtra, whose message names the missing package and the extra.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise missing_extra(error) from error


def missing_extra(error: ModuleNotFoundError) -> ImportError:
    """The error that names the extra of a missing package; the same error if a module of heliopsf itself is missing."""
    package = (error.name or "").partition(".")[0]
    if package in _OWN:
        return error
    extra = _EXTRAS.get(package, "service")
    return MissingExtra(
        f"expected the package {package}, which is not installed: install heliopsf with the extra {extra!r}, "
        f"pip install 'heliopsf[{extra}]'",
        name=error.name,
    )


def together(errors: Sequence[DataError]) -> DataError:
    """Combine the errors of several files into one error. It has all messages, and the type and code of the first
    error.
    """
    first = errors[0]
    if len(errors) == 1:
        return first
    messages = [error.message for error in errors[:MOST_TOLD]]
    if len(errors) > MOST_TOLD:
        messages.append(f"and {len(errors) - MOST_TOLD} more")
    return type(first)(first.code, f"{len(errors)} files cannot be used: " + "; ".join(messages))
