"""The application, put together."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import APIRouter, FastAPI
from pydantic import BaseModel

from service import images, jobs, problems, products, psf_queries, psfs, reports, transits
from service.state import Shared, State
from workers import queue
from workers.catalogue import Catalogue
from workers.reconciler import Reconciler
from workers.settings import Settings, software_version
from workers.store import Store

health = APIRouter(tags=["operation"])


class Health(BaseModel):
    """The process answers, and so does its database."""

    status: str
    version: str


@health.get("/healthz", summary="Is the service up?", responses=problems.RESPONSES)
def healthz(state: Shared) -> Health:
    """200 where the process, its reconciler and its database are up; 503 where one is not."""
    state.catalogue.ping()
    if not state.reconciler.alive:
        raise problems.Problem(
            503, "reconciler-stopped", "queued jobs are not submitted; restart the service"
        )
    return Health(status="ok", version=software_version())


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
    for part in (images, transits, jobs, psfs, psf_queries, products, reports):
        app.include_router(part.router)
    app.include_router(health)
    return app
