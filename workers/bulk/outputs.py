"""The files of products in the output folder of a bulk run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath

from psfcore.errors import DataError
from psfcore.files import sha256_of
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import optional_text
from psfcore.fits.header import HeaderJson, read_first_image
from workers.contract.bulk import MOST_IN_PATH, FieldValue, Output, laid_out
from workers.files import archive as archive_files
from workers.files.store import is_disk_full
from workers.settings import Settings
from workers.versions import seconds


@dataclass(frozen=True)
class Source:
    """An image of a bulk run.

    Attributes
    ----------
    sha256
        SHA-256 of the file.
    summary
        Summary of the header.
    name
        File name of the image.
    path
        Path of a file of the archive; None for an upload.
    copy
        A copy of the file of the archive, if it was made.
    """

    sha256: str
    summary: HeaderJson
    name: str
    path: Path | None = None
    copy: Path | None = None


def target_of(output: Output, settings: Settings, source: Source, *, identity: str, psf_id: str) -> Path:
    """The path of a product.

    Parameters
    ----------
    identity
        The id of the product.

    Raises
    ------
    DataError
        "path-not-allowed", "bad-path", and "no-output-name" if the layout cannot name this image.
    """
    folder = archive_files.check_under(Path(output.folder), _roots(settings), "an output folder")
    if output.layout is None:
        return folder / archive_files.safe_name(source.name, identity)
    summary = source.summary
    taken_at = None if summary["date_obs"] is None else seconds(summary["date_obs"])
    values: dict[str, FieldValue] = {
        "stem": archive_files.stem_of(source.name),
        "folder": _folder_below(source.path, archive_files.roots(settings.bulk_roots)),
        "date": None if taken_at is None else datetime.fromtimestamp(taken_at, UTC),
        "wavelnth": None if summary["wavelnth"] is None else f"{summary['wavelnth']:g}",
        "product": identity[:16],
        "psf": psf_id[:16],
    }
    values |= {card: summary[card] for card in ("telescop", "instrume", "detector")}
    target = folder / laid_out(output.layout, values)
    if len(str(target)) > MOST_IN_PATH:
        raise DataError(
            "no-output-name",
            f"expected a path of at most {MOST_IN_PATH} characters; got {len(str(target))}: use a shorter layout",
        )
    # A link in the output folder may lead elsewhere.
    archive_files.check_under(target.parent, [folder], "a path of the output")
    return target


def prepare(output: Output, target: Path, identity: str, settings: Settings, limits: FitsLimits) -> None:
    """Make the folder of a product, and check that the product can be written: no work is lost if it cannot.

    Raises DataError "output-not-written", and "output-name-taken" if another product has the path that a layout gives
    to this product.
    """
    if output.layout is not None and target.is_file():
        try:
            there = optional_text(read_first_image(target, limits)[1].header, "PRODID")
        except DataError:  # a file that is no product; it must not be replaced either
            there = None
        if there != identity:
            raise _taken(target)
    with _write_errors():
        archive_files.make_folder(target.parent, _roots(settings))


def put(output: Output, source: Path, target: Path, sha256: str, settings: Settings) -> None:
    """Copy a file to its path in the output folder. A file whose name a layout gives is not replaced by another one.

    Raises DataError "output-not-written", "output-name-taken", and OSError if the disk is full.
    """
    with _write_errors():
        try:
            archive_files.put(source, target, _roots(settings), replace=output.layout is None)
        except FileExistsError:
            if sha256_of(target) != sha256:
                raise _taken(target) from None


def remove_partials(target: Path, settings: Settings) -> None:
    """Remove the partial copies of a product that a killed worker left."""
    if target.parent.is_dir():
        archive_files.remove_partials(target, _roots(settings))


def _roots(settings: Settings) -> tuple[Path, ...]:
    return archive_files.roots(settings.bulk_output_roots)


def _folder_below(source: Path | None, roots: Sequence[Path]) -> PurePosixPath:
    if source is None:
        return PurePosixPath()
    root = next((root for root in roots if source.is_relative_to(root)), source.parent)
    return PurePosixPath(source.parent.relative_to(root))


def _taken(target: Path) -> DataError:
    return DataError(
        "output-name-taken",
        f"expected a name of its own for each product; got {archive_files.shown(target)}, where another file is: use "
        "a layout with "
        "further fields, for example {product}, or another folder",
    )


@contextmanager
def _write_errors() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if is_disk_full(error):  # the same error would occur for every image
            raise
        reason = archive_files.reason_of(error)
        raise DataError(
            "output-not-written",
            f"expected an output folder that the service can write to; the system says: {reason}",
        ) from error
