"""The routes of the service, prepared once for all applications of a process.

FastAPI prepares the routes of a router, with their models, when an application matches its first request: a tenth to
half a second for each of a thousand applications that tests make. The routers are the same modules each time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from fastapi import APIRouter, FastAPI
from starlette.routing import BaseRoute

INCLUDE = FastAPI.include_router


@contextmanager
def shared_routes() -> Iterator[None]:
    """While this context is active, an application takes over the routes that an earlier one made of the same
    router."""
    made: dict[int, tuple[APIRouter, list[BaseRoute]]] = {}

    def include(app: FastAPI, router: APIRouter) -> None:
        _, earlier = made.get(id(router), (router, None))
        before = len(app.router.routes)
        INCLUDE(app, router)
        if earlier is None:  # the router is kept too, so that no other gets its id
            made[id(router)] = (router, app.router.routes[before:])
        else:
            app.router.routes[before:] = earlier

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(FastAPI, "include_router", include)
        yield
