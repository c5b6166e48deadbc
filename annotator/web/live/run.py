"""A whole live session: from the source to the page and, where asked, into the project."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from annotator.detection.config import Backend
from annotator.project import Project
from annotator.web.live.interrupts import Interrupts
from annotator.web.live.serve import serve_live
from annotator.web.live.view import LiveView
from annotator.web.security import check_settings
from annotator.web.serve import with_token
from annotator.web.settings import ServerSettings
from annotator.workflows.detectors import active_detectors
from annotator.workflows.live.detection import LiveDetection
from annotator.workflows.live.figures import Figures
from annotator.workflows.live.keep import Stored, require_unknown, store
from annotator.workflows.live.pipeline import Pipeline
from annotator.workflows.live.recorder import Recorder
from annotator.workflows.live.source import Source
from annotator.workflows.live.sources import open_source
from annotator.workflows.rcv_settings import rcv_config

# Frames that cannot be read and are told one by one.
MOST_TOLD = 10


@dataclass(frozen=True)
class LiveOptions:
    """What is seen, and how.

    Attributes:
        source: as of `open_source`.
        rate, loop: of a recording.
        backend: what runs the detectors.
        warm_start: begin each recursion with the boxes of the frame before.
        frames: end after so many of the source; None = with it.
        record: keep what was seen here, and in the project.
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
    """How it went: the figures at the end, and what the project got, where it was recorded."""

    figures: Figures
    stored: Stored | None


def run_live(
    project: Project,
    options: LiveOptions,
    settings: ServerSettings,
    *,
    tell: Callable[[str], None],
) -> LiveResult:
    """Detects and shows until the source ends, or until interrupted.

    What was recorded is kept whatever has ended it.

    Args:
        tell: gets a line on what is told while it runs.

    Raises:
        AnnotatorError: of the source, the detectors, the recording or the address; nothing has begun where they cannot
            be used.
    """
    settings = with_token(settings)
    check_settings(settings)
    if options.record is not None:
        require_unknown(project, options.record)
    # before the detectors, which take seconds: whether there is such a source is known at once
    source = open_source(options.source, rate=options.rate, loop=options.loop, to_record=options.record is not None)
    try:
        with Interrupts() as interrupts:
            return _run(project, options, settings, source, tell, interrupts)
    finally:
        source.close()


def _run(
    project: Project,
    options: LiveOptions,
    settings: ServerSettings,
    source: Source,
    tell: Callable[[str], None],
    interrupts: Interrupts,
) -> LiveResult:
    detectors = active_detectors(project, backend=options.backend)
    rotation = project.config.settings.rotation
    detection = LiveDetection(detectors, rcv_config(project), rotation, warm_start=options.warm_start)
    backend = detectors.backends[1] or options.backend
    if options.record is None:
        return LiveResult(_show(options, settings, source, detection, None, backend, tell, interrupts), None)
    with Recorder(options.record, tell) as recorder:
        stored = None
        try:
            figures = _show(options, settings, source, detection, recorder, backend, tell, interrupts)
        finally:
            if frames := recorder.finish():
                tell(f"storing what was found on the {frames} frames of {recorder.out}")
                warm_start = options.warm_start
                stored = store(project, recorder, detectors, detection.config, rotation, warm_start=warm_start)
        recorder.require_whole()
        return LiveResult(figures, stored)


def _show(
    options: LiveOptions,
    settings: ServerSettings,
    source: Source,
    detection: LiveDetection,
    recorder: Recorder | None,
    backend: str,
    tell: Callable[[str], None],
    interrupts: Interrupts,
) -> Figures:
    facts = {"backend": backend, "warm start": "on" if options.warm_start else "off"}
    if recorder is not None:
        facts["recording"] = recorder.out.name
    view = LiveView(source.name, facts)
    try:
        pipeline = Pipeline(source, detection, view.show, keep=recorder, most_frames=options.frames, tell=_Broken(tell))
        serve_live(settings, view, pipeline, interrupts)
        return pipeline.figures()
    finally:
        view.close()


class _Broken:
    """Tells of the first frames that cannot be read; the rest is only counted, in the figures."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell, self._left = tell, MOST_TOLD

    def __call__(self, line: str) -> None:
        if self._left:
            self._left -= 1
            self._tell(line)
            if not self._left:
                self._tell("further ones are counted only")
