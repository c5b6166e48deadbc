"""A live session: from the source to the live page, and optionally into the project."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fastapi import FastAPI, Request, Response, WebSocket

from annotator.detection.config import Backend
from annotator.project import Project
from annotator.types.messages import amount
from annotator.web.limits.log import limited_log
from annotator.web.live.interrupts import Interrupts
from annotator.web.live.page import LivePage
from annotator.web.security import Guard, check_settings
from annotator.web.serve import Running
from annotator.web.settings import ServerSettings
from annotator.web.viewport.proxy import forward_http, forward_socket
from annotator.workflows.detectors import active_detectors, stand_in
from annotator.workflows.live.detection import LiveDetection
from annotator.workflows.live.open_source import open_source
from annotator.workflows.live.pipeline import Pipeline
from annotator.workflows.live.rates import Figures
from annotator.workflows.live.recorder import Recorder
from annotator.workflows.live.source import Source
from annotator.workflows.live.store_session import Stored, require_unused_path, store
from annotator.workflows.settings import rcv_config

# Maximum number of unreadable frames that are logged one by one.
MOST_LOGGED = 10


@dataclass(frozen=True)
class LiveOptions:
    """Options of a live session.

    Attributes:
        source: as in `open_source`.
        rate, loop: playback options of a recording.
        backend: runs the detectors.
        warm_start: start each recursion with the boxes of the previous frame.
        frames: end after this number of frames of the source; None = at its end.
        record: record the session to this path, and add it to the project.
    """

    source: str
    rate: float | None = None
    loop: bool = False
    backend: Backend = "fastest"
    warm_start: bool = True
    frames: int | None = None
    record: Path | None = None


@dataclass(frozen=True)
class LiveResult:
    """The final figures of a session, and the summary of its recording in the project."""

    figures: Figures
    stored: Stored | None


def run_live(
    project: Project,
    options: LiveOptions,
    settings: ServerSettings,
    *,
    report: Callable[[str], None],
) -> LiveResult:
    """Detects and shows frames until the source ends, or until interrupted. The recording is kept even after an error.

    Args:
        report: called with each log line while the session runs.

    Raises:
        AnnotatorError: the source, the detectors, the recording or the address cannot be used, or fail later.
    """
    check_settings(settings)
    if options.record is not None:
        require_unused_path(project, options.record)
    # opened before the detectors are loaded, which takes seconds, so that an invalid source is reported at once
    source = open_source(
        project, options.source, rate=options.rate, loop=options.loop, to_record=options.record is not None
    )
    try:
        with Interrupts() as interrupts:
            return _run(project, options, settings, source, report, interrupts)
    finally:
        source.close()


def _run(
    project: Project,
    options: LiveOptions,
    settings: ServerSettings,
    source: Source,
    report: Callable[[str], None],
    interrupts: Interrupts,
) -> LiveResult:
    detectors = active_detectors(project, backend=options.backend)
    rotation = project.config.settings.rotation
    detection = LiveDetection(detectors, rcv_config(project), rotation, warm_start=options.warm_start)
    facts = {"backend": detectors.backends[1] or options.backend, "warm start": "on" if options.warm_start else "off"}
    if named := stand_in(project):
        report(f"view detector: {named}")
        facts["view detector"] = named
    if options.record is None:
        return LiveResult(_show(options, settings, source, detection, None, facts, report, interrupts), None)
    with Recorder(options.record, report) as recorder:
        stored = None
        try:
            figures = _show(options, settings, source, detection, recorder, facts, report, interrupts)
        finally:
            if frames := recorder.finish():
                report(f"storing the detections of {amount(frames, 'frame')} in {recorder.out}")
                warm_start = options.warm_start
                stored = store(project, recorder, detectors, detection.config, rotation, warm_start=warm_start)
        recorder.require_complete()
        return LiveResult(figures, stored)


def _show(
    options: LiveOptions,
    settings: ServerSettings,
    source: Source,
    detection: LiveDetection,
    recorder: Recorder | None,
    facts: dict[str, str],
    report: Callable[[str], None],
    interrupts: Interrupts,
) -> Figures:
    if recorder is not None:
        facts = facts | {"recording": recorder.out.name}
    page = LivePage(source.name, facts)
    log = _LimitedLog(report)
    try:
        pipeline = Pipeline(source, detection, page.show, record=recorder, max_frames=options.frames, report=log)
        serve_live(settings, page, pipeline, interrupts)
        return pipeline.figures()
    finally:
        page.close()


class _LimitedLog:
    """Logs the first `MOST_LOGGED` unreadable frames; the figures count all of them."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._tell, self._left = report, MOST_LOGGED

    def __call__(self, line: str) -> None:
        if self._left:
            self._left -= 1
            self._tell(line)
            if not self._left:
                self._tell("further unreadable frames are only counted")


def live_app(settings: ServerSettings, page: LivePage) -> FastAPI:
    """An application that forwards requests to the page's viser server, with the same checks as the workbench.

    Raises:
        ConfigError: the server would be open to the network without a token.
    """
    check_settings(settings)
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

    @app.get("/{path:path}")
    async def file(path: str, request: Request) -> Response:
        return await forward_http(request, page, path)

    @app.websocket("/")
    async def socket(browser: WebSocket) -> None:
        await forward_socket(browser, page)

    app.add_middleware(Guard, settings=settings)
    return app


def serve_live(settings: ServerSettings, page: LivePage, pipeline: Pipeline, interrupts: Interrupts) -> None:
    """Runs a pipeline and serves its page until the pipeline ends or is interrupted; prints the URL.

    Args:
        interrupts: a context that the caller has entered, and leaves after storing a recording.

    Raises:
        ConfigError: the address cannot be used.
        AnnotatorError: the reason why the pipeline failed.
    """
    server = Running(settings, live_app(settings, page))

    def stop_serving() -> None:
        server.should_exit = True

    page.follow(pipeline)
    pipeline.at_end(stop_serving)
    sys.stdout.write(f"live at {server.link()}\nstop it with Ctrl-C\n")
    sys.stdout.flush()
    try:
        # Ctrl-C is the regular end of a session
        with suppress(KeyboardInterrupt), limited_log(None), interrupts.session():
            with interrupts.deferred():  # all threads of the pipeline are started, or none
                pipeline.start()
            # on either signal, uvicorn shuts down and then raises the signal again
            server.serve_until_stopped()
    finally:
        pipeline.end()
