"""The FastAPI application: routes, error handlers and static files."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from weakref import WeakValueDictionary

from fastapi import APIRouter, FastAPI
from fastapi.responses import FileResponse
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from annotator import __version__
from annotator.types.errors import ConfigError
from annotator.web.background import AutomaticBackups, Learner, Sights, Watch, preload
from annotator.web.context import Context
from annotator.web.errors import ErrorAnswer, add_error_handlers
from annotator.web.folders import clear_leftovers
from annotator.web.jobs.runner import JobRunner
from annotator.web.routes import alignment, frames, jobs, projects, recordings, review, session, tracks
from annotator.web.security import Guard, ServerSettings, check_settings
from annotator.web.viewport import viewports

PLOTLY = "/assets/vendor/plotly.min.js"


def web_assets() -> Path:
    """The folder `web_assets`: within the package in a wheel, beside it in a clone."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "web_assets", package.parent / "web_assets"):
        if folder.is_dir():
            return folder
    raise ConfigError(f"{package.parent / 'web_assets'}: the page's files are missing; install rcv-annotator again")


def plotly_script() -> Path:
    """The browser script in plotly's Python package."""
    import importlib.util

    spec = importlib.util.find_spec("plotly")
    if spec is None or spec.origin is None:
        raise ConfigError("plotly is not installed; run pip install plotly")
    return Path(spec.origin).parent / "package_data" / "plotly.min.js"


def add_static(app: FastAPI) -> None:
    """Adds GET / for the page, and /assets/... for its files."""
    assets = web_assets()
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    def page() -> FileResponse:
        return FileResponse(assets / "index.html", headers={"Cache-Control": "no-cache"})

    @router.get(PLOTLY)
    def plotly() -> FileResponse:
        return FileResponse(plotly_script(), media_type="text/javascript", headers={"Cache-Control": "max-age=86400"})

    app.include_router(router)
    app.mount("/assets", StaticFiles(directory=assets), name="assets")


# The server has 40 threads (AnyIO's default), and a project 20 connections to its database.
AT_ONCE = 12

_PROJECT = re.compile(r"/api/projects/([^/]+)")


class Fair:
    """ASGI middleware: requests to a project beyond the bound wait in the event loop, not in a thread.

    A job in the background waits while the server answers requests about a frame.
    """

    def __init__(self, app: ASGIApp, jobs: JobRunner) -> None:
        self.app, self._jobs = app, jobs
        # a gate is gone once no request holds it
        self._gates = WeakValueDictionary[str, asyncio.Semaphore]()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on when its project is below the bound."""
        found = _PROJECT.match(scope["path"]) if scope["type"] == "http" else None
        if found is None:
            await self.app(scope, receive, send)
            return
        gate = self._gates.setdefault(found[1], asyncio.Semaphore(AT_ONCE))
        async with AsyncExitStack() as held:
            await held.enter_async_context(gate)
            if "/frames/" in scope["path"]:
                self._jobs.step_aside()

            async def sending(message: Message) -> None:
                # the work is done; a slow download must not count
                await held.aclose()
                await send(message)

            await self.app(scope, receive, sending)


# The modules with routes; each defines `router`.
ROUTES = (session, projects, recordings, frames, review, tracks, alignment, jobs, viewports)


def create_app(settings: ServerSettings) -> FastAPI:
    check_settings(settings)
    context = Context(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        clear_leftovers(settings.projects_root)
        beside = Watch(context, Learner(context.jobs)), AutomaticBackups(context), Sights(context)
        for each in beside:
            each.start()
        context.jobs.start()
        preload()
        yield
        for each in beside:
            each.close()
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
    for module in ROUTES:
        app.include_router(module.router)
    add_static(app)
    app.add_middleware(Fair, jobs=context.jobs)
    # added last, so that it is the first to see a request
    app.add_middleware(Guard, settings=settings)
    return app
