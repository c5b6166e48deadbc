"""Tools of a frame over HTTP: following, classes and values, alignment; frames of a rig."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest
from live_server import PATIENCE_S, wait_until
from room_api import BOX, ROOM, change, label_object, propose, rig_settings, state
from scipy.spatial import cKDTree

from annotator.project import NewLabel, Project, WriteContext
from annotator.project.classes.edit import RenameClass
from annotator.recordings import open_recording
from annotator.types import Correction
from annotator.web.follow_runs import FollowRuns
from annotator.web.security import ServerSettings
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.follow_objects import Follower
from annotator.workflows.tracks.follow_run import follow_from_frame
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetectors

if TYPE_CHECKING:
    from live_server import Live
    from websockets.sync.client import ClientConnection


def accept_truth(project: Project, generated: Path, frame: int = 1, objects: int = 1) -> list[str]:
    """Accepts the true boxes of a frame, without tracks; returns their labels."""
    recording = open_recording(generated / "people")
    truths = load_truth(recording, frame - 1, recording.frame(frame - 1))
    context = WriteContext(project.frames.get(frame).revision, "Ada")
    return list(project.labels.create(frame, [NewLabel(t.label, t.box) for t in truths[:objects]], context).uids)


def follow(live: Live, frame: int = 1, **body: Any) -> dict[str, Any]:
    body = {"revision": state(live.client, frame)["frame"]["revision"], **body}
    answer = live.client.post(f"{ROOM}/frames/{frame}/follow", json=body)
    assert answer.status_code == 200, answer.text
    run: dict[str, Any] = answer.json()
    return run


def latest(live: Live) -> dict[str, Any]:
    run: dict[str, Any] = live.client.get(f"{ROOM}/follow").json()
    return run


def boxes(live: Live) -> list[int]:
    return [len(state(live.client, frame)["labels"]) for frame in range(1, 6)]


@pytest.mark.usefixtures("following_view")
def test_a_run_after_a_restart_of_the_server_has_a_higher_number(live: Live, project: Project, generated: Path) -> None:
    accept_truth(project, generated)
    numbers = []
    for _ in range(2):
        numbers.append(follow(live)["number"])
        wait_until(lambda: latest(live)["state"] != "running")
    restarted = FollowRuns(live.context.hub, live.context.announcer, str)
    frame = project.frames.get(1)
    run = follow_from_frame(project, frame.id, frame.revision, None, "Ada")
    numbers.append(restarted.start(project, "Ada", run, frame.id, "forward", False).number)
    restarted.close()
    assert numbers[0] < numbers[1] < numbers[2] < 2**53, "the page's numbers are exact to 2**53"


@pytest.mark.usefixtures("following_view")
def test_undo_stops_a_run_and_takes_back_all_of_it(
    live: Live, project: Project, generated: Path, following_gate: threading.Semaphore
) -> None:
    accept_truth(project, generated)
    follow(live)
    following_gate.release(2)
    wait_until(lambda: latest(live)["done"] == 2)
    # one run at a time: boxes that fill a gap are not fitted meanwhile
    filling = {"operation": {"do": "fill", "from": 1, "to": 3, "refit": True}}
    refused = live.client.post(f"{ROOM}/recordings/1/tracks/1", json=filling)
    assert (refused.status_code, "objects are followed; wait" in refused.text) == (400, True), refused.text
    # the run is asked to stop while it waits for a frame, and ends after that frame
    running = live.context.follow_runs._runs[live.context.project("room")]["Ada"]
    threading.Thread(target=lambda: running.stop.wait(PATIENCE_S) and following_gate.release(2)).start()
    assert live.client.post(f"{ROOM}/undo", json={}).status_code == 200
    assert latest(live) is None
    assert boxes(live) == [1, 0, 0, 0, 0]


@pytest.mark.usefixtures("following_view")
def test_a_failed_run_is_reported(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("broken")

    monkeypatch.setattr(Follower, "step", fail)
    change(live.client, 0, {"kind": "create", "label": "person", "box": BOX, "track_id": 5})
    follow(live)
    wait_until(lambda: latest(live)["state"] != "running")
    assert (latest(live)["state"], latest(live)["message"]) == ("failed", "internal error, see the server's log")


def test_what_cannot_be_followed_is_refused(
    live: Live, project: Project, generated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (uid,) = accept_truth(project, generated)
    assert latest(live) is None
    assert live.client.post(f"{ROOM}/follow/stop").json() is None
    refused = live.client.post(f"{ROOM}/frames/1/follow", json={"revision": 1, "uid": uid, "direction": "backward"})
    assert refused.status_code == 400
    assert "this is the first frame of its recording; there is no previous one" in refused.json()["error"]["message"]
    monkeypatch.setattr("annotator.web.routes.tracks.has_view_with_classes", lambda _: True)
    readiness = Readiness("failed", problem="the weights are damaged")
    monkeypatch.setattr(ReadyDetectors, "readiness", lambda *_: readiness)
    refused = live.client.post(f"{ROOM}/frames/1/follow", json={"revision": 1, "uid": uid})
    assert refused.json()["error"]["message"] == "the view detector cannot be used: the weights are damaged"


def test_an_object_that_stands_still_is_looked_for_in_all_frames(live: Live, project: Project, generated: Path) -> None:
    last = project.frames.of()[-1]

    def scan(position: int | None) -> None:
        with project.store.write() as connection:
            connection.exec_driver_sql("UPDATE frames SET position = ? WHERE id = ?", (position, last.id))

    with project.store.write() as connection:
        connection.exec_driver_sql("UPDATE frames SET world = ?", (json.dumps(np.eye(4).tolist()),))
    scan(None)
    (uid,) = accept_truth(project, generated)
    changed = change(live.client, 1, {"kind": "track", "uid": uid, "track_id": 7}).json()
    assert [label["still"] for label in changed["labels"]] == [False]
    path, operation = f"{ROOM}/recordings/1/tracks/7", {"do": "still", "frame": 1}

    def heard(messages: ClientConnection) -> None:
        while json.loads(messages.recv(PATIENCE_S)).get("type") != "still":
            pass

    with live.listen() as messages:
        told = live.client.post(path, json={"operation": operation}).json()["count"]
        assert live.client.post(path, json={"operation": operation, "told": told}).status_code == 200
        heard(messages)
        # by the clouds: the person walks on, and stands in the way of what was there only for a moment
        wait_until(lambda: not project.stills.unsighted(1))
        # a frame that a later scan finds
        scan(last.index)
        wait_until(lambda: not project.stills.unsighted(1))
        seen = [each.frame_id for each in project.labels.along(1, tracks=[7])]
        assert {1} < set(seen)
        (shown,) = state(live.client, seen[-1])["labels"]
        assert shown["still"]
        here = {"kind": "delete", "uid": shown["uid"], "here": True}
        assert change(live.client, state(live.client, seen[-1])["frame"]["revision"], here, frame=seen[-1]).is_success
        assert [label["state"] for label in state(live.client, seen[-1])["labels"]] == ["rejected"]
        assert state(live.client)["labels"][0]["state"] == "accepted"
        assert live.client.post(f"{ROOM}/undo", json={}).is_success
        moving = {"do": "moving", "frame": 1}
        told = live.client.post(path, json={"operation": moving}).json()["count"]
        assert live.client.post(path, json={"operation": moving, "told": told}).is_success
        heard(messages)
    assert [label["state"] for label in state(live.client, seen[-1])["labels"]] == ["proposed"]


POSE = {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"], "key": "o"}
SHIRT = {"name": "shirt", "kind": "text", "of": "track"}
RAIN = {"name": "rain", "kind": "boolean", "of": "frame", "default": False}


def edit(live: Live, expected: int = 200, **body: Any) -> Any:
    answer = live.client.post(f"{ROOM}/classes", json=body)
    assert answer.status_code == expected, answer.text
    return answer.json() if expected == 200 else answer.json()["error"]["message"]


def set_values(live: Live, frame: int, expected: int = 200, **body: Any) -> Any:
    body = {"revision": state(live.client, frame)["frame"]["revision"], **body}
    answer = live.client.post(f"{ROOM}/frames/{frame}/attributes", json=body)
    assert answer.status_code == expected, answer.text
    return answer.json()


def test_classes_and_attributes_are_changed_and_labels_follow(live: Live, project: Project) -> None:
    uid = change(live.client, 0, {"kind": "create", "label": "person", "box": BOX}).json()["labels"][0]["uid"]
    for attribute in (POSE, SHIRT, RAIN):
        info = edit(live, do="attribute", attribute=attribute)
    assert info["attributes"] == [POSE, SHIRT, RAIN]
    info = edit(live, do="add", name="dog", style={"colour": "#112233", "key": "d"})
    assert (info["classes"][-1], info["class_styles"]["dog"]) == ("dog", {"colour": "#112233", "key": "d"})
    styles = edit(live, do="style", name="dog", style={"key": "h"})["class_styles"]
    assert styles == {"dog": {"colour": "#112233", "key": "h"}}
    edit(live, do="order", names=info["classes"][::-1])
    edit(live, do="rename_attribute", name="pose", choice="sitting", new="seated")
    edit(live, do="rename", name="person", new="human")
    assert state(live.client, 1)["labels"][0]["label"] == "human"
    assert "merge them" in edit(live, 400, do="rename", name="human", new="dog")
    assert "cannot be removed while boxes use it" in edit(live, 400, do="remove", name="human")
    assert "needs at least one" in edit(live, 400, do="attribute", attribute={"name": "x", "kind": "choice"})
    assert "has no class" in edit(live, 404, do="merge", names=["dog"], into="cat")
    info = edit(live, do="merge", names=["human"], into="dog")
    assert "human" not in info["classes"]
    label = state(live.client, 1)["labels"][0]
    assert (label["uid"], label["label"]) == (uid, "dog")
    edit(live, do="rename_attribute", name="pose", new="posture")
    edit(live, do="remove_attribute", name="posture")
    edit(live, do="add", name="cat")
    edit(live, do="remove", name="dog", with_boxes=True)
    assert state(live.client, 1)["labels"] == []
    undone = live.client.post(f"{ROOM}/undo", json={}).json()
    assert undone == {"frame": None, "state": None, "done": "remove the class dog"}
    assert state(live.client, 1)["labels"][0]["label"] == "dog"
    # the page asks whether to skip a change of the classes that others need, as it does for boxes
    project.change_classes(RenameClass(name="cat", new="tiger"), "Bob")
    refused = live.client.post(f"{ROOM}/undo", json={})
    assert (refused.status_code, refused.json()["frame"], refused.json()["state"]) == (409, None, None)
    assert "was changed by Bob since" in refused.json()["error"]["message"]
    assert live.client.post(f"{ROOM}/undo", json={"skip": True}).status_code == 200


def test_values_are_set_and_the_queue_is_filtered_by_them(live: Live, project: Project) -> None:
    for attribute in (POSE, RAIN):
        edit(live, do="attribute", attribute=attribute)
    first, second = propose(project, 3, 0.0), propose(project, 4, 0.5)
    assert not state(live.client, 3)["labels"][0]["kept"]
    (label,) = set_values(live, 3, uid=first[0], values={"pose": "standing"})["labels"]
    assert (label["kept"], label["attributes"]) == (True, {"pose": "standing"})
    stale = set_values(live, 3, 409, uid=first[0], values={"pose": None}, revision=1)
    assert stale["state"]["labels"][0]["attributes"] == {"pose": "standing"}
    wrong = set_values(live, 3, 400, uid=first[0], values={"pose": "flying"})
    assert wrong["error"]["message"] == 'person: pose must be one of sitting, standing, not "flying"'
    assert "deleted; reload" in set_values(live, 3, 404, uid="gone", values={"pose": None})["error"]["message"]
    assert live.client.get(f"{ROOM}/classes").json()["values"] == {"pose": 1}

    def queued(query: str) -> list[str]:
        return [item["uid"] for item in live.client.get(f"{ROOM}/queue?{query}").json()["items"]]

    edit(live, do="attribute", attribute={"name": "mass", "kind": "number"})
    set_values(live, 3, uid=first[0], values={"mass": 9.5})
    set_values(live, 4, uid=second[0], values={"mass": 81})
    set_values(live, 3, values={"rain": True})
    for query, found in (
        ("pose&value=standing", first),
        ("pose", second),
        ("pose&known=true", first),
        ("pose&contains=STAND", first),
        ("mass&low=10", second),
        ("mass&low=9.5&high=80", first),
        # values of the frame, or the default
        ("rain&value=true", first),
        ("rain&value=false", second),
        ("rain", []),
    ):
        assert queued(f"attribute={query}") == found, query
    edit(live, do="attribute", attribute={name: value for name, value in RAIN.items() if name != "default"})
    assert queued("attribute=rain") == second


RECORDING = f"{ROOM}/recordings/1"
TURNED = {"turn_deg": [0.5, -2.0, 1.0], "shift_m": [0.03, 0.0, -0.1], "time_offset_s": 0.0}
NONE = {"turn_deg": [0.0, 0.0, 0.0], "shift_m": [0.0, 0.0, 0.0], "time_offset_s": 0.0}


def shown(client: httpx.Client, frame: int = 1) -> dict[str, Any]:
    answer = client.get(f"{ROOM}/frames/{frame}/alignment")
    assert answer.status_code == 200, answer.text
    content: dict[str, Any] = answer.json()
    return content


def correct(client: httpx.Client, correction: dict[str, Any], frame: int = 1, **more: Any) -> httpx.Response:
    body = {"correction": correction, "frame": frame, "adjusted": shown(client)["adjusted"], **more}
    return client.post(f"{RECORDING}/correction", json=body)


def test_the_points_are_those_of_the_files_whatever_the_correction(live: Live, generated: Path) -> None:
    before = shown(live.client)
    recorded = open_recording(generated / "people").frame(0)
    points = np.array(before["points"]).reshape(-1, 3)
    assert 1000 < len(points) <= 15_000
    assert before["correction"] == NONE and not before["is_virtual"]
    distance, _ = cKDTree(recorded.cloud.xyz_m).query(points)
    assert distance.max() < 1e-3
    after = correct(live.client, TURNED).json()
    assert after["points"] == before["points"]
    assert after["correction"]["turn_deg"] == pytest.approx(TURNED["turn_deg"])
    assert after["adjusted"] > before["adjusted"]


def test_a_correction_of_an_outdated_one_is_refused(live: Live) -> None:
    seen = shown(live.client)["adjusted"]
    assert correct(live.client, TURNED, adjusted=seen).status_code == 200
    assert correct(live.client, NONE, adjusted=seen).status_code == 409
    body = {"up": [0.0, -1.0, 0.0], "frame": 1, "adjusted": seen}
    assert live.client.post(f"{RECORDING}/up", json=body).status_code == 409


def test_wrong_corrections_are_refused(live: Live) -> None:
    # frames without times have no offset
    wrong = ({"turn_deg": [0.0, 181.0, 0.0]}, {"time_offset_s": 1e9}, {"other": 1}, {"time_offset_s": 0.1})
    for part in wrong:
        assert correct(live.client, {**NONE, **part}).status_code in (400, 422)
    unknown = correct(live.client, TURNED, frame=999)
    assert unknown.status_code == 400 and "no such frame" in unknown.json()["error"]["message"]
    assert shown(live.client)["correction"] == NONE


def test_a_large_correction_of_the_command_line_can_be_changed(live: Live, project: Project) -> None:
    project.adjustments.correct(1, Correction((0.0, 2.5, 0.0), (0.0, 0.0, 200.0)), "Ann")
    stored = shown(live.client)["correction"]
    answer = correct(live.client, {**stored, "turn_deg": [1.0, *stored["turn_deg"][1:]]})
    assert answer.status_code == 200, answer.text


@pytest.fixture
def web_settings(tmp_path: Path) -> ServerSettings:
    return rig_settings(tmp_path)


@pytest.fixture
def rig_live(own_live: Live) -> Live:
    return own_live


def add_all(rig_live: Live, **options: Any) -> list[dict[str, Any]]:
    body = {"path": "clouds/drive", "options": {"look_around": 4, **options}}
    answer = rig_live.client.post("/api/projects/room/recordings", json=body)
    assert answer.status_code == 200, answer.text
    added: list[dict[str, Any]] = answer.json()["added"]
    return added


def test_a_camera_whose_folder_is_gone_does_not_hide_the_frame(rig_live: Live, tmp_path: Path) -> None:
    add_all(rig_live, camera="all")
    assert state(rig_live.client, 1)["labels"] == []
    (tmp_path / "clouds" / "drive").rename(tmp_path / "clouds" / "moved")
    assert state(rig_live.client, 1)["frame"]["key"] == "0"
    # all cameras of the folder are moved together
    answer = rig_live.client.patch("/api/projects/room/recordings/2", json={"path": "clouds/moved"})
    assert answer.status_code == 200, answer.text
    stored = rig_live.context.project("room").recordings.all()
    assert {one.path for one in stored} == {(tmp_path / "clouds" / "moved").resolve()}


def test_a_page_shows_the_labels_of_its_moment_and_who_sees_them_best_and_hears_of_changes_in_another(
    rig_live: Live,
) -> None:
    add_all(rig_live, camera="all")
    rig_project = rig_live.context.project("room")
    with rig_live.listen() as page:
        uid = label_object(rig_project, 1, -10.0)
        seen = [state(rig_live.client, frame)["labels"] for frame in range(1, 5)]
        assert [[label["uid"] for label in labels] for labels in seen] == 4 * [[uid]]
        assert [bool(label["outline"]) for [label] in seen] == [True, True, False, False]
        best, other = seen[0][0]["seen_by"]
        assert {best, other} == {1, 2} and all(label["seen_by"] == [best, other] for [label] in seen)
        assert seen[best - 1][0]["better_in"] is None
        assert [label["better_in"] for [label] in seen[2:]] == [best, best]
        sheets = [rig_live.client.get(f"/api/projects/room/frames/{frame}/sheet").text for frame in (best, 3)]
        assert [uid in sheet for sheet in sheets] == [True, False]
        # a page carries boxes that are not stored from one camera to the other
        poses = [state(rig_live.client, frame)["frame"]["T_camera_cloud"] for frame in range(1, 5)]
        matrices = [np.eye(4) if pose is None else np.array(pose) for pose in poses]
        centers = [np.array([*label["box"]["center"], 1.0]) for [label] in seen]
        for matrix, center in zip(matrices, centers, strict=True):
            np.testing.assert_allclose(matrix @ np.linalg.inv(matrices[0]) @ centers[0], center, atol=1e-9)
        assert not np.allclose(centers[0], centers[1])
        answer = rig_live.client.get("/api/projects/room/frames/4", params={"best_for": uid})
        assert answer.json()["frame"]["id"] == best
        tracks = rig_live.client.get("/api/projects/room/recordings/2/tracks").json()
        assert (tracks["frames"], tracks["lanes"]) == (
            [2],
            [{"track_id": 3, "spans": [[0, 0, "car", 0]], "still": False}],
        )
        assert state(rig_live.client, 2)["frame"]["cameras"] == {"1": 1, "2": 2, "3": 3, "4": 4}
        assert {each["rig_id"] for each in rig_live.client.get("/api/projects/room/recordings").json()} == {1}
        assert change(rig_live.client, 1, {"kind": "reject", "uid": uid}, frame=2).status_code == 200
        heard: dict[int, int] = {}
        while heard.get(1) != 2:
            message = json.loads(page.recv(PATIENCE_S))
            if message["type"] == "frame":
                heard[message["frame"]] = message["revision"]
    assert change(rig_live.client, 1, {"kind": "accept", "uid": uid}, frame=1).status_code == 409
    assert [label["state"] for label in state(rig_live.client, 1)["labels"]] == ["rejected"]
