"""3D viewports over HTTP, and the proxy to their viser servers."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from socket import create_connection
from typing import Any
from unittest.mock import Mock

import httpx
import msgspec
import numpy as np
import pytest
import viser
from live_server import PATIENCE_S
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from annotator.project.audit.writing import WriteContext
from annotator.project.changes import NewLabel
from annotator.types import OrientedBox, ReviewState
from annotator.web.viewport.viewports import MOST_PER_OPERATOR, Viewports
from annotator.web.viewport.viser_page import MOST_SILENT, start_viser

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
