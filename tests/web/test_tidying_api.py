"""Renaming, copying and removing projects, and removing recordings, through the API."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from live_server import running
from room_api import BOX, change, state
from test_events import listen, next_of

from annotator.cli.main import main
from annotator.project import open_project
from annotator.project.config import rename_project, set_aside
from annotator.types.errors import InUseError
from annotator.web.jobs.records import CopyRequest, Job, JobContext, JobState
from annotator.web.jobs.work import copy_work
from annotator.web.security import ServerSettings

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


def test_a_removed_project_can_be_brought_back(live: Live, capsys: pytest.CaptureFixture[str]) -> None:
    label_one(live)
    with listen(live) as socket:
        removed = live.client.delete(ROOM).json()
        assert next_of(socket, "removed")["operator"] == "Ada"
    assert live.client.get("/api/projects").json()["projects"] == []
    assert error(live.client.delete(ROOM))[0] == 404
    assert removed["folder"].startswith("projects/.removed/room-")
    words = removed["command"].split()
    root = live.settings.projects_root
    assert words[:3] == ["annotator", "project", "copy"]
    assert main(["project", "copy", str(root.parent / words[3]), words[4], "--projects", str(root)]) == 0
    assert live.client.get(ROOM).json()["labels_by_state"]["accepted"] == 1


def test_a_project_is_copied_by_a_job_with_and_without_its_labels(live: Live, tmp_path: Path) -> None:
    label_one(live)
    assert error(live.client.post(f"{ROOM}/jobs", json={"kind": "copy", "name": "room"}))[0] == 400
    job = JobContext(live.context.project("room"), tmp_path, "Ada", lambda _: None, lambda: False)
    for name, labels, said in (("second", True, "second"), ("empty", False, "empty, without labels")):
        assert copy_work(job, CopyRequest(kind="copy", name=name, labels=labels)).message == f"copied to {said}"
        copied = live.client.get(f"/api/projects/{name}").json()
        assert copied["recordings"][0]["name"] == "people"
        assert copied["labels_by_state"]["accepted"] == labels


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


def test_a_recording_that_has_only_moved_is_offered_as_such(tmp_path: Path, own_copy: Callable[[str], Path]) -> None:
    recording = own_copy("people")
    with running(ServerSettings(tmp_path / "projects", (tmp_path,), port=0)) as live:
        live.client.post("/api/projects", json={"name": "room", "classes": ["person"]})
        place, root = f"{ROOM}/recordings", tmp_path.name
        live.client.post(place, json={"path": f"{root}/people", "labels": False})
        label_one(live)
        assert live.client.delete(f"{place}/1").status_code == 200
        recording.rename(tmp_path / "archive")
        gone = live.client.post(f"{place}/1/restore")
        assert "people: no such file or folder" in error(gone)[1]

        refused = live.client.post(place, json={"path": f"{root}/archive"})
        assert (refused.status_code, refused.json()["moved"]) == (400, {"id": 1, "name": "people"})
        assert str(tmp_path) not in json.dumps(refused.json())
        moved = live.client.patch(f"{place}/1", json={"path": f"{root}/archive"})
        assert moved.json()["frames"] == 5
        assert live.client.get(ROOM).json()["labels_by_state"]["accepted"] == 1

        shutil.copytree(tmp_path / "archive", tmp_path / "other")
        shutil.rmtree(tmp_path / "archive")
        added = live.client.post(place, json={"path": f"{root}/other", "labels": False, "as_new": True})
        assert added.json()["added"][0]["is_new"] is True
