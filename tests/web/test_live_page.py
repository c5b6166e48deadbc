"""The live page: access, the drawn detections, and the table of figures."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path

import httpx
import numpy as np
import pytest
import viser
from live_server import wait_until
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.projection import project
from annotator.rcv.finish import FrameProposals
from annotator.recordings import open_recording
from annotator.types import Box2D, Frame, LostObject, OrientedBox, Proposal, Quality
from annotator.web.live import BOX_COLOR, LOST_COLOR, LivePage, draw_detections, live_app, sigterm_as_interrupt
from annotator.web.security import ServerSettings
from annotator.web.serve import Running
from annotator.workflows.live.detection import Detected, Taken
from annotator.workflows.live.open_source import Playback
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
    playback = Playback(open_recording(folder), rate=4.0, order=cycle((0, 1, 2, 3, 4, 3, 2, 1)))
    pipeline = Pipeline(playback, TruthDetection(folder).detect, page.show)
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


@pytest.fixture(scope="module")
def frame(generated: Path) -> Frame:
    return open_recording(generated / "hands").frame(0)


def test_only_pages_of_this_server_may_connect(generated: Path, tmp_path: Path) -> None:
    with served(ServerSettings(tmp_path, port=0), generated / "hands") as (url, _, page):
        answer = httpx.get(url, timeout=240)
        assert answer.status_code == 200
        assert "<html" in answer.text
        assert "frame-ancestors 'self'" in answer.headers["content-security-policy"]
        assert httpx.get(url, headers={"Host": "evil.example"}, timeout=240).status_code == 403
        socket = url.replace("http", "ws")
        for origin in ("http://evil.example", None):
            with pytest.raises(InvalidStatus, match="403"):
                connect(socket, origin=None if origin is None else Origin(origin)).close()
        with pytest.raises(InvalidStatus):  # bypassing the guard
            connect(f"ws://127.0.0.1:{page.port}", origin=Origin(url)).close()
        with connect(
            socket, origin=Origin(url), subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None
        ) as browser:
            received = b"".join(part for part in (browser.recv(20) for _ in range(3)) if isinstance(part, bytes))
            assert received


def test_the_page_shows_each_frame_and_its_button_pauses(generated: Path, tmp_path: Path, frame: Frame) -> None:
    page = LivePage("hands", {"backend": "none"})
    pipeline = Pipeline(
        Playback(open_recording(generated / "hands")), TruthDetection(generated / "hands").detect, page.show
    )
    page.follow(pipeline)
    try:
        box = load_truth(open_recording(generated / "hands"), 0, frame)[0].box
        page.show(Detected(frame, detections(frame, box), time.perf_counter(), {}))
        scene = page._server.scene
        assert len(scene.get_handle_by_name("/cloud").points) == 40_000
        assert len(scene.get_handle_by_name("/boxes").points) == 21, "edges, shaft and head of the heading"
        assert page._image is not None
        assert page._image.image.shape == (240, 320, 3)
        assert "| backend | none |" in page._text.content
        page.show(Detected(frame, detections(frame), time.perf_counter(), {}))
        assert scene.get_handle_by_name("/boxes") is None
        for label, paused in (("Resume", True), ("Pause", False)):
            for press in page._pause._impl.update_cb:
                press(None)  # type: ignore[arg-type]
            assert (page._pause.label, pipeline.is_paused) == (label, paused)
    finally:
        page.close()


def test_boxes_are_drawn_at_their_pixels(frame: Frame) -> None:
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 1.0]), np.eye(3), np.array([0.2, 0.2, 0.2]))
    answer = detections(frame, box)
    lost = LostObject("hand", Box2D("hand", 200.0, 100.0, 300.0, 200.0), ())
    drawn = draw_detections(frame, FrameProposals(answer.key, answer.proposals, (lost,)))
    assert drawn.shape == frame.rgb.shape
    changed = (drawn != frame.rgb).any(axis=2)
    for corner in project(frame.camera, box_corners(box)):
        u, v = np.round(corner).astype(int)
        assert changed[v - 1 : v + 2, u - 1 : u + 2].any()
    assert np.abs(drawn[105, 40].astype(int) - BOX_COLOR).max() < 40, "the left edge of the image box"
    assert np.abs(drawn[150, 300].astype(int) - LOST_COLOR).max() < 40, "the right edge of the lost object's box"
    assert changed.mean() < 0.1
    small = draw_detections(frame, answer, width_px=160)
    assert small.shape == (120, 160, 3)
    assert np.abs(small[52, 20].astype(int) - BOX_COLOR).max() < 80


@pytest.fixture
def interrupted() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt, also where the tests run in the background of a shell, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupted")
def test_sigterm_interrupts_once_and_not_after_the_end_of_a_session() -> None:
    before = signal.getsignal(signal.SIGTERM)
    for is_ending in (False, True):
        with sigterm_as_interrupt() as ignore:
            if is_ending:
                ignore()
            else:
                with pytest.raises(KeyboardInterrupt):
                    signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGTERM) == before
