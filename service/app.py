"""The web application: its routers, its middlewares, and the objects that it makes at its start and keeps until it ends."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
from fastapi import FastAPI

from psfcore.fits.viewing.planes import Planes
from service import api_page, operation
from service.api import (
    bulk,
    bulk_results,
    estimates,
    events,
    images,
    jobs,
    keys,
    lineage,
    owner_events,
    products,
    reports,
    resumable,
    transits,
)
from service.api.files import headers, pixels
from service.api.psfs import affected, contexts, series
from service.api.psfs import choice as psf_choice
from service.api.psfs import curves as psf_queries
from service.api.psfs import status as psf_status
from service.api.psfs import versions as psfs
from service.http import description, guard, observation, problems
from service.http.access import Access
from service.http.bodies import BodyLimits
from service.http.rates import AtOnce, Rates
from service.http.state import State
from service.pages import archive_runs as archive_run_pages
from service.pages import assets, login, visitors
from service.pages import bulk as bulk_pages
from service.pages import image as image_page
from service.pages import images as image_pages
from service.pages import jobs as job_pages
from service.pages import keys as key_pages
from service.pages import products as product_pages
from service.pages import transits as transit_pages
from service.pages.errors import problem_page
from service.pages.psfs import comparison as psf_comparison
from service.pages.psfs import listing as psf_listing
from service.pages.psfs import version as psf_page
from service.pages.reports import shown as report_page
from service.vo import cutouts, interfaces, links, lists
from service.vo import jobs as uws
from workers import traces
from workers.catalogue.catalogue import Catalogue
from workers.files.modes import private_folder
from workers.files.opened import open_store
from workers.settings import Settings, software_version

CUTOUTS_AT_ONCE = 2
DECODED_AT_ONCE = 2
INSPECTED_AT_ONCE = 2


def create_app(settings: Settings, bound_to: str = "127.0.0.1") -> FastAPI:
    """Make the application for these settings. When it starts, it upgrades the tables of the database and starts the reconciler.

    bound_to: the address on which it listens. If the settings do not say whether requests need a key, this address decides.
    """
    access, rates = Access.of(settings, bound_to), Rates(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        # Celery is imported only here: the import takes half a second, and writing the OpenAPI description does not need it.
        from workers.broker import app as queue
        from workers.broker.reconciler import Reconciler

        traces.configure(settings, "server")
        private_folder(settings.data_dir)
        catalogue = Catalogue(settings.catalogue_url)
        catalogue.upgrade()
        store = open_store(settings)
        store.sweep()
        reconciler = Reconciler(catalogue, queue.make_app(settings), settings)
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
            cutouts=anyio.CapacityLimiter(CUTOUTS_AT_ONCE),
            decoding=anyio.CapacityLimiter(DECODED_AT_ONCE),
            inspecting=anyio.CapacityLimiter(INSPECTED_AT_ONCE),
            planes=Planes(store.temporary),
        )
        reconciler.start()
        yield
        reconciler.stop()
        catalogue.close()
        traces.shutdown()

    app = FastAPI(
        title="heliopsf",
        version=software_version(),
        summary="Point-spread functions of solar EUV telescopes, and deconvolved images.",
        lifespan=lifespan,
        docs_url=None,  # FastAPI's pages load scripts from other hosts; service.api_page serves a page without them
        redoc_url=None,
    )
    problems.install(app, problem_page)
    visitors.install(app)
    description.install(app)
    guard.install(app, access, BodyLimits.of(settings), problem_page)
    app.state.requests = observation.install(app)
    # psf_choice comes before psfs, so that "best" is not taken for an id.
    versions = (psf_choice, psf_status, series, contexts, affected, lineage)
    for part in (
        *versions,
        images,
        transits,
        jobs,
        estimates,
        psfs,
        psf_queries,
        products,
        pixels,
        headers,
        reports,
        resumable,
        bulk,
        bulk_results,
        events,
        owner_events,
        keys,
        uws,
        interfaces,
        lists,
        links,
        cutouts,
        operation,
        api_page,
        assets,
        image_pages,
        image_page,
        job_pages,
        product_pages,
        archive_run_pages,
        bulk_pages,
        psf_listing,
        psf_comparison,
        psf_page,
        transit_pages,
        report_page,
        login,
        key_pages,
    ):
        app.include_router(part.router)
    return app
