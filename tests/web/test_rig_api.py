"""Rigs over HTTP: all cameras are added at once, and a label is an outline in the other cameras that see it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from room_api import label_object, rig_settings, state

from annotator.project import WriteContext
from annotator.types import Source
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


def test_a_label_is_an_outline_in_the_other_camera_that_sees_it(live: Live) -> None:
    added = add_all(live, camera="all")
    assert [one["recording"]["name"] for one in added] == [f"drive@around-{angle:03}" for angle in (0, 90, 180, 270)]
    project = live.context.project("room")
    uid = label_object(project, 1, -10.0)
    assert state(live.client, 1)["others"] == []
    (other,) = state(live.client, 2)["others"]
    assert (other["uid"], other["camera"], other["frame"], other["track_id"]) == (uid, "around-000", 1, 3)
    px = np.array(other["outline"]).reshape(-1, 2)
    # seen by the left camera 45 degrees to its right
    expected = 639.5 + 448.13 * np.tan(np.radians(45))
    assert abs(np.median(px[:, 0]) - expected) < 120 and px[:, 0].max() < 1280
    assert state(live.client, 3)["others"] == state(live.client, 4)["others"] == []
    # an own label of the same object takes its place; a rejected one of the other camera is not shown
    own = label_object(project, 2, 10.0)
    assert state(live.client, 2)["others"] == state(live.client, 1)["others"] == []
    project.labels.delete(2, own, WriteContext(project.frames.get(2).revision, "maria", Source.MANUAL))
    project.labels.reject(1, uid, WriteContext(project.frames.get(1).revision, "maria", Source.MANUAL))
    assert state(live.client, 2)["others"] == []


def test_a_camera_whose_folder_is_gone_does_not_hide_the_frame(live: Live, tmp_path: Path) -> None:
    add_all(live, camera="all")
    assert state(live.client, 1)["others"] == []
    (tmp_path / "clouds" / "drive").rename(tmp_path / "clouds" / "moved")
    assert state(live.client, 1)["frame"]["key"] == "0"
    # all cameras of the folder are moved together
    answer = live.client.patch("/api/projects/room/recordings/2", json={"path": "clouds/moved"})
    assert answer.status_code == 200, answer.text
    stored = live.context.project("room").recordings.all()
    assert {one.path for one in stored} == {(tmp_path / "clouds" / "moved").resolve()}
