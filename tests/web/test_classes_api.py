"""Classes, attributes and their values over HTTP."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from live_server import PATIENCE_S
from room_api import BOX, ROOM, change, propose, state

from annotator.project import Project, open_project
from annotator.project.backup.make import Reason, automatic_backups
from annotator.project.classes.edit import rename_class

if TYPE_CHECKING:
    from live_server import Live

POSE = {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"], "key": "o"}
SHIRT = {"name": "shirt", "kind": "text", "of": "track"}
RAIN = {"name": "rain", "kind": "boolean", "of": "frame", "default": False}


@pytest.fixture
def project(live: Live) -> Project:
    return live.context.project("room")


def edit(live: Live, expected: int = 200, **body: Any) -> Any:
    answer = live.client.post(f"{ROOM}/classes", json={"change": body})
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
    assert automatic_backups(project.path) == []
    info = edit(live, do="merge", names=["human"], into="dog")
    assert "human" not in info["classes"]
    assert len(automatic_backups(project.path, Reason.CLASSES)) == 1
    label = state(live.client, 1)["labels"][0]
    assert (label["uid"], label["label"]) == (uid, "dog")
    edit(live, do="rename_attribute", name="pose", new="posture")
    edit(live, do="remove_attribute", name="posture")
    edit(live, do="add", name="cat")
    edit(live, do="remove", name="dog", with_boxes=True)
    assert state(live.client, 1)["labels"] == []


def test_the_list_counts_boxes_and_values_and_pages_hear_of_changes(live: Live, project: Project) -> None:
    for attribute in (POSE, RAIN):
        edit(live, do="attribute", attribute=attribute)
    uid = change(live.client, 0, {"kind": "create", "label": "person", "box": BOX}).json()["labels"][0]["uid"]
    set_values(live, 1, uid=uid, values={"pose": "sitting"})
    with live.listen() as socket, open_project(project.path) as other:
        # by another process
        other.change_classes(lambda config: rename_class(config, "person", "human"), "Cleo")
        while (message := json.loads(socket.recv(timeout=PATIENCE_S)))["type"] != "classes":
            pass
    assert message == {"type": "classes", "project": "room", "renamed": {"person": "human"}, "operator": "Cleo"}
    listed = live.client.get(f"{ROOM}/classes").json()
    (row,) = [row for row in listed["classes"] if row["name"] == "human"]
    assert row == {"name": "human", "labels": 1, "boxes_2d": 0, "said": 0, "colour": None, "key": None}
    assert (listed["attributes"], listed["values"], listed["unknown"]) == ([POSE, RAIN], {"pose": 1}, [])


def test_values_are_set_along_tracks_filtered_and_undone(live: Live, project: Project) -> None:
    for attribute in (POSE, SHIRT, RAIN):
        edit(live, do="attribute", attribute=attribute)
    created = {"kind": "create", "label": "person", "box": BOX, "track_id": 5}
    uids = [change(live.client, 0, created, frame=frame).json()["labels"][0]["uid"] for frame in (1, 2)]
    answer = set_values(live, 1, uid=uids[0], values={"pose": "sitting", "shirt": "red"})
    assert answer["labels"][0]["attributes"] == {"pose": "sitting", "shirt": "red"}
    assert state(live.client, 2)["labels"][0]["attributes"] == {"shirt": "red"}
    assert set_values(live, 1, values={"rain": True})["frame"]["attributes"] == {"rain": True}
    stale = set_values(live, 1, 409, uid=uids[0], values={"pose": None}, revision=1)
    assert stale["state"]["frame"]["attributes"] == {"rain": True}
    wrong = set_values(live, 1, 400, uid=uids[0], values={"pose": "flying"})
    assert wrong["error"]["message"] == 'person: pose must be one of sitting, standing, not "flying"'
    assert live.client.post(f"{ROOM}/undo", json={}).json()["state"]["frame"]["attributes"] == {}
    undone = live.client.post(f"{ROOM}/undo", json={}).json()
    assert undone["done"] == "set attributes of 2 labels (frames 000000 to 000001)"
    assert state(live.client, 2)["labels"][0]["attributes"] == {}

    first, second = propose(project, 3, 0.0), propose(project, 4, 0.5)
    assert not state(live.client, 3)["labels"][0]["kept"]
    assert set_values(live, 3, uid=first[0], values={"pose": "standing"})["labels"][0]["kept"]

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
