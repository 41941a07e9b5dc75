"""The application, put together."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI

from service import (
    health,
    images,
    jobs,
    metrics,
    observation,
    problems,
    products,
    psf_queries,
    psfs,
    reports,
    transits,
    uws,
)
from service.state import State
from workers import queue
from workers.catalogue import Catalogue
from workers.reconciler import Reconciler
from workers.settings import Settings, software_version
from workers.store import Store


def create_app(settings: Settings) -> FastAPI:
    """An application for these settings; its tables are made, and its reconciler runs, while it lives."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        settings.data_dir.mkdir(parents=True, exist_ok=True)
        catalogue = Catalogue(settings.catalogue_url)
        catalogue.create_tables()
        store = Store(settings.data_dir)
        store.sweep()
        reconciler = Reconciler(catalogue, queue.make_app(settings), settings)
        app.state.heliopsf = State(settings, catalogue, store, reconciler)
        reconciler.start()
        yield
        reconciler.stop()
        catalogue.close()

    app = FastAPI(
        title="heliopsf",
        version=software_version(),
        summary="Point-spread functions of solar EUV telescopes, and images freed of their stray light.",
        lifespan=lifespan,
    )
    problems.install(app)
    app.state.requests = observation.install(app)
    for part in (images, transits, jobs, psfs, psf_queries, products, reports, uws, health, metrics):
        app.include_router(part.router)
    return app
