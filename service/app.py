"""The web application: its routers, its middlewares, and the objects that it makes at its start and keeps until it
ends.
"""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI

from psfcore import limited
from psfcore.fits.viewing.planes import Planes
from service import operation
from service.api import (
    bulk,
    events,
    images,
    jobs,
    keys,
    pixels,
    psf_curves,
    psf_versions,
    psfs,
    resumable,
    transits,
)
from service.http import guard, observation, problems
from service.http.gate import Gate
from service.http.rates import AtOnce, Rates
from service.http.state import Access, State
from service.pages import assets, login
from service.pages import bulk as bulk_pages
from service.pages import images as image_pages
from service.pages import jobs as job_pages
from service.pages import psfs as psf_pages
from service.pages import transits as transit_pages
from service.pages.rendering import problem_page
from service.vo import interfaces, links, lists
from service.vo import jobs as uws
from workers import traces
from workers.catalogue.catalogue import Catalogue
from workers.contract.requests import FEWEST_DIGITS
from workers.files.modes import private_folder
from workers.files.store import open_store
from workers.settings import Settings, software_version

SHORT = re.compile(r"\^\[0-9a-f\]\{(32|64)\}\$")
PROBLEM = f"#/components/schemas/{problems.ProblemDocument.__name__}"
AT_ONCE = 3  # works behind a gate; one owner alone gets all places but one
STORED_AT_ONCE = 8  # most of them wait for the store


def create_app(settings: Settings, bound_to: str = "127.0.0.1") -> FastAPI:
    """Make the application for these settings. When it starts, it upgrades the tables of the database and starts the
    reconciler.

    Parameters
    ----------
    bound_to
        The address on which the application listens. If the settings do not say whether requests need a key, this
        address decides.
    """
    access, rates = Access.of(settings, bound_to), Rates(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        # Celery is imported only here: the import takes half a second, and writing the OpenAPI description does not
        # need it.
        from workers.broker import app as queue
        from workers.broker.reconciler import Reconciler

        traces.configure(settings, "server")
        private_folder(settings.data_dir)
        catalogue = Catalogue(settings.catalogue_url)
        catalogue.upgrade()
        store = open_store(settings, within_requests=True)
        store.sweep()
        reconciler = Reconciler(catalogue, store, queue.make_app(settings), settings)
        streams = AtOnce(settings.streams_per_caller, "too-many-streams", "streams of events")
        requests = AtOnce(settings.requests_per_caller, "too-many-requests-at-once", "requests")
        app.state.heliopsf = State(
            settings,
            catalogue,
            store,
            reconciler,
            access,
            rates,
            streams,
            requests,
            pixels=Gate(AT_ONCE),
            stored=Gate(STORED_AT_ONCE),
            planes=Planes(store.temporary),
        )
        reconciler.start()
        limited.prepare()  # the first upload does not wait for it
        yield
        reconciler.stop()
        catalogue.close()
        traces.shutdown()

    app = FastAPI(
        title="heliopsf",
        version=software_version(),
        summary="Point-spread functions of solar EUV telescopes, and deconvolved images.",
        lifespan=lifespan,
        docs_url=None,  # FastAPI's pages load scripts from other hosts; service.pages.assets serves a page without them
        redoc_url=None,
    )
    problems.install(app, problem_page)
    login.install(app)
    assets.install(app)
    _correct_description(app)
    guard.install(app, access, settings, problem_page)
    app.state.requests = observation.install(app)
    routers = (
        psfs.choosing,  # before psfs.router, so that "best" is not taken for an id
        psf_versions.router,
        psf_versions.series,
        psf_versions.contexts,
        psf_versions.affected,
        images.lineages,
        images.router,
        transits.router,
        jobs.router,
        jobs.estimating,
        psfs.router,
        psf_curves.router,
        images.products,
        pixels.router,
        pixels.headers,
        transits.reports,
        resumable.router,
        bulk.router,
        events.router,
        keys.router,
        uws.router,
        interfaces.router,
        lists.router,
        links.router,
        links.cutouts,
        operation.router,
        image_pages.router,
        job_pages.router,
        image_pages.products,
        bulk_pages.router,
        psf_pages.router,
        transit_pages.router,
        transit_pages.reports,
        login.router,
        login.keys,
    )
    for router in routers:
        app.include_router(router)
    return app


def _correct_description(app: FastAPI) -> None:
    """Correct the OpenAPI description, because the framework describes some answers wrongly: errors are problem
    documents on every route, and ids in addresses may be shortened.
    """
    generate = app.openapi

    def openapi() -> dict[str, object]:
        if app.openapi_schema is None:
            _correct(generate())
        assert app.openapi_schema is not None
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's way to extend its description


def _correct(description: dict[str, Any]) -> None:
    for operations in description["paths"].values():
        for one in operations.values():
            for parameter in one.get("parameters", ()):
                _shorten(parameter)
            for response in one["responses"].values():
                content = response.get("content", {})
                if content.get("application/json", {}).get("schema", {}).get("$ref") == PROBLEM:
                    content[problems.MEDIA_TYPE] = content.pop("application/json")


def _shorten(parameter: dict[str, Any]) -> None:
    """Describe an id in a path: the first digits of the id are accepted too, see ``service.http.callers``."""
    whole = SHORT.fullmatch(parameter["schema"].get("pattern", ""))
    if parameter["in"] == "path" and whole is not None:
        parameter["schema"]["pattern"] = f"^[0-9a-f]{{{FEWEST_DIGITS},{whole[1]}}}$"
        parameter["description"] = (
            f"an id, or its first {FEWEST_DIGITS} or more digits if no other id begins with them"
        )
