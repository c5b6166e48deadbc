"""Serves the live page for as long as its pipeline runs."""

from __future__ import annotations

import sys
from contextlib import suppress

from fastapi import FastAPI, Request, Response, WebSocket

from annotator.web.live.interrupts import Interrupts
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


def serve_live(settings: ServerSettings, view: LiveView, pipeline: Pipeline, interrupts: Interrupts) -> None:
    """Runs a pipeline and serves its view until the pipeline ends, or is interrupted; says where on standard output.

    Args:
        interrupts: entered by the caller, who may have something to store afterwards.

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
    try:
        # the last Ctrl-C is how it ends, and no accident
        with suppress(KeyboardInterrupt), interrupts.ended_by():
            with interrupts.held():  # of a pipeline all threads are started, or none
                pipeline.start()
            # it ends in order on both signals, and then raises them anew
            server.serve_until_stopped()
    finally:
        pipeline.end()
