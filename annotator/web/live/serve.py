"""Serves the live page for as long as its pipeline runs."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from fastapi import FastAPI, Request, Response, WebSocket

from annotator.web.live.view import LiveView
from annotator.web.security import Guard, check_settings, link
from annotator.web.serve import Running, with_token
from annotator.web.settings import ServerSettings
from annotator.web.viewport.proxy import forward_http, forward_socket
from annotator.workflows.live.pipeline import Pipeline


def live_app(settings: ServerSettings, view: LiveView) -> FastAPI:
    """The way to the view's own server, behind the same guard as the workbench.

    Raises:
        ConfigError: anybody could come in.
    """
    check_settings(settings)
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

    @app.get("/{path:path}")
    async def file(path: str, request: Request) -> Response:
        return await forward_http(request, view, path)

    @app.websocket("/")
    async def socket(browser: WebSocket) -> None:
        await forward_socket(browser, view)

    app.add_middleware(Guard, settings=settings)
    return app


def serve_live(settings: ServerSettings, view: LiveView, pipeline: Pipeline) -> None:
    """Runs a pipeline and serves its view until the pipeline ends, or is interrupted; says where on standard output.

    Raises:
        ConfigError: the address cannot be used.
        AnnotatorError: why the pipeline failed.
    """
    settings = with_token(settings)
    server = Running(settings, live_app(settings, view))

    def stop_serving() -> None:
        server.should_exit = True

    view.follow(pipeline)
    pipeline.at_end(stop_serving)
    sys.stdout.write(f"live at {link(server.address, settings.token)}\nstop it with Ctrl-C\n")
    sys.stdout.flush()
    with _terminated_as_interrupted():
        try:
            # the last Ctrl-C is how it ends, and no accident
            with suppress(KeyboardInterrupt):
                pipeline.start()
                server.serve_until_stopped()
        finally:
            pipeline.end()


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM (`kill`, a service manager, a container that is stopped) is as Ctrl-C: what was recorded is to be kept.

    The web server ends in order on either, and then raises it anew. Further ones change nothing: it is ending already.
    """
    ending = False

    def interrupt(number: int, stack: FrameType | None) -> None:
        nonlocal ending
        if not ending:
            ending = True
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # no other one may ask for signals
        yield
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before if before is not None else signal.SIG_DFL)
