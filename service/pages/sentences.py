"""Errors as sentences for people who use the pages, without terms of the command line and of the API."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from psfcore.instruments.psf_statements import remarks
from service.http.problems import Problem
from service.views import PsfView
from workers.catalogue.tables import PsfRow
from workers.lookup import NAMES

# The labels in the forms, for fields whose label differs from their name.
_FIELDS = {
    "error_draws": "Noise realisations",
    "psf_id": "PSF",
    "image_id": "Image",
    "glob": "Files",
    "folder": "Output folder",
    "lasts_days": "Lifetime",
    "layout": "Names of the files",
    "photon_gain_dn": "Photon gain (DN)",
    "read_noise_dn": "Read noise (DN)",
}
_FIELD = re.compile(r"(?:^|(?<=; ))(?:[a-z0-9_-]+\.)*([a-z_]+): ")
_NO_FIELDS: Mapping[str, object] = {}
# Parts of a message that only a command or a program needs, such as "(--again, in a request again = true)".
_FOR_PROGRAMS = re.compile(
    r"\s*\((?:--|psf_id\b)[^()]*\)|\s*\([^()]*(?:in a request|on the command line)[^()]*\)"
)


def of_problem(problem: Problem) -> str:
    """The sentence for a problem."""
    return of_error(problem.code, problem.detail, problem.more)


def of_error(code: str, message: str, fields: Mapping[str, object] = _NO_FIELDS) -> str:
    """The sentence for an error. ``fields`` are the fields of its ``DataError``, and empty for the stored error of a
    job.
    """
    thing = NAMES.get(code.removeprefix("no-such-"))
    if thing is not None and message.startswith("expected the id"):
        return (
            f"There is no such {thing} here. It was deleted, or it belongs to another owner, or its address is "
            "not complete."
        )
    try:
        return _SENTENCES[code](message, fields)
    except KeyError:  # another code, or an error without its fields
        return plain(message)


def remarks_of(psf: PsfRow | PsfView) -> list[str]:
    """What a reader must know of a PSF, as sentences."""
    provenance = psf.details.get("provenance") or {}
    return [plain(one) for one in remarks(psf.name, psf.instrument, provenance, psf.status)]


def plain(message: str) -> str:
    """A message as a sentence: with a capital and a full stop, without the parts that only programs need."""
    text = _FOR_PROGRAMS.sub("", message).strip()
    text = text[:1].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) or not text else f"{text}."


def _wrong_fields(message: str, _fields: Mapping[str, object]) -> str:
    """An error message about one or more fields, as a sentence. Each field name is replaced by its form label."""
    text = message.replace("Value error, ", "").removeprefix("the form: ")

    def label(found: re.Match[str]) -> str:
        return _FIELDS.get(found[1], found[1].replace("_", " ").capitalize()) + ": "

    return plain(_FIELD.sub(label, text))


def _no_psf(_message: str, fields: Mapping[str, object]) -> str:
    why = f": {fields['reason']}" if fields.get("reason") else ""
    return f"No PSF for {fields['image']} is known here{why}. Upload a PSF here, or fit one to a transit."


def _channel(_message: str, fields: Mapping[str, Any]) -> str:
    return f"PSF {fields['psf']} is not made for this image: {'; '.join(fields['differences'])}. Choose another PSF."


def _plate_scale(_message: str, fields: Mapping[str, object]) -> str:
    told = (
        f"The pixels of PSF {fields['psf']} are {fields['psf_arcsec']:g} arcsec wide, those of this image "
        f"{fields['image_arcsec']} arcsec. "
    )
    if fields["factor"] is None:
        return told + "Choose a PSF with the pixels of the image."
    return told + (
        "Rebin the PSF: download it from its page (PSFs), run `heliopsf psf rebin PSF.fits --factor "
        f"{fields['factor']} -o BINNED.fits`, and upload BINNED.fits on the page PSFs."
    )


_SENTENCES: dict[str, Callable[[str, Mapping[str, object]], str]] = {
    "no-psf-for-instrument": _no_psf,
    "channel-mismatch": _channel,
    "plate-scale-mismatch": _plate_scale,
    "no-noise-figures": lambda *_: (
        "The photon gain and the read noise of this camera are not known here. Enter both in the options."
    ),
    "already-deconvolved": lambda *_: (
        "This file is a product of heliopsf: it was deconvolved before (its header has the card PSFID). Use the "
        "original image."
    ),
    "psf-as-image": lambda *_: (
        "This file is a PSF and not an image (the card PSFSUM in its header). Use it as the PSF of an image."
    ),
    "invalid-request": _wrong_fields,
    "not-fits": lambda *_: (
        "This file is not a FITS file: a FITS file begins with SIMPLE. Choose another file."
    ),
    "bad-key": lambda message, _: (
        "This is not a key. Copy the whole key; it begins with hpsf_."
        if "hpsf_ID_SECRET" in message
        else plain(message)
    ),
    "http-405": lambda *_: "This address shows no page. Go back, and use a link or a button of the page.",
}
