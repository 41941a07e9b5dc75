"""Answers that a limited process writes: a cut-out of a stored file goes into a file without a name, and then to the
client.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from service.http import files
from service.http.problems import as_problems
from service.http.quotas import check_disk
from service.http.state import State
from workers.catalogue.tables import ProductRow, PsfRow

PIECE_BYTES = 2**20


async def cutout_of(
    request: Request,
    state: State,
    row: ProductRow | PsfRow,
    part: str,
    write: Callable[[Path, BinaryIO], None],
    *,
    filename: str,
) -> Response:
    """A part of a stored file, which is made in the turn of the row's owner; or 304 if the client already has this
    part.

    Parameters
    ----------
    row
        The row with the stored file.
    part
        A text that tells the part from the other parts of the file, and from the parts that other versions make.
    write
        Function of the path of the stored file and of an open file, into which it writes the part. Its errors are
        raised as a ``Problem``.
    filename
        The name of the part for the client.
    """
    headers = files.headers_of(f"{row.file_sha256} {part}")
    if (same := files.not_modified(request, headers)) is not None:
        return same

    def written() -> BinaryIO:
        check_disk(state)
        path = files.path_of(state.store, row.file_sha256, row.bytes)
        with state.store.temporary() as target:
            file = target.open("w+b")
            try:
                write(path, file)
            except BaseException:
                file.close()
                raise
        return file

    with as_problems():
        file = await state.pixels.run(row.owner, written)
    headers["Content-Disposition"] = f'attachment; filename="{filename}"'
    headers["Content-Length"] = str(file.seek(0, io.SEEK_END))
    return StreamingResponse(_pieces(file), media_type=files.FITS_TYPE, headers=headers)


def _pieces(file: BinaryIO) -> Iterator[bytes]:
    with file:
        file.seek(0)
        while piece := file.read(PIECE_BYTES):
            yield piece
