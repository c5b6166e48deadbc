"""Renaming, copying and removing projects, and removing recordings, through the API."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from room_api import BOX, change, state
from test_events import listen, next_of

from annotator.project import open_project
from annotator.project.config import rename_project, set_aside
from annotator.types.errors import InUseError
from annotator.web.jobs.records import Job, JobState

if TYPE_CHECKING:
    from live_server import Live

ROOM = "/api/projects/room"


def error(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["error"]["message"]


def label_one(live: Live) -> None:
    change(live.client, state(live.client)["frame"]["revision"], {"kind": "create", "label": "person", "box": BOX})


def test_a_renamed_project_keeps_its_labels_and_jobs_and_its_pages_are_told(live: Live) -> None:
    label_one(live)
    job = done_export(live)
    live.client.post("/api/projects", json={"name": "taken", "classes": ["person"]})
    for name, status in (("taken", 400), ("No good", 400), ("x" * 65, 422)):
        assert live.client.post(f"{ROOM}/rename", json={"name": name}).status_code == status
    assert "choose another name" in error(live.client.post(f"{ROOM}/rename", json={"name": "taken"}))[1]

    with listen(live) as socket:
        renamed = live.client.post(f"{ROOM}/rename", json={"name": "hall"})
        told = next_of(socket, "renamed")
    assert renamed.json()["labels_by_state"]["accepted"] == 1
    assert (told["name"], told["operator"]) == ("hall", "Ada")
    assert live.client.get(ROOM).status_code == 404
    assert len(live.client.get("/api/projects/hall/frames/1").json()["labels"]) == 1
    listed = {each["id"]: each["project"] for each in live.client.get("/api/jobs").json()["jobs"]}
    assert listed[job.id] == "hall"
    assert live.client.get(f"/api/jobs/{job.id}/download").status_code == 200


def test_a_project_in_use_is_neither_renamed_nor_removed(
    live: Live, jobs_on_path: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = live.settings.projects_root / "room"
    live.client.get(ROOM)
    for refused in (lambda: rename_project(folder, "hall"), lambda: set_aside(folder)):
        with pytest.raises(InUseError, match="if it is a server, use its start page, or stop it"):
            refused()
    with open_project(folder):  # as a command does
        for answer in (live.client.post(f"{ROOM}/rename", json={"name": "hall"}), live.client.delete(ROOM)):
            status, message = error(answer)
            assert status == 409
            assert "if it is a command, wait until it is done" in message
            assert str(folder) not in message
    monkeypatch.setitem(live.context.jobs._jobs, "x", queued(live))
    assert error(live.client.delete(ROOM)) == (
        409,
        "project room has a job that runs or waits (export); stop it, or wait until it is done",
    )
    monkeypatch.undo()
    assert live.client.get(ROOM).json()["frames"] == 5
    assert live.client.post(f"{ROOM}/rename", json={"name": "hall"}).status_code == 200


def queued(live: Live) -> Job:
    return Job(id="0" * 32, project="room", kind="export", operator="Ada", created_ns=1)


def done_export(live: Live) -> Job:
    """An export that is listed, with its file."""
    job = queued(live).model_copy(update={"state": JobState.DONE, "result": {"file": "a.zip"}, "download": "kept"})
    live.context.jobs._jobs[job.id] = job
    (live.context.jobs.folder / job.id).mkdir(parents=True)
    (live.context.jobs.folder / job.id / "a.zip").write_bytes(b"zip")
    return job


def test_a_recording_is_removed_and_comes_back_with_its_labels(live: Live) -> None:
    label_one(live)
    before, place = state(live.client), f"{ROOM}/recordings/1"
    with listen(live) as socket:
        (listed,) = live.client.delete(place).json()["recordings"]
        told = next_of(socket, "recordings")
    assert (listed["name"], listed["labels"], listed["removed_by"]) == ("people", 1, "Ada")
    assert (told["recording"], told["operator"]) == (1, "Ada")
    assert live.client.get(ROOM).json()["recordings"] == []
    assert live.client.get(f"{ROOM}/frames/1").status_code == 404
    refused = change(live.client, before["frame"]["revision"], {"kind": "create", "label": "person", "box": BOX})
    assert (refused.status_code, refused.json()["error"]["kind"]) == (404, "NotFoundError")
    assert live.client.delete(place).status_code == 404

    (back,) = live.client.post(f"{place}/restore").json()["recordings"]
    assert (back["labels"], back["removed_by"]) == (1, None)
    assert state(live.client) == before
    assert live.client.post(f"{ROOM}/recordings/9/restore").status_code == 404
