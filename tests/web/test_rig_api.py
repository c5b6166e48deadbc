"""Rigs over HTTP: all cameras are added at once, and a label is one of all cameras that see it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from live_server import PATIENCE_S
from room_api import change, label_object, rig_settings, state

from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from live_server import Live


@pytest.fixture
def web_settings(tmp_path: Path) -> ServerSettings:
    return rig_settings(tmp_path)


@pytest.fixture
def live(own_live: Live) -> Live:
    return own_live


def add_all(live: Live, **options: Any) -> list[dict[str, Any]]:
    body = {"path": "clouds/drive", "options": {"look_around": 4, **options}}
    answer = live.client.post("/api/projects/room/recordings", json=body)
    assert answer.status_code == 200, answer.text
    added: list[dict[str, Any]] = answer.json()["added"]
    return added


def test_a_camera_whose_folder_is_gone_does_not_hide_the_frame(live: Live, tmp_path: Path) -> None:
    add_all(live, camera="all")
    assert state(live.client, 1)["labels"] == []
    (tmp_path / "clouds" / "drive").rename(tmp_path / "clouds" / "moved")
    assert state(live.client, 1)["frame"]["key"] == "0"
    # all cameras of the folder are moved together
    answer = live.client.patch("/api/projects/room/recordings/2", json={"path": "clouds/moved"})
    assert answer.status_code == 200, answer.text
    stored = live.context.project("room").recordings.all()
    assert {one.path for one in stored} == {(tmp_path / "clouds" / "moved").resolve()}


def test_a_page_shows_the_labels_that_its_camera_sees_and_hears_of_changes_in_another(live: Live) -> None:
    add_all(live, camera="all")
    project = live.context.project("room")
    with live.listen() as page:
        uid = label_object(project, 1, -10.0)
        assert [[label["uid"] for label in state(live.client, frame)["labels"]] for frame in range(1, 5)] == [
            [uid], [uid], [], [],
        ]  # fmt: skip
        tracks = live.client.get("/api/projects/room/recordings/2/tracks").json()
        assert (tracks["frames"], tracks["lanes"]) == ([2], [{"track_id": 3, "spans": [[0, 0, "car", 0]]}])
        assert state(live.client, 2)["frame"]["cameras"] == {"1": 1, "2": 2, "3": 3, "4": 4}
        assert {each["rig_id"] for each in live.client.get("/api/projects/room/recordings").json()} == {1}
        assert change(live.client, 1, {"kind": "reject", "uid": uid}, frame=2).status_code == 200
        heard: dict[int, int] = {}
        while heard.get(1) != 2:
            message = json.loads(page.recv(PATIENCE_S))
            if message["type"] == "frame":
                heard[message["frame"]] = message["revision"]
    assert change(live.client, 1, {"kind": "accept", "uid": uid}, frame=1).status_code == 409
    assert [label["state"] for label in state(live.client, 1)["labels"]] == ["rejected"]
