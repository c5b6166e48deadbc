"""Rigs over HTTP: all cameras are added at once, and a label is one of all cameras that see it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
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


def test_a_label_is_one_of_all_cameras_that_see_it(live: Live) -> None:
    added = add_all(live, camera="all")
    assert [one["recording"]["name"] for one in added] == [f"drive@around-{angle:03}" for angle in (0, 90, 180, 270)]
    uid = label_object(live.context.project("room"), 1, -10.0)
    shown = state(live.client, 2)
    (label,) = shown["labels"]
    assert (label["uid"], label["track_id"]) == (uid, 3)
    px = np.array(label["outline"]).reshape(-1, 2)
    # seen by the left camera 45 degrees to its right
    expected = 639.5 + 448.13 * np.tan(np.radians(45))
    assert abs(np.median(px[:, 0]) - expected) < 120 and px[:, 0].max() < 1280
    assert state(live.client, 3)["labels"] == state(live.client, 4)["labels"] == []
    # what is decided in one camera is decided in the others, whose pages hear of it
    answer = change(live.client, shown["frame"]["revision"], {"kind": "reject", "uid": uid}, frame=2)
    assert answer.status_code == 200, answer.text
    now = state(live.client, 1)
    assert (now["labels"][0]["state"], now["frame"]["revision"]) == ("rejected", answer.json()["frame"]["revision"])


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
