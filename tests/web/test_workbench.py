"""Workbenches over HTTP, and the way to their viser servers through the application's port."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import Mock

import httpx
import msgspec
import numpy as np
import pytest
import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from annotator.project.labels import NewLabel
from annotator.project.writing import Change
from annotator.types import OrientedBox, ReviewState
from annotator.web.viewport.server import start_viser
from annotator.web.viewport.workbenches import MOST_AN_OPERATOR, Workbenches

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


def show(live: Any, bench: str, **scene: Any) -> httpx.Response:
    return live.client.put(f"/api/workbench/{bench}/scene", json=scene)


def bench_of(live: Any, bench: str) -> Any:
    return live.server.app.state.workbenches.get(bench, "Ada")


@contextmanager
def browser(live: Any, bench: str, protocol: str = PROTOCOL, **more: Any) -> Iterator[ClientConnection]:
    """What viser's page does: a WebSocket at the page's own address."""
    headers = {"Cookie": live.cookies()}
    with connect(
        live.socket_url(f"/viser/{bench}"),
        additional_headers=headers,
        origin=live.url,
        subprotocols=[protocol],
        max_size=None,
        **more,
    ) as socket:
        yield socket


def test_a_scene_says_how_much_of_the_cloud_is_shown(live: Any, frame_id: int) -> None:
    bench = opened(live)
    answer = show(live, bench, frame=frame_id)
    assert answer.status_code == 200, answer.text
    frame = live.context.frame(live.context.project("room"), frame_id)
    assert answer.json()["points"] == answer.json()["shown_points"] == len(frame.cloud)
    assert answer.json()["ms"] > 0
    assert answer.json()["connected"] is False
    assert show(live, bench, frame=None).json()["points"] == 0


def test_labels_are_shown_and_a_preview_takes_the_place_of_its_label(live: Any, frame_id: int) -> None:
    project = live.context.project("room")
    box = OrientedBox.from_parts(np.array([0.0, 0, 3]), np.eye(3), np.array([1.0, 1, 1]))
    revision = project.frames.get(frame_id).revision
    project.labels.create(frame_id, [NewLabel("person", box)], Change(revision, "Ada"))
    uid = project.frame_state(frame_id).labels[0].uid
    bench = opened(live)
    assert show(live, bench, frame=frame_id).status_code == 200
    scene = bench_of(live, bench)._scene
    assert [shown.uid for shown in scene.content.boxes] == [uid]
    moved = {"center": [0.5, 0, 3], "size": [1, 1, 1], "quaternion": [1, 0, 0, 0]}
    show(live, bench, frame=frame_id, selected=uid, preview={"uid": uid, "box": moved}, gizmo="rotate")
    assert [shown.uid for shown in scene.content.boxes] == [uid]
    np.testing.assert_allclose(scene.selected.box.center_m, [0.5, 0, 3])
    assert scene.selected.state is ReviewState.ACCEPTED
    show(live, bench, frame=frame_id, preview={"uid": None, "box": moved}, labels="none")
    assert [shown.uid for shown in scene.content.boxes] == [None]
    # boxes that nobody has accepted yet are all there, the selected one as it is being changed
    added = [{"uid": f"new-{n}", "box": {**moved, "center": [n, 0, 3]}} for n in (1, 2)]
    show(live, bench, frame=frame_id, selected="new-2", added=added, preview={"uid": "new-2", "box": moved})
    assert {shown.uid: shown.box.center_m[0] for shown in scene.content.boxes} == {uid: 0, "new-1": 1, "new-2": 0.5}
    assert {shown.state for shown in scene.content.boxes[1:]} == {ReviewState.PROPOSED}


def test_a_draft_shows_its_views(live: Any, frame_id: int) -> None:
    bench = opened(live)
    image_box = {"label": "person", "x_min": 100, "y_min": 60, "x_max": 220, "y_max": 220}
    answer = show(live, bench, frame=frame_id, draft={"image_box": image_box, "boxes": [None, None]})
    assert answer.status_code == 200, answer.text
    content = bench_of(live, bench)._scene.content
    assert len(content.draft.views) == 2
    assert content.draft.box is None


@pytest.mark.parametrize(
    ("scene", "field"),
    [
        ({}, "frame"),
        ({"frame": -1}, "frame"),
        ({"frame": 1, "gizmo": "scale"}, "gizmo"),
        ({"frame": 1, "color": "pink"}, "color"),
        ({"frame": 1, "point_size": 0}, "point_size"),
        ({"frame": 1, "surprise": 1}, "surprise"),
        ({"frame": 1, "draft": {"image_box": {"label": "a", "x_min": 3, "y_min": 0, "x_max": 1, "y_max": 1}}}, "draft"),
        ({"frame": 1, "preview": {"uid": None, "box": {"center": [0, 0, 0], "size": [0, 1, 1]}}}, "preview"),
    ],
)
def test_a_scene_that_cannot_be_is_refused_with_its_field(live: Any, scene: dict, field: str) -> None:
    answer = live.client.put(f"/api/workbench/{opened(live)}/scene", json=scene)
    assert answer.status_code == 422
    assert field in answer.json()["error"]["message"]


def test_what_is_not_there_is_not_found(live: Any) -> None:
    assert live.client.post("/api/workbench", json={"project": "nowhere"}).status_code == 404
    bench = opened(live)
    assert show(live, bench, frame=987654).status_code == 404
    assert show(live, "0" * 16, frame=None).status_code == 404
    assert show(live, "..", frame=None).status_code in (404, 405, 422)
    assert live.client.get("/viser/0000/").status_code == 404
    assert live.client.get(f"/viser/{bench}/../../api/session").status_code in (200, 404)
    assert live.client.get(f"/viser/{bench}/%2e%2e/%2e%2e/pyproject.toml").status_code == 404
    assert live.client.delete(f"/api/workbench/{bench}").status_code == 204
    assert live.client.delete(f"/api/workbench/{bench}").status_code == 404
    assert live.client.get(f"/viser/{bench}/").status_code == 404


def test_an_operators_workbench_is_nobody_elses(live: Any, frame_id: int) -> None:
    bench = opened(live)
    with httpx.Client(base_url=live.url, headers={"Origin": live.url}) as other:
        assert other.post("/api/workbench", json={"project": "room"}).status_code == 401
        assert other.get(f"/viser/{bench}/").status_code == 401
        other.post("/api/session", json={"operator": "Grace"})
        assert other.get(f"/viser/{bench}/").status_code == 404
        assert other.put(f"/api/workbench/{bench}/scene", json={"frame": frame_id}).status_code == 404
        assert other.delete(f"/api/workbench/{bench}").status_code == 404
    assert show(live, bench, frame=frame_id).status_code == 200


def test_the_oldest_workbench_closes_where_an_operator_has_too_many(live: Any) -> None:
    benches = [opened(live) for _ in range(MOST_AN_OPERATOR + 1)]
    assert [show(live, bench, frame=None).status_code for bench in benches] == [404, *[200] * MOST_AN_OPERATOR]


def test_viser_s_page_comes_through_with_a_policy_of_its_own(live: Any) -> None:
    bench = opened(live)
    for encoding in ("gzip", "identity"):
        answer = live.client.get(f"/viser/{bench}/", headers={"Accept-Encoding": encoding})
        assert answer.status_code == 200
        assert answer.headers["content-encoding"] == encoding
        assert "<title>Viser</title>" in answer.text
        policy = answer.headers["content-security-policy"]
        assert "frame-ancestors 'self'" in policy
        assert not re.search(r"https?:", policy)
    assert live.client.get(f"/viser/{bench}/nothing.js").status_code == 404


def test_a_browser_is_sent_the_cloud_and_heard(live: Any, frame_id: int, wait_for: Callable) -> None:
    bench = opened(live)
    show(live, bench, frame=frame_id)
    points = live.context.frame(live.context.project("room"), frame_id).cloud.xyz_m.tobytes()
    with browser(live, bench) as socket:
        assert socket.subprotocol == PROTOCOL
        assert any(points in message for message in iter(lambda: socket.recv(timeout=10), None))
        assert show(live, bench, frame=frame_id).json()["connected"] is True
        camera = _messages.ViewerCameraMessage(
            (1, 0, 0, 0), (0, 0, 0), 480, 640, 1.0, 0.01, 100.0, (0, 0, 1), (0, -1, 0)
        )
        socket.send(msgspec.msgpack.encode(camera.as_serializable_dict([])))
        wait_for(lambda: bench_of(live, bench)._server.get_clients(), 5)
    wait_for(lambda: bench_of(live, bench).sockets == 0, 5)
    wait_for(lambda: not bench_of(live, bench)._server.get_clients(), 5)


def test_either_side_may_close_and_says_why(live: Any) -> None:
    bench = opened(live)
    with browser(live, bench, "viser-v0.0.0") as socket:
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=10)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1002
        assert "Version mismatch" in closed.value.rcvd.reason
    with browser(live, bench) as socket:
        socket.recv(timeout=10)
        assert live.client.delete(f"/api/workbench/{bench}").status_code == 204
        with pytest.raises(ConnectionClosed):
            while True:
                socket.recv(timeout=10)


def test_a_socket_needs_a_name_and_a_workbench(live: Any) -> None:
    bench = opened(live)
    with pytest.raises(InvalidStatus) as refused, connect(live.socket_url(f"/viser/{bench}"), origin=live.url):
        pass
    assert refused.value.response.status_code in (401, 403)
    with pytest.raises(InvalidStatus) as refused, browser(live, "0" * 16):
        pass
    assert refused.value.response.status_code in (403, 404)


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null", "own page", "application"])
def test_viser_s_own_port_takes_nobody_but_the_proxy(live: Any, origin: str | None) -> None:
    """A page of any site can reach the ports of 127.0.0.1 from the operator's browser."""
    bench = opened(live)
    port = bench_of(live, bench).port
    origin = {"own page": f"http://127.0.0.1:{port}", "application": live.url}.get(origin or "", origin)
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(f"ws://127.0.0.1:{port}", origin=origin, subprotocols=[PROTOCOL]),
    ):
        pass
    assert refused.value.response.status_code == 403
    with browser(live, bench) as socket:
        assert socket.recv(timeout=10)


def test_a_viser_that_cannot_be_guarded_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Mock()
    monkeypatch.setattr(viser, "ViserServer", lambda *_, **__: started)
    with pytest.raises(RuntimeError, match="does not know how to guard"):
        start_viser("127.0.0.1", "secret")
    started.stop.assert_called_once()


def test_a_slow_browser_is_left_out_what_a_newer_scene_has_replaced(live: Any, wait_for: Callable) -> None:
    frames = [frame.id for frame in live.context.project("room").frames.of()]
    bench = opened(live)
    rounds = 24
    size = live.context.frame(live.context.project("room"), frames[0]).cloud.xyz_m.nbytes
    with browser(live, bench, max_queue=1) as socket:
        for _ in range(rounds):
            for frame in frames:
                assert show(live, bench, frame=frame).status_code == 200
        last = live.context.frame(live.context.project("room"), frames[-1]).cloud.xyz_m.tobytes()
        messages = list(_until_quiet(socket))
    assert any(last in message for message in messages)
    assert sum(map(len, messages)) < 0.6 * rounds * len(frames) * size


def _until_quiet(socket: ClientConnection) -> Iterator[bytes]:
    try:
        while True:
            message = socket.recv(timeout=2)
            assert isinstance(message, bytes)
            yield message
    except TimeoutError:
        return


def test_a_workbench_that_nobody_looks_at_closes(wait_for: Callable) -> None:
    benches = Workbenches(lambda bench, message: None, unseen_s=0.3, sweep_s=0.02)
    try:
        seen, unseen = benches.open("Ada", "room"), benches.open("Ada", "room")
        benches.connected(seen, +1)
        wait_for(lambda: unseen.id not in benches._open, 5)
        assert benches.get(seen.id, "Ada") is seen
        benches.connected(seen, -1)
        time.sleep(0.1)
        assert seen.id in benches._open  # a reload takes a moment
        wait_for(lambda: seen.id not in benches._open, 5)
    finally:
        benches.close()
