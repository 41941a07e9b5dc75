"""Reads a multipart form while it arrives, without keeping the bytes of its parts in memory."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect

from service.http.problems import Problem

FORM, URL_ENCODED = "multipart/form-data", "application/x-www-form-urlencoded"


@dataclass(frozen=True, eq=False)
class FormPart:
    """A part of a form.

    Attributes
    ----------
    filename
        The name that the client gives to a file; None if the part is a field.
    """

    name: str
    filename: str | None


Piece = tuple[FormPart, bytes]


def media_type_of(request: Request) -> str:
    """The media type of the body in lower case, without its parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def chunks_of(request: Request) -> AsyncIterator[bytes]:
    """The body in chunks. Raises ``Problem`` 400 "upload-ended-early" if the client closes the connection."""
    try:
        async for chunk in request.stream():
            if chunk:
                yield chunk
    except ClientDisconnect as error:
        raise Problem(
            400,
            "upload-ended-early",
            "expected the complete request; the connection closed before the end: send it again",
        ) from error


async def pieces_of(request: Request, most_bytes: int) -> AsyncIterator[list[Piece]]:
    """The pieces of a form's parts in their order, one list for each chunk of the body. The first piece of a part is
    empty.

    Raises ``Problem`` 400 "bad-form" if the body is no form, 400 "upload-ended-early" if the form is not complete, and
    413 if it has more than ``most_bytes`` bytes.
    """
    boundary = parse_options_header(request.headers.get("content-type", ""))[1].get(b"boundary")
    if not boundary:
        raise _bad("expected a boundary in the multipart Content-Type; got none: correct the request")
    got = 0
    try:
        parts = _Parts(boundary)
        async for chunk in chunks_of(request):
            got += len(chunk)
            if got > most_bytes:
                message = (
                    f"expected a form of at most {most_bytes} bytes; got more: send less, or ask the operator"
                )
                raise Problem(413, "too-large", message)
            yield parts.pieces(chunk)
    except FormParserError as error:
        raise _bad(f"expected {FORM}: {error}") from error
    if got == 0:
        raise _bad(f"expected {FORM}; got no bytes: send the form")
    if not parts.whole:
        message = "expected the complete form; it ended before its last boundary: send it again"
        raise Problem(400, "upload-ended-early", message)


def _bad(message: str) -> Problem:
    return Problem(400, "bad-form", message)


class _Parts:
    """The parts of a form.

    Attributes
    ----------
    whole
        Whether the end of the form has arrived.
    """

    def __init__(self, boundary: bytes) -> None:
        self.whole = False
        self._pieces: list[Piece] = []
        self._part = FormPart("", None)
        self._header, self._value, self._disposition = b"", b"", b""
        self._parser = MultipartParser(
            boundary,
            {
                "on_header_field": self._header_name,
                "on_header_value": self._header_value,
                "on_header_end": self._header_end,
                "on_headers_finished": self._begin,
                "on_part_data": self._data,
                "on_end": self._end,
            },
        )

    def pieces(self, chunk: bytes) -> list[Piece]:
        """The pieces in the next chunk of the form."""
        self._pieces = []
        self._parser.write(chunk)
        return self._pieces

    def _header_name(self, data: bytes, start: int, end: int) -> None:
        self._header += data[start:end]

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _header_end(self) -> None:
        if self._header.lower() == b"content-disposition":
            self._disposition = self._value
        self._header, self._value = b"", b""

    def _begin(self) -> None:
        _, options = parse_options_header(self._disposition)
        self._disposition = b""
        name, filename = (options.get(key) for key in (b"name", b"filename"))
        if not name:
            raise _bad("expected a name for every part of the form; got a part without one")
        shown = None if filename is None else filename.decode("utf-8", "replace")
        self._part = FormPart(name.decode("utf-8", "replace"), shown)
        self._pieces.append((self._part, b""))

    def _data(self, data: bytes, start: int, end: int) -> None:
        self._pieces.append((self._part, data[start:end]))

    def _end(self) -> None:
        self.whole = True
