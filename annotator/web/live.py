"""A live session: from the source to the live page, and optionally into the project."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import numpy as np
from fastapi import FastAPI, Request, Response, WebSocket
from jaxtyping import UInt8

from annotator.detection.config import Backend
from annotator.project import Project
from annotator.rcv.finish import FrameProposals
from annotator.types import Frame, ReviewState
from annotator.types.messages import amount
from annotator.web.limits import limited_log
from annotator.web.security import Guard, ServerSettings, check_settings
from annotator.web.serve import Running
from annotator.web.viewport.drawing import SceneContent, ShownBox
from annotator.web.viewport.guides import Look
from annotator.web.viewport.scene import Scene
from annotator.web.viewport.viser_page import ViserPage, forward_http, forward_socket
from annotator.workflows.detectors import active_detectors, stand_in
from annotator.workflows.drawn_boxes import Canvas
from annotator.workflows.live.detection import Detected, LiveDetection
from annotator.workflows.live.open_source import open_source
from annotator.workflows.live.pipeline import Figures, Pipeline
from annotator.workflows.live.recorder import Recorder, Stored, require_unused_path, store
from annotator.workflows.settings import rcv_config

if TYPE_CHECKING:
    import viser


@contextmanager
def sigterm_as_interrupt() -> Iterator[Callable[[], None]]:
    """In this context, SIGTERM (from `kill`, a service manager or a stopped container) ends a session like Ctrl-C.

    Both raise KeyboardInterrupt. From the first SIGTERM on, or after a call of the function that the context yields,
    further ones are ignored, since the recording is being stored. A further Ctrl-C interrupts the storing, too.
    """
    # only the main thread may set signal handlers
    is_main = threading.current_thread() is threading.main_thread()

    def ignore() -> None:
        if is_main:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)

    def interrupt(number: int, stack: FrameType | None) -> None:
        ignore()
        raise KeyboardInterrupt

    former = signal.signal(signal.SIGTERM, interrupt) if is_main else None
    try:
        yield ignore
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, former if former is not None else signal.SIG_DFL)


# About the width of the panel beside the 3D view, pixels.
WIDTH_PX = 640
BOX_COLOR, SOLID_COLOR, LOST_COLOR = (255, 214, 10), (240, 120, 40), (154, 161, 173)


def draw_detections(frame: Frame, detections: FrameProposals, width_px: int = WIDTH_PX) -> UInt8[np.ndarray, "h w 3"]:
    """The image, at most `width_px` wide, with the image detector's boxes, and the 3D boxes with their headings.

    Image boxes without a 3D box are grey.
    """
    canvas = Canvas(frame.rgb, min(width_px / frame.camera.width_px, 1.0))
    for lost in detections.lost:
        canvas.box(lost.image_box, LOST_COLOR, lost.label)
    for proposal in detections.proposals:
        canvas.box(proposal.image_box, BOX_COLOR, f"{proposal.label} {proposal.score:.2f}")
        canvas.solid(frame.camera, proposal.box, SOLID_COLOR)
    return canvas.rgb


# Limit of shown points, which are sent many times per second.
MOST_POINTS = 40_000
# Factor of the default point size, which is too large for near objects in a thinned cloud.
POINT_SIZE = 0.7
JPEG_QUALITY = 75
# Minimum interval between updates of the figures, seconds.
FIGURES_EVERY_S = 0.5
# Width of the panel with the image and the figures.
PANEL_PX = 440
SCENE_KEY = ("live", 0)


class LivePage(ViserPage):
    """The live page; `show` must be called from one thread."""

    def __init__(self, source: str, facts: Mapping[str, str]) -> None:
        """
        Args:
            source: description of the source, for people.
            facts: constant rows of the table of figures, such as the backend.
        """
        super().__init__("live")
        self._facts, self._figures_at_s = facts, 0.0
        self._pipeline: Pipeline | None = None
        self._scene = Scene(self._server, _ignored, _ignored)
        self._reset_camera = threading.Event()
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        gui.set_panel_label(f"annotator live: {source}")
        self._image: viser.GuiImageHandle | None = None
        self._text = gui.add_markdown("waiting for the first frame", order=2.0)
        self._pause = gui.add_button("Pause", order=3.0)
        look = gui.add_button("Look from the camera", order=4.0)

        @look.on_click
        def _(_: object) -> None:
            self._reset_camera.set()

    def follow(self, pipeline: Pipeline) -> None:
        """Shows a pipeline's figures beside the image, and connects the pause button to it."""
        self._pipeline = pipeline

        @self._pause.on_click
        def _(_: object) -> None:
            pipeline.pause(not pipeline.is_paused)
            self._pause.label = "Resume" if pipeline.is_paused else "Pause"

    def show(self, detected: Detected) -> None:
        """Shows one frame, in place of the previous one."""
        boxes = tuple(ShownBox(None, proposal.box, ReviewState.PROPOSED) for proposal in detected.found.proposals)
        look = Look.START if self._reset_camera.is_set() else None
        self._reset_camera.clear()
        content = SceneContent(
            SCENE_KEY, detected.frame, boxes, most_points=MOST_POINTS, point_size=POINT_SIZE, look=look
        )
        self._scene.show(content)
        image = draw_detections(detected.frame, detected.found)
        if self._image is None:
            self._image = self._server.gui.add_image(image, format="jpeg", jpeg_quality=JPEG_QUALITY, order=1.0)
        else:
            self._image.image = image
        now = time.monotonic()
        if self._pipeline is not None and now - self._figures_at_s >= FIGURES_EVERY_S:
            self._figures_at_s = now
            self._text.content = table(detected, self._pipeline.figures(), self._facts)


def table(detected: Detected, figures: Figures, facts: Mapping[str, str]) -> str:
    """The figures as Markdown."""
    stages = " · ".join(f"{name} {ms:.0f}" for name, ms in figures.stages_ms.items())
    drops = " · ".join(f"{name} {count}" for name, count in figures.drops.items() if count)
    objects = f"{len(detected.found.proposals)}" + (f", {lost} lost" if (lost := len(detected.found.lost)) else "")
    rows = {
        "frame": f"{detected.frame.key} ({figures.shown} shown)",
        "objects": objects,
        "frames/s": "-" if figures.fps is None else f"**{figures.fps:.1f}**",
        "latency": "-"
        if figures.latency_ms is None
        else f"**{figures.latency_ms:.0f} ms**, 95 %: {figures.latency_p95_ms:.0f} ms",
        "stages, ms": stages or "-",
        "dropped": drops or "none",
        **({"unreadable": str(figures.broken)} if figures.broken else {}),
        **facts,
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


async def _ignored(event: object) -> None:
    """The live page has no gizmo."""


# Maximum number of unreadable frames that are logged one by one.
MOST_LOGGED = 10


@dataclass(frozen=True)
class LiveOptions:
    """Options of a live session.

    Attributes:
        source: as in `open_source`.
        rate, loop: playback options of a recording.
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


def run_live(
    project: Project,
    options: LiveOptions,
    settings: ServerSettings,
    *,
    report: Callable[[str], None],
) -> tuple[Figures, Stored | None]:
    """Detects and shows frames until the source ends or is interrupted. The recording is kept even after an error.

    Returns:
        the final figures of the session, and the summary of its recording in the project.
    """
    check_settings(settings)
    if options.record is not None:
        require_unused_path(project, options.record)
    # opened before the detectors are loaded, which takes seconds, so that an invalid source is reported at once
    with (
        closing(
            open_source(
                project, options.source, rate=options.rate, loop=options.loop, to_record=options.record is not None
            )
        ) as source,
        sigterm_as_interrupt() as ignore_sigterm,
    ):
        detectors, warm = active_detectors(project, backend=options.backend), options.warm_start
        rotation = project.config.settings.rotation
        detection = LiveDetection(detectors, rcv_config(project), rotation, warm_start=warm)
        facts = {"backend": detectors.backends[1] or options.backend, "warm start": "on" if warm else "off"}
        if named := stand_in(project):
            report(f"view detector: {named}")
            facts["view detector"] = named

        def show(recorder: Recorder | None) -> Figures:
            with closing(LivePage(source.name, facts)) as page:
                pipeline = Pipeline(
                    source, detection.detect, page.show, record=recorder, max_frames=options.frames, report=_few(report)
                )
                serve_live(settings, page, pipeline, ignore_sigterm)
                return pipeline.figures()

        if options.record is None:
            return show(None), None
        with closing(Recorder(options.record, report)) as recorder:
            facts["recording"] = recorder.out.name
            stored = None
            try:
                figures = show(recorder)
            finally:
                if frames := recorder.finish():
                    report(f"storing the detections of {amount(frames, 'frame')} in {recorder.out}")
                    stored = store(project, recorder, detectors, detection.config, rotation, warm_start=warm)
            recorder.require_complete()
            return figures, stored


def _few(report: Callable[[str], None]) -> Callable[[str], None]:
    """Reports the first `MOST_LOGGED` unreadable frames; the figures count all of them."""
    left = count(MOST_LOGGED, -1)

    def tell(line: str) -> None:
        if (remaining := next(left)) > 0:
            report(line if remaining > 1 else f"{line}\nfurther unreadable frames are only counted")

    return tell


def live_app(settings: ServerSettings, page: LivePage) -> FastAPI:
    """An application that forwards requests to the page's viser server, with the same checks as the workbench."""
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


def serve_live(
    settings: ServerSettings, page: LivePage, pipeline: Pipeline, ignore_sigterm: Callable[[], None]
) -> None:
    """Runs a pipeline and serves its page until the pipeline ends or is interrupted; prints the URL.

    Args:
        ignore_sigterm: of a context that the caller has entered, and leaves after storing a recording.
    """
    server = Running(settings, live_app(settings, page))

    page.follow(pipeline)
    pipeline.on_end = server.stop
    sys.stdout.write(f"live at {server.link()}\nstop it with Ctrl-C\n")
    sys.stdout.flush()
    try:
        # Ctrl-C is the regular end of a session
        with suppress(KeyboardInterrupt), limited_log(None):
            try:
                # in a thread, which no interrupt reaches: all threads of the pipeline are started
                starting = threading.Thread(target=pipeline.start)
                starting.start()
                starting.join()
                # on either signal, uvicorn shuts down and then raises the signal again
                server.serve_until_stopped()
            finally:
                ignore_sigterm()
    finally:
        pipeline.end()
