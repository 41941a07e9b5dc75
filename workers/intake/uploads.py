"""Makes the catalogue rows of uploaded images, transits and PSFs."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import NamedTuple

from psfcore.fits.header import HeaderJson, HeaderSummary
from psfcore.transit.archive import ArchiveContents
from workers.catalogue.tables import ImageRow, PsfRow, TransitRow
from workers.contract.documents import header_json
from workers.versions import UPLOADED, PsfStatus, channel_of, instrument_of, label, name_of_upload, series_of

TEXT_LENGTH = 200


class Upload(NamedTuple):
    """A file that an owner sent.

    Attributes
    ----------
    filename
        The name that the client gave to the file, if any.
    """

    owner: str
    sha256: str
    size_bytes: int
    filename: str | None


def image_row(upload: Upload, summary: HeaderSummary) -> ImageRow:
    """The row of an uploaded image."""
    return ImageRow(
        owner=upload.owner,
        id=upload.sha256,
        created_at=time.time(),
        bytes=upload.size_bytes,
        filename=upload.filename,
        summary=_summary(summary),
    )


def transit_row(upload: Upload, contents: ArchiveContents) -> TransitRow:
    """The row of an uploaded transit. Its summary comes from the archive's table of contents and transit.json."""
    manifest = contents.manifest
    return TransitRow(
        owner=upload.owner,
        id=upload.sha256,
        created_at=time.time(),
        bytes=upload.size_bytes,
        filename=upload.filename,
        summary={
            "archive": contents.kind,
            "instrument": manifest.instrument,
            "images": len(manifest.images),
            "pointings": [{"fov": fov, "images": images} for fov, images in manifest.pointings.items()],
            "noise": None if manifest.noise is None else manifest.noise.model_dump(mode="json"),
            "known_psf": manifest.known_psf,
            "files": [{"name": name, "bytes": contents.files[name]} for name in manifest.files],
            "unpacked_bytes": sum(contents.files.values()),
            "pixels": contents.pixels,
        },
    )


def uploaded_psf_row(
    upload: Upload,
    summary: HeaderSummary,
    *,
    name: str | None = None,
    version: str | None = None,
    instrument: str | None = None,
    channel: str | None = None,
    kind: str | None = None,
) -> PsfRow:
    """The row of an uploaded PSF, with status draft.

    A name, version, instrument or channel that the request does not give is taken from the header. Without a name in
    the header, the PSF gets the name of the file. Longer texts of the header are cut.
    """
    header = _summary(summary)
    instrument = instrument or instrument_of(header)
    channel = channel or channel_of(instrument, summary.wavelnth)
    kind = kind or UPLOADED
    named = name_of_upload(summary, upload.filename, upload.sha256)
    return PsfRow(
        owner=upload.owner,
        id=upload.sha256,
        created_at=time.time(),
        name=name or named[0],
        version=version or named[1],
        instrument=instrument,
        channel=channel,
        kind=kind,
        series=series_of(instrument, channel, kind),
        status=PsfStatus.DRAFT,
        origin="uploaded",
        file_sha256=upload.sha256,
        bytes=upload.size_bytes,
        preview_sha256=None,
        details={
            "shape": list(summary.shape),
            "plate_scale_arcsec": summary.cdelt1,
            "wavelength_angstrom": summary.wavelnth,
            "filename": upload.filename,
            "cards": header["cards"],
        },
    )


def _summary(summary: HeaderSummary) -> HeaderJson:
    """The summary of a header as JSON. Each text is cut, because one text may continue over thousands of cards."""
    return header_json(_cut(dataclasses.asdict(summary)))


def _cut(values: Mapping[str, object]) -> dict[str, object]:
    cut = {
        name: label(value, TEXT_LENGTH) if isinstance(value, str) else value for name, value in values.items()
    }
    return cut | {name: _cut(value) for name, value in values.items() if isinstance(value, dict)}
