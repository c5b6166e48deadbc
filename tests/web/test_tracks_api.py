"""Tracks over HTTP: following through the recording, interpolation, and refused stale requests."""

from __future__ import annotations

import base64
import json
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from live_server import PATIENCE_S, wait_until
from room_api import BOX, ROOM, change, propose, state

from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings import open_recording
from annotator.web.follow_runs import FollowRuns
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.follow_objects import Follower
from annotator.workflows.tracks.follow_run import follow_from_frame
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetectors

if TYPE_CHECKING:
    from live_server import Live


@pytest.fixture
def project(live: Live) -> Project:
    return live.context.project("room")


def test_boxes_are_copied_and_interpolated(live: Live) -> None:
    created = {"kind": "create", "label": "person", "box": BOX, "track_id": 5}
    uids = {frame: change(live.client, 0, created, frame=frame).json()["labels"][0]["uid"] for frame in (1, 4)}
    for tool, frame in (("copy-next", 1), ("interpolate", 4)):
        stale = live.client.post(f"{ROOM}/frames/{frame}/{tool}", json={"revision": 0, "uid": uids[frame]})
        assert (stale.status_code, stale.json()["state"]["frame"]["revision"]) == (409, 1)
    body = {"revision": 1, "uid": uids[1], "effort": {"actions": 1, "seconds": 2.0}}
    done = live.client.post(f"{ROOM}/frames/1/copy-next", json=body).json()
    assert done == {"frame": 2, "uid": state(live.client, 2)["labels"][0]["uid"]}
    filled = live.client.post(f"{ROOM}/frames/4/interpolate", json={"revision": 1, "uid": uids[4]}).json()
    assert (filled["filled"], filled["state"]["frame"]["id"]) == (2, 4)
    boxes = live.client.get(f"{ROOM}/recordings/1/tracks/5").json()["boxes"]
    states = ["accepted", "proposed", "proposed", "accepted"]
    assert [(box["frame"], box["state"]) for box in boxes] == list(zip((1, 2, 3, 4), states, strict=True))
    assert live.client.get(f"{ROOM}/recordings/9/tracks/5").status_code == 404


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
    run: dict[str, Any] = live.client.get(f"{ROOM}/follow").json()["run"]
    return run


def boxes(live: Live) -> list[int]:
    return [len(state(live.client, frame)["labels"]) for frame in range(1, 6)]


def test_a_second_box_of_a_track_in_a_frame_is_refused(live: Live, project: Project) -> None:
    first = change(live.client, 0, {"kind": "create", "label": "person", "box": BOX, "track_id": 5}).json()
    answer = change(live.client, 1, {"kind": "create", "label": "person", "box": BOX, "track_id": 5})
    refused = answer.json()
    assert (answer.status_code, refused["error"]["kind"], refused["track"]) == (409, "TrackTakenError", 5)
    assert "track 5 has a box in this frame already" in refused["error"]["message"]
    assert state(live.client, 1)["labels"] == first["labels"]


@pytest.mark.usefixtures("following_view")
def test_a_box_is_followed_through_the_recording_as_one_action(live: Live, project: Project, generated: Path) -> None:
    (uid,) = accept_truth(project, generated)
    begun = follow(live, uid=uid, effort={"actions": 1, "seconds": 2.0})
    assert (begun["state"], begun["total"], begun["has_detector"]) == ("running", 4, True)
    wait_until(lambda: latest(live)["state"] != "running")
    run = latest(live)
    assert (run["state"], run["done"], run["message"]) == ("done", 4, None)
    assert [(track["boxes"], track["track_id"], track["stops"]) for track in run["tracks"]] == [(4, 1, [])]
    assert run["first"][0] == 2
    assert boxes(live) == [1] * 5
    assert live.client.post(f"{ROOM}/undo", json={}).json()["done"] == "propose 4 labels (frames 000000 to 000004)"
    assert boxes(live) == [1, 0, 0, 0, 0]
    assert project.labels.get(uid).label.track_id is None


@pytest.mark.usefixtures("following_view")
def test_a_run_after_a_restart_of_the_server_has_a_higher_number(live: Live, project: Project, generated: Path) -> None:
    accept_truth(project, generated)
    numbers = []
    for _ in range(2):
        numbers.append(follow(live)["number"])
        wait_until(lambda: latest(live)["state"] != "running")
    restarted = FollowRuns(live.context.hub, str)
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
    assert live.client.post(f"{ROOM}/follow/stop").json() == {"run": None}
    refused = live.client.post(f"{ROOM}/frames/1/follow", json={"revision": 1, "uid": uid, "direction": "backward"})
    assert refused.status_code == 400
    assert "is the first of its recording; there is no previous frame" in refused.json()["error"]["message"]
    monkeypatch.setattr("annotator.web.routes.tracks.has_view_with_classes", lambda _: True)
    readiness = Readiness("failed", problem="the weights are damaged")
    monkeypatch.setattr(ReadyDetectors, "readiness", lambda *_: readiness)
    refused = live.client.post(f"{ROOM}/frames/1/follow", json={"revision": 1, "uid": uid})
    assert refused.json()["error"]["message"] == "the view detector cannot be used: the weights are damaged"


def in_track(live: Live, project: Project) -> list[str]:
    """One proposal of track 7 in each of three frames; returns their uids."""
    uids = [propose(project, frame, 0.1)[0] for frame in (1, 2, 3)]
    for frame, uid in enumerate(uids, 1):
        track = {"kind": "track", "uid": uid, "track_id": 7}
        change(live.client, state(live.client, frame)["frame"]["revision"], track, frame=frame)
    return uids


def test_a_sheet_shows_pictures_and_accepts_in_one_step(live: Live, project: Project) -> None:
    uids = in_track(live, project)
    boxes = live.client.get(f"{ROOM}/recordings/1/tracks/7").json()["boxes"]
    tiles = [json.loads(line) for line in live.client.get(f"{ROOM}/recordings/1/tracks/7/sheet").text.splitlines()]
    assert [tile["uid"] for tile in tiles] == uids
    assert all(base64.b64decode(tile["png"]).startswith(b"\x89PNG") for tile in tiles)
    assert live.client.get(f"{ROOM}/recordings/9/tracks/7/sheet").status_code == 404
    seen = [{key: box[key] for key in ("frame", "revision", "uid")} for box in boxes[:2]]
    body = {"boxes": seen, "effort": {"actions": 2, "seconds": 3.0}}
    assert live.client.post(f"{ROOM}/sheet/accept", json=body).json() == {"accepted": 2}
    assert "open the sheet again" in live.client.post(f"{ROOM}/sheet/accept", json=body).text


def test_later_proposals_are_corrected_alike(live: Live, project: Project) -> None:
    uids = in_track(live, project)
    shown = state(live.client)
    revision, was = shown["frame"]["revision"], shown["labels"][0]["box"]
    body = {"revision": revision, "uid": uids[0], "was": was}
    assert "reviewed" in live.client.post(f"{ROOM}/frames/1/carry", json=body).text
    center = [was["center"][0] + 0.25, *was["center"][1:]]
    edit = {"kind": "edit", "uid": uids[0], "label": "person", "box": {**was, "center": center}, "track_id": 7}
    change(live.client, revision, edit)
    assert live.client.post(f"{ROOM}/frames/1/carry", json=body).status_code == 409
    body["revision"] = revision + 1
    assert live.client.post(f"{ROOM}/frames/1/carry", json=body).json() == {"changed": 2}
