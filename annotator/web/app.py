"""The FastAPI application: routes, error handlers and static files."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import import_module

from fastapi import FastAPI

from annotator import __version__
from annotator.web.background import AutomaticBackups, Learner, StepAside, Watch, preload
from annotator.web.context import Context
from annotator.web.errors import ErrorAnswer, add_error_handlers
from annotator.web.fairness import Fair
from annotator.web.leftovers import clear_leftovers
from annotator.web.security import Guard, check_settings
from annotator.web.settings import ServerSettings
from annotator.web.static import add_static

# Modules of `annotator.web.routes`; each defines `router`.
ROUTES: tuple[str, ...] = (
    "session",
    "sheets",
    "projects",
    "classes",
    "recordings",
    "bags",
    "boxes",
    "frames",
    "label",
    "review",
    "tracks",
    "queue",
    "alignment",
    "reports",
    "images",
    "jobs",
    "models",
    "events",
    "viewport",
)


def create_app(settings: ServerSettings) -> FastAPI:
    """The application of one server.

    Raises:
        ConfigError: the page's files are missing, or the server would be open to the network without a token.
    """
    check_settings(settings)
    context = Context(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        clear_leftovers(settings.projects_root)
        watch = Watch(context, Learner(context.jobs))
        watch.start()
        backups = AutomaticBackups(context)
        backups.start()
        context.jobs.start()
        preload()
        yield
        watch.close()
        backups.close()
        context.close()

    app = FastAPI(
        title="annotator",
        version=__version__,
        openapi_url="/api/openapi.json",
        docs_url=None,
        redoc_url=None,
        responses={"4XX": {"model": ErrorAnswer, "description": "The problem, and what to do."}},
        lifespan=lifespan,
    )
    app.state.context = context
    add_error_handlers(app)
    for name in ROUTES:
        app.include_router(import_module(f"annotator.web.routes.{name}").router)
    add_static(app)
    app.add_middleware(StepAside, jobs=context.jobs)
    app.add_middleware(Fair)
    # added last, so that it is the first to see a request
    app.add_middleware(Guard, settings=settings)
    return app
