"""The files that pages load: style sheets, scripts and pictures, at ``/static/VERSION/NAME``.

VERSION is a hash of all files. Scripts import each other by relative addresses, so a page and its scripts always have
the same version, and browsers may keep them for ever.

The interactive reference of the API at ``/docs`` is Swagger UI. The package ``fastapi-swagger`` contains its script and
its style sheet. The page of that package starts Swagger UI with an inline script, which our content security policy
forbids; our page starts it with a script file.
"""

from __future__ import annotations

import hashlib
from functools import cache
from os import PathLike, stat_result
from pathlib import Path

from fastapi import FastAPI, Response
from fastapi.staticfiles import StaticFiles
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import Scope

FOR_EVER = "public, max-age=31536000, immutable"
MOUNT = "/static/{of_version}"
LEVEL = 6  # of the compression; more costs time and makes files hardly smaller


class _Files(StaticFiles):
    """Files with the headers by which browsers keep them: for ever under the present version, and else not unasked."""

    path = f"{MOUNT}/{{name}}"  # as which the requests are counted

    def file_response(
        self, full_path: str | PathLike[str], stat_result: stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """The answer with a file. It has no ETag, because answers with an ETag differ from caller to caller."""
        answer = super().file_response(full_path, stat_result, scope, status_code)
        del answer.headers["ETag"]
        present = scope["path_params"]["of_version"] == version()
        answer.headers["Cache-Control"] = FOR_EVER if present else "no-cache"
        scope["route"] = self
        return answer


FILES = _Files(packages=[(__package__, "static"), (__package__, "vendor"), ("fastapi_swagger", "resources")])


def install(app: FastAPI) -> None:
    """Serve the files. A page of an earlier version gets the present file."""
    app.mount(MOUNT, GZipMiddleware(FILES, compresslevel=LEVEL))


@cache
def assets() -> dict[str, Path]:
    """All files by their names."""
    found = [path for folder in FILES.all_directories for path in Path(folder).iterdir() if path.is_file()]
    return {path.name: path for path in sorted(found)}


@cache
def version() -> str:
    """The hash of all files."""
    said = [(name, hashlib.sha256(path.read_bytes()).hexdigest()) for name, path in assets().items()]
    return hashlib.sha256(repr(said).encode()).hexdigest()[:12]


def address(name: str) -> str:
    """The address of a file. Raises KeyError for an unknown name."""
    assert assets()[name]
    return f"/static/{version()}/{name}"
