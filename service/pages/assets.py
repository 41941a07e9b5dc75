"""The files that pages load: style sheets, scripts and pictures, at ``/static/VERSION/NAME``.

VERSION is a hash of all files. Scripts import each other by relative addresses, so a page and its scripts always have
the same version, and browsers may keep them for ever.

The interactive reference of the API at ``/docs`` is Swagger UI. The package ``fastapi-swagger`` contains its scripts and its
style sheet. The page of that package starts Swagger UI with an inline script, which our content security policy forbids; our
page starts it with a script file.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.resources import files
from os import PathLike, stat_result
from pathlib import Path

from fastapi import FastAPI, Response
from fastapi.staticfiles import StaticFiles
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import Scope

FOLDERS = ("static", "vendor")
FOR_EVER = "public, max-age=31536000, immutable"


class _Files(StaticFiles):
    """Files with the headers by which browsers keep them: for ever under the present version, and else not unasked."""

    def file_response(
        self, full_path: str | PathLike[str], stat_result: stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """The answer with a file. It has no ETag, because answers with an ETag differ from caller to caller."""
        answer = super().file_response(full_path, stat_result, scope, status_code)
        del answer.headers["ETag"]
        present = scope["path_params"].get("of_version") == version()
        answer.headers["Cache-Control"] = FOR_EVER if present else "no-cache"
        return answer


def install(app: FastAPI) -> None:
    """Serve the files. A page of an earlier version gets the present file."""
    own = _Files(packages=[(__package__, folder) for folder in FOLDERS])
    app.mount("/static/{of_version}", GZipMiddleware(own))
    app.mount("/docs", _Files(packages=[("fastapi_swagger", "resources")]))


@cache
def assets() -> dict[str, Path]:
    """All files by their names."""
    folders = (Path(str(files(__package__))) / folder for folder in FOLDERS)
    return {path.name: path for folder in folders for path in sorted(folder.iterdir())}


@cache
def version() -> str:
    """The hash of all files."""
    said = [(name, hashlib.sha256(path.read_bytes()).hexdigest()) for name, path in assets().items()]
    return hashlib.sha256(repr(said).encode()).hexdigest()[:12]


def address(name: str) -> str:
    """The address of a file. Raises KeyError for an unknown name."""
    assert assets()[name]
    return f"/static/{version()}/{name}"
