"""The form of a bulk run of files in a folder: its fields, the request that they make, and how they are shown again."""

from __future__ import annotations

from typing import Any

from service.http.callers import Caller
from service.http.problems import Problem
from service.http.state import State
from service.pages.parts import methods
from service.pages.parts.forms import Sent, checked, text
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import PsfContextRow
from workers.contract.bulk import BulkRequest
from workers.contract.layout import FIELDS
from workers.files import archive as archive_files
from workers.settings import Settings

MOST_CHOICES = 50  # PSFs and contexts that a form offers
NAMES = ("pattern", "choice", "name", "method", "steps", "folder", "only", "layout")
_KINDS = {"psf": "psf_id", "context": "context"}
EXAMPLE = "{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits"


def chosen_psf(choice: str) -> dict[str, str]:
    """The PSF or the context of a run. choice: ``psf:ID`` or ``context:ID``. Raises ``Problem`` 422."""
    kind, _, identity = choice.partition(":")
    if kind not in _KINDS:
        raise Problem(
            422, "invalid-request", "expected a PSF or a context for the run: go back and choose one"
        )
    return {_KINDS[kind]: identity}


def choices(caller: Caller, state: State) -> dict[str, Any]:
    """What the forms that start a run offer: PSFs, contexts and methods."""
    return {
        "psfs": state.catalogue.psfs.page(PsfFilter(), caller.owner, limit=MOST_CHOICES),
        "contexts": state.catalogue.page(PsfContextRow, owner=caller.owner, limit=MOST_CHOICES),
        "methods": methods.choices(),
    }


def folders(settings: Settings) -> dict[str, Any]:
    """The folders that the operator allows, and the fields of a layout."""
    return {
        "roots": [str(one) for one in archive_files.roots(settings.bulk_roots)],
        "output_roots": [str(one) for one in archive_files.roots(settings.bulk_output_roots)],
        "layout_fields": FIELDS,
        "layout_example": EXAMPLE,
    }


def shown(form: Sent) -> dict[str, str]:
    """The fields as the form shows them again."""
    return {name: text(form, name) for name in NAMES}


def wanted(form: Sent) -> BulkRequest:
    """The request for the run. Raises ``Problem`` 422, which names each wrong field."""
    pattern, folder = text(form, "pattern"), text(form, "folder")
    if not pattern:
        raise Problem(
            422, "invalid-request", "expected a pattern that names files, for example /archive/2025/*.fits"
        )
    if not folder and (text(form, "layout") or text(form, "only")):
        raise Problem(
            422,
            "invalid-request",
            "expected an output folder, because names of files and products only in the folder need one: "
            "enter the folder, or leave these fields empty",
        )
    output = {"folder": folder, "only": bool(text(form, "only")), "layout": text(form, "layout") or None}
    values = {
        "files": [{"glob": pattern}],
        "name": text(form, "name"),
        "parameters": {"method": methods.chosen(form)},
        "output": output if folder else None,
        **chosen_psf(text(form, "choice")),
    }
    found: BulkRequest = checked(BulkRequest, values)
    return found
