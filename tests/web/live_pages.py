"""Live pages of generated hands, with their ground truth as detections."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from live_server import wait_until

from annotator.rcv.finish import FrameProposals
from annotator.recordings import open_recording
from annotator.types import Box2D, Frame, OrientedBox, Proposal, Quality
from annotator.web.live import LivePage, live_app
from annotator.web.security import ServerSettings
from annotator.web.serve import Running
from annotator.workflows.live.detection import Detected, Taken
from annotator.workflows.live.open_source import Playback, Repeat
from annotator.workflows.live.pipeline import Pipeline
from annotator.workflows.recorded.reading import load_truth


def detections(frame: Frame, *boxes: OrientedBox) -> FrameProposals:
    quality = Quality(0.0, 1.0, 0.0)
    proposals = [Proposal("hand", 0.8, box, Box2D("hand", 40.0, 60.0, 120.0, 150.0, 0.9), (), quality) for box in boxes]
    return FrameProposals(frame.key, tuple(proposals), ())


class TruthDetection:
    """A detection that returns the ground truth."""

    def __init__(self, folder: Path) -> None:
        self.recording = open_recording(folder)

    def detect(self, taken: Taken) -> Detected:
        truths = load_truth(self.recording, taken.frame.index, taken.frame)
        answer = detections(taken.frame, *(truth.box for truth in truths))
        return Detected(taken.frame, answer, taken.taken_s, {"read": taken.read_s, "views": 0.001})


@contextmanager
def served(settings: ServerSettings, folder: Path) -> Iterator[tuple[str, Pipeline, LivePage]]:
    """Serves a live page that runs until the block is left."""
    page = LivePage("hands", {"backend": "truth"})
    pipeline = Pipeline(
        Playback(open_recording(folder), rate=4.0, repeat=Repeat.BACK), TruthDetection(folder), page.show
    )
    page.follow(pipeline)
    server = Running(settings, live_app(settings, page))
    thread = threading.Thread(target=server.serve_until_stopped)
    thread.start()
    pipeline.start()
    try:
        wait_until(lambda: server.started and pipeline.figures().shown)
        yield f"http://127.0.0.1:{server.port}", pipeline, page
    finally:
        server.should_exit = True
        thread.join(20)
        pipeline.end()
        page.close()
