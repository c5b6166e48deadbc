"""The annotation API over real HTTP: frames, label mode, review, history, queue, statistics, events."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from drawing import Scene, as_json, draw_object
from live_server import PATIENCE_S
from room_api import BOX, ROOM, change, propose, state
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from annotator.cli.main import main
from annotator.geometry.iou import iou_3d
from annotator.image_bytes import declared_size
from annotator.project import Project, WriteContext, open_project
from annotator.project.classes.edit import RenameClass
from annotator.types import BoxKind, Correction, DetectorKind
from annotator.web.hub import Client, Hub
from annotator.web.schemas import Box3DJson
from annotator.workflows.add_recordings import bring_back

if TYPE_CHECKING:
    from live_server import Live


def test_the_state_of_a_frame_has_labels_boxes_and_neighbours(live: Live, project: Project) -> None:
    (uid,) = propose(project, 2, 0.0)
    frame = state(live.client, 2)
    assert frame["frame"] == {
        "id": 2,
        "recording": 1,
        "recording_name": "people",
        "key": "000001",
        "index": 1,
        "revision": 1,
        "finalised": False,
        "previous": 1,
        "next": 3,
        "cameras": {"1": 2},
        "T_camera_cloud": None,
        "attributes": {},
    }
    assert (frame["image"]["width"], frame["image"]["height"]) == (320, 240)
    assert frame["points"] > 10_000
    assert frame["image_boxes"] is None and frame["objects"] == [] and frame["open_by"] == []
    assert frame["history"] == {"undo": None, "redo": None}
    (label,) = frame["labels"]
    assert (label["uid"], label["state"], label["source"], label["label"]) == (uid, "proposed", "auto", "person")
    assert label["quality"]["view_disagreement"] == 0.1
    assert label["quality"]["expected_iou_loss"] == 0.2
    assert 0.3 < label["doubt"] < 0.8
    assert 8 <= len(label["outline"]) <= 12 and len(label["outline"][0]) == 2
    assert state(live.client, 1)["frame"]["previous"] is None
    assert state(live.client, 5)["frame"]["next"] is None


def test_browsers_may_cache_images(live: Live) -> None:
    found = live.client.get(state(live.client)["image"]["url"])
    assert found.headers["content-type"] == "image/jpeg"
    assert "immutable" in found.headers["cache-control"]
    assert found.content.startswith(b"\xff\xd8")
    plain = live.client.get(f"{ROOM}/frames/1/image.jpg")
    assert plain.content == found.content
    assert "immutable" not in plain.headers["cache-control"]
    tracks = live.client.get(f"{ROOM}/recordings/1/tracks").json()
    assert (tracks["frames"], tracks["lanes"]) == ([1, 2, 3, 4, 5], [])
    small = live.client.get(f"{ROOM}/frames/1/image.jpg?width=96&{tracks['pictures']}")
    assert "immutable" in small.headers["cache-control"]
    assert declared_size(small.content)[0] == 96 and len(small.content) < len(plain.content)
    assert live.client.get(f"{ROOM}/views/{'0' * 64}.png").status_code == 404
    assert live.client.get(f"{ROOM}/views/..%2Fproject.png").status_code in (404, 422)


def test_the_first_frame_and_those_beside_a_frame_are_told(live: Live) -> None:
    assert live.client.get(f"{ROOM}/first-frame").json() == 1
    beside = [live.client.get(f"{ROOM}/frames/{frame}/beside").json() for frame in (1, 2)]
    assert beside == [{"previous": None, "next": 2}, {"previous": 1, "next": 3}]


def test_changes_are_one_step_and_all_or_none(live: Live, project: Project) -> None:
    one, two = propose(project, 1, 0.0, 5.0)
    edit = {"kind": "edit", "uid": two, "label": "person", "box": BOX, "track_id": 4}
    found = change(live.client, 1, {"kind": "accept", "uid": one}, edit, {"kind": "finalise"}).json()
    assert (found["frame"]["revision"], found["frame"]["finalised"]) == (4, True)
    assert [label["state"] for label in found["labels"]] == ["accepted", "edited"]
    assert found["labels"][1]["track_id"] == 4
    edited = found["labels"][1]["box"]
    assert iou_3d(Box3DJson(**edited).box(), Box3DJson(**BOX).box()) == pytest.approx(1)
    refused = change(live.client, 4, {"kind": "reject", "uid": one}, {"kind": "accept", "uid": "nobody"})
    assert refused.status_code == 404 and "nobody is not in this frame" in refused.json()["error"]["message"]
    assert state(live.client)["labels"][0]["state"] == "accepted"
    undone = live.client.post(f"{ROOM}/undo", json={}).json()
    assert (undone["frame"], undone["done"]) == (1, "edit person (frame 1)")
    assert [label["state"] for label in undone["state"]["labels"]] == ["proposed", "proposed"]
    assert not undone["state"]["frame"]["finalised"]
    redone = live.client.post(f"{ROOM}/redo", json={}).json()
    assert [label["state"] for label in redone["state"]["labels"]] == ["accepted", "edited"]
    assert live.client.post(f"{ROOM}/redo", json={}).status_code == 409


def test_a_stale_change_shows_both_versions_and_loses_neither(live: Live, project: Project) -> None:
    (uid,) = propose(project, 1, 0.0)
    assert change(live.client, 1, {"kind": "accept", "uid": uid}).status_code == 200
    refused = change(live.client, 1, {"kind": "reject", "uid": uid})
    assert refused.status_code == 409
    both = refused.json()
    assert both["error"]["kind"] == "StaleRevisionError"
    assert both["state"]["labels"][0]["state"] == "accepted"
    assert both["changes"] == [{"kind": "reject", "uid": uid}]
    again = change(live.client, both["state"]["frame"]["revision"], *both["changes"])
    assert again.json()["labels"][0]["state"] == "rejected"


INVALID: tuple[dict[str, Any], ...] = (
    {"changes": []},
    {"changes": [{"kind": "explode"}]},
    {"changes": [{"kind": "finalise", "extra": 1}]},
    {"changes": [{"kind": "create", "label": "person", "box": {**BOX, "size": [0, 1, 1]}}]},
    {"changes": [{"kind": "create", "label": "person", "box": {**BOX, "rotation": [[1, 0, 0]] * 3}}]},
    {"changes": [{"kind": "finalise"}], "effort": {"actions": -1, "seconds": 0}},
)


def test_invalid_changes_are_refused(live: Live) -> None:
    for body in INVALID:
        answer = live.client.post(f"{ROOM}/frames/1/changes", json={"revision": 0, **body})
        assert answer.status_code == 422
        assert answer.json()["error"]["kind"] == "ValidationError"
    assert state(live.client)["frame"]["revision"] == 0
    assert live.client.post(f"{ROOM}/frames/1/ortho", json={"box": BOX, "size_px": 10_000}).status_code == 422
    for body in ({"do": "remove", "name": "x" * 65}, {"do": "merge", "names": ["x"] * 1001, "into": "person"}):
        assert live.client.post(f"{ROOM}/classes", json=body).status_code == 422


def test_missing_frames_recordings_and_projects_are_404(live: Live) -> None:
    for path in ("frames/99", "frames/99/image.jpg"):
        assert live.client.get(f"{ROOM}/{path}").status_code == 404, path
    assert live.client.get("/api/projects/nobody/first-frame").status_code == 404
    unknown = change(live.client, 0, {"kind": "create", "label": "horse", "box": BOX})
    assert unknown.status_code == 400 and "'horse' is not a class" in unknown.json()["error"]["message"]


def test_statistics_are_those_of_the_command_line(live: Live, project: Project, capsys: Any) -> None:
    propose(project, 1, 0.0)
    statistics = live.client.get(f"{ROOM}/statistics").json()
    assert main(["stats", "room", "--json", "--projects", str(live.settings.projects_root)]) == 0
    assert json.loads(capsys.readouterr().out) == statistics


def test_steps_are_answered_without_storing_anything(live: Live, generated: Path) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    body = {"image_box": scene.image_box(0), "boxes": []}
    found = live.client.post(f"{ROOM}/frames/1/label/steps", json=body).json()
    assert found["box"] is None and found["stop"] is None and found["points"] > 100
    (step,) = found["steps"]
    assert step["suggested"] == [None, None]
    assert live.client.get(step["views"][0]["url"]).status_code == 200
    assert state(live.client)["frame"]["revision"] == 0
    assert list((live.settings.projects_root / "room" / "views").iterdir()) == []
    assert live.client.get(f"{ROOM}/frames/1/label/suggestions").json() == {"boxes": []}
    five = live.client.post(f"{ROOM}/frames/1/label/steps", json={**body, "boxes": [None] * 5})
    assert five.status_code == 422
    # the view of 2 cm is 256 px wide
    view = {name: step["views"][0][name] for name in ("axes", "metres_per_px", "origin_m")}
    for scale, status in ((2e-5, 200), (0.0, 422)):
        drawn = {"boxes": [scene.image_box(0)], "planes": [view | {"metres_per_px": scale}]}
        answer = live.client.post(f"{ROOM}/frames/1/label/steps", json=body | drawn)
        assert answer.status_code == status


def test_tools_say_why_there_is_no_detector(live: Live, project: Project, generated: Path, tmp_path: Path) -> None:
    body = {"image_box": Scene.of(generated / "people", 0, ["person"]).image_box(0)}
    corner = {"image_box": {"label": "person", "x_min": 0.0, "y_min": 0.0, "x_max": 3.0, "y_max": 3.0}}
    notes = [live.client.post(f"{ROOM}/frames/1/fit", json=each).json() for each in (body, corner)]
    assert [(each["note"], each["too_few_points"]) for each in notes] == [
        ("there is no pseudo-view detector yet", False),
        ("fewer than 5 points lie in this box, and no reviewed box tells how large a person is", True),
    ]
    weights = project.models_folder / "broken" / "best.pt"
    weights.parent.mkdir()
    weights.write_bytes(b"no weights")
    for role in DetectorKind:
        project.models.register(
            role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=f"broken {role.value}"
        )
    live.context.caches.detectors.readiness(project, DetectorKind.VIEW)
    found = live.client.post(f"{ROOM}/frames/1/label/steps", json={**body, "boxes": []}).json()
    assert found["detector"] == "failed" and "model.json: no such file" in found["problem"]
    assert len(found["steps"][0]["views"]) == 2
    suggestions = live.client.get(f"{ROOM}/frames/1/label/suggestions").json()
    assert suggestions["boxes"] == [] and "model.json: no such file" in suggestions["problem"]
    note = live.client.post(f"{ROOM}/frames/1/fit", json=body).json()["note"]
    assert "no pseudo-view detector: " in note and str(tmp_path) not in note


def test_the_queue_and_checks_list_doubtful_labels(live: Live, project: Project) -> None:
    uids = propose(project, 1, 0.0, 0.1)
    found = live.client.get(f"{ROOM}/queue", params={"order": "worst"}).json()
    assert found["remaining"] == 2 and found["items"][0]["uid"] in uids
    assert found["items"][0]["sources"] == ["annotator"]
    assert live.client.get(f"{ROOM}/queue", params={"source": "theirs"}).json()["remaining"] == 0
    assert live.client.get(f"{ROOM}/queue/sources").json() == {"annotator": 2}
    teach = live.client.get(f"{ROOM}/queue", params={"order": "teach"}).json()
    assert teach["items"][0]["uid"] is None
    assert live.client.get(f"{ROOM}/queue", params={"order": "worse"}).status_code == 422
    report = live.client.get(f"{ROOM}/checks").json()
    assert "duplicate" in {row["kind"] for row in report["warnings"]}


def test_an_operation_on_a_track_is_told_before_it_is_done(live: Live, project: Project) -> None:
    first, second = (propose(project, frame, 5.0)[0] for frame in (1, 2))
    for frame, uid in ((1, first), (2, second)):
        change(
            live.client,
            state(live.client, frame)["frame"]["revision"],
            {"kind": "track", "uid": uid, "track_id": 7},
            frame=frame,
        )
    change(live.client, state(live.client)["frame"]["revision"], {"kind": "accept", "uid": first})
    track = f"{ROOM}/recordings/1/tracks/7"
    split = {"operation": {"do": "number", "from": 2}, "at": 2}
    told = live.client.post(track, json=split).json()
    assert told["words"] == "changes 1 box, none of them reviewed; their number is 8, a new one"
    assert [box["uid"] for box in live.client.get(track).json()] == [first, second], "it was only counted"
    untrue = live.client.post(track, json={**split, "told": {**told["count"], "changed": 5}})
    assert (untrue.status_code, untrue.json()["error"]["kind"]) == (400, "ConfigError")
    assert live.client.post(track, json={**split, "told": told["count"]}).json() == told
    assert [box["uid"] for box in live.client.get(track).json()] == [first]
    assert live.client.post(f"{ROOM}/undo", json={}).json()["frame"] == 2
    for wrong in (
        {"do": "burn"},
        {"do": "size", "size_m": [1, 2, -3]},
        {"do": "delete", "first": 1.5},
        {"do": "values", "values": {}},
    ):
        assert live.client.post(track, json={"operation": wrong}).status_code == 422
    assert live.client.post(track, json={"operation": {"do": "delete", "from": 99}}).status_code == 404


def training_data(project: Project) -> tuple[int, list[str], int]:
    """The detectors' training data: number of boxes on images, kinds of boxes on views, number of 3D labels."""
    on_images = sum(len(boxes.boxes) for boxes in project.boxes.on_images())
    kinds = sorted(view.box_kind.value for view in project.boxes.on_views() for _ in view.boxes)
    return on_images, kinds, len(project.labels.select())


def test_rejecting_a_drawn_label_in_review_removes_its_boxes(live: Live, project: Project, generated: Path) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    uids = [draw_object(live.client, "room", 1, scene, number)["uid"] for number in range(2)]
    drawn = state(live.client)
    (proposed,) = propose(project, 1, 5.0)
    revision = state(live.client)["frame"]["revision"]
    both = [{"kind": "reject", "uid": uids[0]}, {"kind": "reject", "uid": proposed}]
    left = change(live.client, revision, *both).json()
    on_images, kinds, _ = training_data(project)
    assert (on_images, kinds) == (1, ["silhouette"] * 4)
    assert left["objects"] == [drawn["objects"][1]] and left["image_boxes"]["boxes"] == [scene.image_box(1)]
    undone = live.client.post(f"{ROOM}/undo", json={}).json()["state"]
    assert undone["objects"] == drawn["objects"] and undone["labels"][:2] == drawn["labels"]
    assert training_data(project)[:2] == (2, ["silhouette"] * 8)
    redone = live.client.post(f"{ROOM}/redo", json={}).json()["state"]
    assert redone["objects"] == left["objects"]
    back = change(live.client, redone["frame"]["revision"], {"kind": "accept", "uid": uids[0]}).json()
    assert [entry["uid"] for entry in back["objects"]] == [uids[1], uids[0]], "an accepted object is not background"


def test_a_changed_box_kind_measures_finished_objects_again(live: Live, project: Project, generated: Path) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    uids = [draw_object(live.client, "room", 1, scene, number)["uid"] for number in range(2)]
    drawn = {uid: project.labels.get(uid).label.box for uid in uids}
    revision = state(live.client)["frame"]["revision"]
    corrected = {"kind": "edit", "uid": uids[1], "label": "person", "box": BOX, "track_id": None}
    revision = change(live.client, revision, corrected).json()["frame"]["revision"]
    (on_image,) = project.boxes.on_images()
    boxes = {"kind": "image_boxes", "boxes": [as_json(box) for box in on_image.boxes], "box_kind": "box"}
    revision = change(live.client, revision, boxes).json()["frame"]["revision"]
    measured = {uid: project.labels.get(uid).label.box for uid in uids}
    assert iou_3d(measured[uids[1]], Box3DJson(**BOX).box()) == pytest.approx(1), "a corrected box stays"
    assert iou_3d(measured[uids[0]], drawn[uids[0]]) < 0.999
    views = state(live.client)["objects"][0]["views"]
    steps = {"image_box": scene.image_box(0), "boxes": [box for _, box in views], "box_kind": "box"}
    again = live.client.post(f"{ROOM}/frames/1/label/steps", json=steps).json()
    assert iou_3d(measured[uids[0]], Box3DJson(**again["box"]).box()) == pytest.approx(1), "as if drawn with this kind"
    # and back again
    change(live.client, revision, {**boxes, "box_kind": "silhouette"})
    assert iou_3d(project.labels.get(uids[0]).label.box, drawn[uids[0]]) == pytest.approx(1)
    for _ in range(2):
        live.client.post(f"{ROOM}/undo", json={})
    assert iou_3d(project.labels.get(uids[0]).label.box, drawn[uids[0]]) == pytest.approx(1)


def test_the_top_view_is_drawn_where_it_is_looked_at_and_places_boxes(live: Live, project: Project) -> None:
    place = {"left_m": -2.0, "top_m": -6.0, "metres_per_px": 0.05, "width": 80, "height": 60}
    answer = live.client.get(f"{ROOM}/frames/1/map.png", params={"right": [1, 0, 0], "down": [0, 0, -1], **place})
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (60, 80, 3) and len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    assert 1 < live.client.get(f"{ROOM}/frames/1/reach").json() < 20
    askew = live.client.get(f"{ROOM}/frames/1/map.png", params={"right": [1, 0, 0], "down": [1, 0, 0], **place})
    assert askew.status_code == 400 and "perpendicular" in askew.text
    body = {"point": [0.0, 0.0, 3.0], "label": "person"}
    assert "how large a person is" in live.client.post(f"{ROOM}/frames/1/place", json=body).json()["note"]


WaitFor = Callable[[Callable[[], Any]], None]


def listen(live: Live, project: str | None = "room", name: str = "Ada") -> ClientConnection:
    query = "" if project is None else f"?project={project}"
    # max_queue=None: a client with a full queue would not read the server's close frame
    return live.listen(query, f"annotator_operator={name}", max_queue=None)


def next_of(socket: ClientConnection, kind: str) -> dict[str, Any]:
    """The next event of a kind."""
    end = time.monotonic() + PATIENCE_S
    while True:
        message: dict[str, Any] = json.loads(socket.recv(timeout=end - time.monotonic()))
        if message["type"] == kind:
            return message


def finalise(project: Project, author: str) -> int:
    """Changes a frame; returns its id."""
    frame = project.frames.of()[2]
    project.frames.finalise(frame.id, WriteContext(frame.revision, author))
    return frame.id


def test_what_any_process_changes_is_announced_once_to_pages_of_its_project(live: Live) -> None:
    with (
        listen(live) as socket,
        listen(live, None) as other,
        open_project(live.settings.projects_root / "room") as project,
    ):
        next_of(socket, "presence")
        frame, of_server = finalise(project, "the command line"), live.context.project("room")
        expected = {"type": "frame", "project": "room", "frame": frame, "revision": 1, "operator": "the command line"}
        assert next_of(socket, "frame") == expected
        project.frames.reopen(frame, WriteContext(1, "Bob"))
        for _ in range(3):
            live.context.announcer.announce(of_server)
        finalise(project, "Eve")
        for expected_next in ((2, "Bob"), (3, "Eve")):
            event = next_of(socket, "frame")
            assert (event["revision"], event["operator"]) == expected_next

        project.change_classes(RenameClass(name="person", new="human"), "Cleo")
        expected = {"type": "classes", "project": "room", "renamed": {"person": "human"}, "operator": "Cleo"}
        assert next_of(socket, "classes") == expected
        project.adjustments.correct(1, Correction((0.0, 0.1, 0.0), (0.0, 0.0, 0.0)), "annotator calibrate")
        event = next_of(socket, "adjusted")
        assert (event["recording"], event["operator"]) == (1, "annotator calibrate")
        project.recordings.remove(1, "Bob")
        event = next_of(socket, "recordings")
        assert (event["recording"], event["operator"]) == (1, "Bob")
        bring_back(project, 1)
        assert next_of(socket, "recordings")["recording"] == 1
        with pytest.raises(TimeoutError):
            other.recv(timeout=0.2)


def test_a_page_hears_what_was_changed_while_it_connected_and_nothing_older(live: Live) -> None:
    project = live.context.project("room")
    finalise(project, "Ada")
    live.context.announcer.begin(project)
    project.frames.reopen(project.frames.of()[2].id, WriteContext(1, "Bob"))

    async def scenario() -> list[str]:
        live.context.hub.join(client := Client("room", "Ada"))
        live.context.announcer.announce(project)
        await asyncio.sleep(0)
        live.context.hub.leave(client)
        return [json.loads(client.queue.get_nowait())["type"] for _ in range(client.queue.qsize())]

    assert asyncio.run(scenario()) == ["presence", "frame"]


def test_pages_see_the_operators_of_open_frames(live: Live, wait_for: WaitFor) -> None:
    with listen(live) as ada, listen(live, name="Bob") as bob:
        ada.send(json.dumps({"type": "open", "frame": 3}))
        wait_for(lambda: next_of(bob, "presence")["frames"] == {"3": ["Ada"]})
        bob.send(json.dumps({"type": "open", "frame": 3}))
        wait_for(lambda: next_of(ada, "presence")["frames"] == {"3": ["Ada", "Bob"]})
        assert live.context.hub.open_by("room", 3, "Ada") == ["Bob"]
        bob.send(json.dumps({"type": "close"}))
        wait_for(lambda: next_of(ada, "presence")["frames"] == {"3": ["Ada"]})
        bob.send(json.dumps({"type": "open", "frame": 4}))
    wait_for(lambda: live.context.hub.presence("room") == {})


@pytest.mark.parametrize("message", ["", "{", "[]", '{"type": "open"}', '{"type": "open", "frame": -1}', b"x"])
def test_invalid_messages_close_the_socket(live: Live, message: str | bytes, wait_for: WaitFor) -> None:
    with listen(live) as socket:
        socket.send(message)
        with pytest.raises(ConnectionClosed):
            while True:
                socket.recv(timeout=PATIENCE_S)
    wait_for(lambda: not live.context.hub.clients())


def test_a_slow_page_does_not_delay_others(live: Live, wait_for: WaitFor) -> None:
    """The slow page does not read at all: its queue fills up, and the server disconnects it."""
    slow = live.listen(cookie="annotator_operator=Slow", max_queue=1, close_timeout=0.1)
    with listen(live) as quick:
        next_of(quick, "presence")
        filling = {"type": "frame", "project": "room", "text": "x" * 20_000}
        for number in range(2000):
            live.context.hub.send({**filling, "number": number})
            if number % 50 == 49:
                while next_of(quick, "frame")["number"] < number:
                    pass
        wait_for(lambda: [client.operator for client in live.context.hub.clients() if not client.dropped] == ["Ada"])
    slow.close()


def test_events_of_a_viewport_go_to_the_pages_of_its_operator() -> None:
    async def scenario() -> list[int]:
        hub, clients = Hub(), (Client("room", "A"), Client("room", "B"), Client("hall", "A"))
        for client in clients:
            hub.join(client)
        hub.send({"type": "viewport", "project": "room"}, "A")
        await asyncio.sleep(0)
        return [client.queue.qsize() for client in clients]

    assert asyncio.run(scenario()) == [2, 1, 1], "each has its presence"
