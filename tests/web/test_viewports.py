"""3D viewports over HTTP, the proxy to their viser servers, and the live page."""

from __future__ import annotations

import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import cycle
from pathlib import Path
from socket import create_connection
from typing import Any
from unittest.mock import Mock

import httpx
import msgspec
import numpy as np
import pytest
import viser
from live_server import PATIENCE_S, wait_until
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.projection import project
from annotator.project.audit.writing import WriteContext
from annotator.project.changes import NewLabel
from annotator.rcv.finish import FrameProposals
from annotator.recordings import open_recording
from annotator.types import Box2D, Frame, LostObject, OrientedBox, Proposal, Quality, ReviewState
from annotator.web.live import BOX_COLOR, LOST_COLOR, LivePage, draw_detections, live_app, sigterm_as_interrupt
from annotator.web.security import ServerSettings
from annotator.web.serve import Running
from annotator.web.viewport.viewports import MOST_PER_OPERATOR, Viewports
from annotator.web.viewport.viser_page import MOST_SILENT, start_viser
from annotator.workflows.live.detection import Detected, Taken
from annotator.workflows.live.open_source import Playback
from annotator.workflows.live.pipeline import Pipeline
from annotator.workflows.recorded.reading import load_truth

PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture
def frame_id(live: Any) -> int:
    """The first frame of `room`."""
    return live.context.project("room").frames.of()[0].id


def opened(live: Any, client: httpx.Client | None = None) -> str:
    answer = (client or live.client).post("/api/workbench", json={"project": "room"})
    assert answer.status_code == 201, answer.text
    assert answer.json()["url"] == f"/viser/{answer.json()['id']}/"
    return answer.json()["id"]


def show(live: Any, viewport: str, **scene: Any) -> httpx.Response:
    return live.client.put(f"/api/workbench/{viewport}/scene", json=scene)


def viewport_of(live: Any, viewport: str) -> Any:
    return live.server.app.state.viewports.get(viewport, "Ada")


@contextmanager
def browser(live: Any, viewport: str, protocol: str = PROTOCOL, **more: Any) -> Iterator[ClientConnection]:
    """Opens a WebSocket like viser's page: at the page's own URL."""
    headers = {"Cookie": live.cookies()}
    with connect(
        live.socket_url(f"/viser/{viewport}"),
        additional_headers=headers,
        origin=live.url,
        subprotocols=[protocol],
        max_size=None,
        **more,
    ) as socket:
        yield socket


def test_a_preview_replaces_the_box_of_its_label(live: Any, frame_id: int) -> None:
    project = live.context.project("room")
    box = OrientedBox.from_parts(np.array([0.0, 0, 3]), np.eye(3), np.array([1.0, 1, 1]))
    revision = project.frames.get(frame_id).revision
    project.labels.create(frame_id, [NewLabel("person", box)], WriteContext(revision, "Ada"))
    uid = project.labels.of_frame(frame_id)[0].uid
    viewport = opened(live)
    assert show(live, viewport, frame=frame_id).status_code == 200
    scene = viewport_of(live, viewport)._scene
    assert [shown.uid for shown in scene.content.boxes] == [uid]
    moved = {"center": [0.5, 0, 3], "size": [1, 1, 1], "rotation": np.eye(3).tolist()}
    show(live, viewport, frame=frame_id, selected=uid, previews=[{"uid": uid, "box": moved}], gizmo="rotate")
    assert [shown.uid for shown in scene.content.boxes] == [uid]
    np.testing.assert_allclose(scene.content.selected_box.box.center_m, [0.5, 0, 3])
    assert scene.content.selected_box.state is ReviewState.ACCEPTED
    show(live, viewport, frame=frame_id, colors={uid: "#00ff80", "gone": "#ffffff"})
    assert [shown.color for shown in scene.content.boxes] == [(0, 255, 128)]
    assert show(live, viewport, frame=frame_id, colors={uid: "red"}).status_code == 422
    # all unstored boxes are shown, the selected one as changed by its preview
    added = [{"uid": f"new-{n}", "box": {**moved, "center": [n, 0, 3]}} for n in (1, 2)]
    show(live, viewport, frame=frame_id, selected="new-2", previews=added)
    assert {shown.uid: shown.box.center_m[0] for shown in scene.content.boxes} == {uid: 0, "new-1": 1, "new-2": 2}
    assert {shown.state for shown in scene.content.boxes[1:]} == {ReviewState.PROPOSED}


def test_missing_projects_frames_and_viewports(live: Any) -> None:
    assert live.client.post("/api/workbench", json={"project": "nowhere"}).status_code == 404
    viewport = opened(live)
    assert show(live, viewport, frame=987654).status_code == 404
    assert show(live, viewport, frame=1, ahead=987654).is_success, "what may be shown next is gone"
    assert live.client.get(f"/viser/{viewport}/%2e%2e/%2e%2e/pyproject.toml").status_code == 404
    assert live.client.delete(f"/api/workbench/{viewport}").status_code == 204
    assert show(live, viewport, frame=None).status_code == 404
    assert live.client.get(f"/viser/{viewport}/").status_code == 404


def test_a_viewport_is_accessible_to_its_operator_only(live: Any, frame_id: int) -> None:
    viewport = opened(live)
    with httpx.Client(base_url=live.url, headers={"Origin": live.url}) as other:
        assert other.post("/api/workbench", json={"project": "room"}).status_code == 401
        assert other.get(f"/viser/{viewport}/").status_code == 401
        other.post("/api/session", json={"operator": "Grace"})
        assert other.get(f"/viser/{viewport}/").status_code == 404
        assert other.put(f"/api/workbench/{viewport}/scene", json={"frame": frame_id}).status_code == 404
        assert other.delete(f"/api/workbench/{viewport}").status_code == 404
    assert show(live, viewport, frame=frame_id).status_code == 200


def test_the_oldest_viewport_of_an_operator_closes_beyond_the_limit(live: Any) -> None:
    ids = [opened(live) for _ in range(MOST_PER_OPERATOR + 1)]
    assert [show(live, viewport, frame=None).status_code for viewport in ids] == [404, *[200] * MOST_PER_OPERATOR]


def test_the_proxy_adds_a_content_security_policy_to_viser_s_page(live: Any) -> None:
    viewport = opened(live)
    for encoding in ("gzip", "identity"):
        answer = live.client.get(f"/viser/{viewport}/", headers={"Accept-Encoding": encoding})
        assert answer.status_code == 200
        assert answer.headers["content-encoding"] == encoding
        assert "<title>Viser</title>" in answer.text
        policy = answer.headers["content-security-policy"]
        assert "frame-ancestors 'self'" in policy
        assert not re.search(r"https?:", policy)
    assert live.client.get(f"/viser/{viewport}/nothing.js").status_code == 404


def test_the_proxy_forwards_the_cloud_and_the_camera(live: Any, frame_id: int, wait_for: Callable) -> None:
    viewport = opened(live)
    show(live, viewport, frame=frame_id)
    points = viewport_of(live, viewport)._server.scene.get_handle_by_name("/cloud").points.tobytes()
    with browser(live, viewport) as socket:
        assert socket.subprotocol == PROTOCOL
        assert any(points in message for message in iter(lambda: socket.recv(timeout=PATIENCE_S), None))
        assert show(live, viewport, frame=frame_id).json()["connected"] is True
        camera = _messages.ViewerCameraMessage(
            (1, 0, 0, 0), (0, 0, 0), 480, 640, 1.0, 0.01, 100.0, (0, 0, 1), (0, -1, 0)
        )
        socket.send(msgspec.msgpack.encode(camera.as_serializable_dict([])))
        wait_for(lambda: viewport_of(live, viewport)._server.get_clients())
    wait_for(lambda: viewport_of(live, viewport).sockets == 0)
    wait_for(lambda: not viewport_of(live, viewport)._server.get_clients())


def test_either_side_may_close_with_a_reason(live: Any) -> None:
    viewport = opened(live)
    with browser(live, viewport, "viser-v0.0.0") as socket:
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=PATIENCE_S)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1002
        assert "Version mismatch" in closed.value.rcvd.reason
    with browser(live, viewport) as socket:
        socket.recv(timeout=PATIENCE_S)
        assert live.client.delete(f"/api/workbench/{viewport}").status_code == 204
        with pytest.raises(ConnectionClosed):
            while True:
                socket.recv(timeout=PATIENCE_S)


def test_viser_s_port_accepts_only_the_proxy(live: Any) -> None:
    """Pages of any site can reach ports of 127.0.0.1 from the operator's browser."""
    viewport = opened(live)
    port = viewport_of(live, viewport).port
    for origin in (None, "http://evil.example", "null", f"http://127.0.0.1:{port}", live.url):
        with (
            pytest.raises(InvalidStatus) as refused,
            connect(f"ws://127.0.0.1:{port}", origin=origin, subprotocols=[PROTOCOL]),
        ):
            pass
        assert refused.value.response.status_code == 403
    with browser(live, viewport) as socket:
        assert socket.recv(timeout=PATIENCE_S)


def test_silent_connections_to_viser_s_port_are_few(live: Any) -> None:
    viewport = opened(live)
    with ExitStack() as stack:
        address = ("127.0.0.1", viewport_of(live, viewport).port)
        silent = [stack.enter_context(create_connection(address, timeout=PATIENCE_S)) for _ in range(MOST_SILENT + 3)]
        for connection in silent[:3]:
            with suppress(ConnectionError):
                assert connection.recv(1) == b"", "the oldest are closed"
        with browser(live, viewport) as socket:
            assert socket.recv(timeout=PATIENCE_S)


def test_an_unprotectable_viser_server_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Mock()
    monkeypatch.setattr(viser, "ViserServer", lambda *_, **__: started)
    with pytest.raises(RuntimeError, match="cannot be restricted"):
        start_viser("127.0.0.1", "secret")
    started.stop.assert_called_once()


def test_an_unused_viewport_closes(wait_for: Callable) -> None:
    viewports = Viewports(lambda message, operator: None, unseen_s=0.5, sweep_s=0.02)
    try:
        seen, unseen = viewports.open("Ada", "room"), viewports.open("Ada", "room")
        viewports.connected(seen, +1)
        wait_for(lambda: unseen.id not in viewports._open)
        assert viewports.get(seen.id, "Ada") is seen
        viewports.connected(seen, -1)
        assert seen.id in viewports._open  # a reload takes some time
        wait_for(lambda: seen.id not in viewports._open)
    finally:
        viewports.close()


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
