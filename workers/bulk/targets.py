"""The path of a product in the output folder of a bulk run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

from psfcore.errors import DataError
from workers.contract.bulk import Output
from workers.contract.layout import MOST_IN_PATH, Value, laid_out
from workers.files import archive as archive_files
from workers.settings import Settings
from workers.versions import seconds


def target_of(
    output: Output,
    settings: Settings,
    *,
    name: str,
    source: Path | None,
    summary: Mapping[str, Any],
    identity: str,
    psf_id: str,
) -> Path:
    """The path of a product. name: file name of the image. source: path of its file; None for an upload. identity: id
    of the product.

    Raises DataError "path-not-allowed", "bad-path", and "no-output-name" if the layout cannot name this image.
    """
    roots = archive_files.roots(settings.bulk_output_roots)
    folder = archive_files.check_under(Path(output.folder), roots, "an output folder")
    if output.layout is None:
        return folder / archive_files.safe_name(name, identity)
    values: dict[str, Value] = {
        "stem": archive_files.stem_of(name),
        "folder": _folder_below(source, archive_files.roots(settings.bulk_roots)),
        "date": _time(summary["date_obs"]),
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


def _folder_below(source: Path | None, roots: Sequence[Path]) -> PurePosixPath:
    if source is None:
        return PurePosixPath()
    root = next((root for root in roots if source.is_relative_to(root)), source.parent)
    return PurePosixPath(source.parent.relative_to(root))


def _time(text: str | None) -> datetime | None:
    at = None if text is None else seconds(text)
    return None if at is None else datetime.fromtimestamp(at, UTC)
