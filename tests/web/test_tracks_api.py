"""Tracks over HTTP: following into the next frame, interpolation, and refused stale requests."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from room_api import BOX, ROOM, change, propose, state

from annotator.project import Project

if TYPE_CHECKING:
    from live_server import Live


@pytest.fixture
def project(live: Live) -> Project:
    return live.context.project("room")


def test_tracks_are_followed_interpolated_and_undone(live: Live, project: Project) -> None:
    created = {"kind": "create", "label": "person", "box": BOX, "track_id": 5}
    first = change(live.client, 0, created).json()
    answer = live.client.post(f"{ROOM}/frames/1/follow", json={"revision": 0, "how": "detect"})
    assert answer.status_code == 409
    assert answer.json()["state"]["frame"]["revision"] == first["frame"]["revision"]
    effort = {"actions": 1, "seconds": 2.0}
    body = {"revision": first["frame"]["revision"], "how": "detect", "effort": effort}
    followed = live.client.post(f"{ROOM}/frames/1/follow", json=body).json()
    # the project has no detectors
    assert followed == {"frame": 2, "proposed": 1, "lost": 0, "how": "copy"}
    (copied,) = state(live.client, 2)["labels"]
    assert (copied["state"], copied["source"], copied["track_id"]) == ("proposed", "auto", 5)
    last = change(live.client, 0, created, frame=4).json()
    uid = last["labels"][0]["uid"]
    stale = live.client.post(f"{ROOM}/frames/4/interpolate", json={"revision": 0, "uid": uid})
    assert stale.status_code == 409
    body = {"revision": last["frame"]["revision"], "uid": uid, "effort": effort}
    filled = live.client.post(f"{ROOM}/frames/4/interpolate", json=body)
    assert filled.status_code == 200, filled.text
    assert (filled.json()["filled"], filled.json()["state"]["frame"]["id"]) == (2, 4)
    boxes = live.client.get(f"{ROOM}/recordings/1/tracks/5").json()["boxes"]
    assert [(box["frame"], box["state"]) for box in boxes] == [
        (1, "accepted"),
        (2, "proposed"),
        (3, "proposed"),
        (4, "accepted"),
    ]
    tracked = change(
        live.client, filled.json()["state"]["frame"]["revision"], {"kind": "track", "uid": uid, "track_id": 6}, frame=4
    )
    assert [(label["track_id"], label["state"]) for label in tracked.json()["labels"]] == [(6, "accepted")]
    live.client.post(f"{ROOM}/undo", json={})
    # one undo step for both frames
    undone = live.client.post(f"{ROOM}/undo", json={}).json()
    assert undone["done"] == "propose 2 labels (frames 000001 to 000002)"
    assert [label["uid"] for label in state(live.client, 2)["labels"]] == [copied["uid"]]
    assert state(live.client, 3)["labels"] == []
    (open_one,) = propose(project, 5, 0.0)
    refused = live.client.post(f"{ROOM}/frames/5/interpolate", json={"revision": 1, "uid": open_one})
    assert (refused.status_code, refused.json()["error"]["message"]) == (
        400,
        "only reviewed boxes are key frames; accept the box first",
    )
    assert live.client.get(f"{ROOM}/recordings/9/tracks/5").status_code == 404
