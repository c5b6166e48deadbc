"""Folders, projects and recordings through the API: created, filled, renamed, copied, moved and removed."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from live_server import ended, running
from room_api import BOX, change, state
from test_annotation_api import listen, next_of

from annotator.project import open_project
from annotator.project.config import rename_project, set_aside
from annotator.types.errors import InUseError, NotFoundError
from annotator.web.folders import NO_ROOTS, Folders
from annotator.web.jobs.records import Job, JobState
from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from live_server import Live


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A root with sub-folders and links of all kinds, beside a folder that must not be accessible."""
    root = tmp_path / "data"
    for folder in (root / "sub" / "deep", root / ".hidden", tmp_path / "secret" / "in", tmp_path / "data-2"):
        folder.mkdir(parents=True)
    (tmp_path / "secret" / "passwords.txt").write_text("x")
    (root / "notes.txt").write_text("x")
    (root / "inside").symlink_to(root / "sub")
    (root / "outside").symlink_to(tmp_path / "secret")
    (root / "sibling").symlink_to(tmp_path / "data-2")
    (root / "nowhere").symlink_to(tmp_path / "gone")
    (root / "circle").symlink_to(root / "circle")
    return root


def test_roots_have_names_that_do_not_reveal_their_paths(tmp_path: Path, tree: Path) -> None:
    other = tmp_path / "other" / "data"
    other.mkdir(parents=True)
    assert Folders(()).list("").notes == (NO_ROOTS,)
    folders = Folders((tree, other, tree, tmp_path / "missing"))
    listing = folders.list("").entries
    assert [(e.name, e.path, e.recording) for e in listing] == [
        ("data", "data", None),
        ("data-2", "data-2", None),
        ("missing", "missing", None),
    ]
    assert folders.find("data-2") == other
    with pytest.raises(NotFoundError):
        folders.list("missing")


def test_sub_folders_and_links_inside_are_listed(tree: Path) -> None:
    folders = Folders((tree,))
    listing = folders.list("data")
    assert [entry.path for entry in listing.entries] == ["data/inside", "data/sub"]
    assert folders.find("data/inside/deep") == tree / "sub" / "deep"
    files, links = listing.notes
    assert files == "1 file is no recording: 1 .txt"
    assert links.startswith(
        "4 links (circle, nowhere, outside, sibling) lead to a place that this server does not offer"
    )
    assert "a KITTI object folder: image_2/, velodyne/, calib/" in listing.kinds


def test_a_folder_without_a_recording_says_what_is_there_and_nearest(tree: Path) -> None:
    (tree / "sub" / "image_2").mkdir()
    (tree / "sub" / "take.zip").write_bytes(b"")
    assert Folders((tree,)).list("data/sub").notes == (
        "1 file is no recording: 1 .zip",
        "it is an archive; unpack it, and give the folder",
        "it looks like a KITTI object folder: velodyne/ and calib/ are missing",
        "it looks like a KITTI tracking folder of one sequence: velodyne/ and calib.txt are missing",
    )


def test_a_path_on_this_computer_can_be_typed(tree: Path, generated: Path) -> None:
    folders = Folders((tree, generated))
    assert folders.list("data/sub/deep").notes == ("this folder is empty",)
    assert folders.list(f"{tree}/sub/").entries == folders.list("data/sub").entries
    listing = folders.list(str(generated / "people"))
    assert listing.here is not None and listing.here.path == f"{generated.name}/people"
    for path in (f"{tree}/../secret", f"{tree}/outside", f"{tree}-2", f"{tree}/.hidden"):
        with pytest.raises(NotFoundError):
            folders.list(path)


TRICKS = (
    *("", ".", "..", "/", "/etc", "secret", "data-2", "DATA", "%2e%2e", "～", "~", "$HOME", "\ud800"),
    *("C:\\", "file:///etc", "s3://bucket/x", "http://127.0.0.1:1/"),
    *("data/", "data//sub", "data/..", "data/./sub", "data/../secret", "data/sub/../../secret"),
    *("data/.hidden", "data/outside", "data/outside/in", "data/sibling", "data/nowhere", "data/circle"),
    *("data\\sub", "data/sub\0", "data/sub\n", "data/missing", "data/" + "a" * 5000, "data/" + "/".join(["a"] * 2000)),
)


def test_path_tricks_find_nothing(tree: Path) -> None:
    folders = Folders((tree,))
    for path in TRICKS:
        with pytest.raises(NotFoundError):
            folders.find(path)
    for path in (*TRICKS[1:], "data/notes.txt"):
        with pytest.raises(NotFoundError):
            folders.list(path)


def test_a_folder_that_may_not_be_read(tree: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may read everything")
    (tree / "sub").chmod(0)
    try:
        with pytest.raises(NotFoundError, match="cannot be read"):
            Folders((tree,)).list("data/sub")
    finally:
        (tree / "sub").chmod(0o755)


def test_recordings_are_recognised_and_a_folder_with_a_cloud_can_still_be_opened(tree: Path, generated: Path) -> None:
    entries = Folders((generated,)).list(generated.name).entries
    assert [(entry.name, entry.recording) for entry in entries] == [("hands", "rgbd_folder"), ("people", "rgbd_folder")]
    (tree / "sub" / "stray.npy").write_bytes(b"")
    entries = Folders((tree,)).list("data").entries
    shown = [(entry.name, entry.recording, entry.is_folder) for entry in entries]
    assert shown == [("inside", "cloud_folder", True), ("sub", "cloud_folder", True)]


def test_folders_through_the_api(live: Live, generated: Path) -> None:
    (top,) = live.client.get("/api/folders").json()["entries"]
    assert top == {"name": generated.name, "path": generated.name, "recording": None, "is_folder": True}
    inside = live.client.get("/api/folders", params={"path": generated.name}).json()
    assert [entry["name"] for entry in inside["entries"]] == ["hands", "people"]
    for target in ("folders", "bags"):
        answer = live.client.get(f"/api/{target}", params={"path": f"{generated.name}/../.."})
        assert (answer.status_code, answer.json()["error"]["kind"]) == (404, "NotFoundError")


def test_a_project_can_be_created_and_filled(
    live: Live, generated: Path, in_threads: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, place = live.client, "/api/projects/two/recordings"
    new = {"name": "two", "classes": ["person", "hand"], "rotation": "upright"}
    assert client.post("/api/projects", json=new).json()["classes"] == ["person", "hand"]
    added = client.post(place, json={"path": f"{generated.name}/people"}).json()
    facts = {"id": 1, "name": "people", "format": "rgbd_folder", "frames": 5, "missing": False, "rig_id": 1}
    assert added["added"][0]["recording"] == facts
    assert client.get("/api/projects/two").json()["frames"] == 5, "its frames are available at once"
    done = ended(live, added["job"])
    assert (done["state"], done["message"], done["total"]) == ("done", "imported as labels: 15 person in 5 frames", 5)
    assert done["result"] == {"frames": 5, "boxes": 15, "unknown": {}, "recordings": [1]}
    again = client.post(place, json={"path": f"{generated.name}/people", "labels": False}).json()
    assert (again["added"][0]["is_new"], again["added"][0]["new_frames"], again["job"]) == (False, 0, None)
    monkeypatch.setattr("annotator.web.jobs.runner.MOST_WAITING", 0)
    full = client.post(place, json={"path": f"{generated.name}/hands"}).json()
    assert (full["added"][0]["new_frames"], full["job"]) == (5, None), "the recording is added without a job"
    assert "0 jobs are waiting already; stop some" in full["note"]
    info = client.get("/api/projects/two").json()
    assert info["settings"]["rotation"] == "upright"
    assert info["detectors"] == {"image": None, "view": None, "stand_in": None}
    assert sum(info["labels_by_state"].values()) == 15
    listed = {entry["name"]: entry for entry in client.get("/api/projects").json()}
    assert set(listed) == {"room", "two"}
    assert (listed["two"]["frames"], listed["two"]["recordings"]) == (10, 2)


def test_boxes_of_unknown_classes_are_told_and_imported_as_chosen(
    live: Live, generated: Path, in_threads: None
) -> None:
    client = live.client
    client.post("/api/projects", json={"name": "two", "classes": ["hand"]})
    added = client.post("/api/projects/two/recordings", json={"path": f"{generated.name}/people"}).json()
    result = ended(live, added["job"])["result"]
    assert result == {"frames": 5, "boxes": 0, "unknown": {"person": 15}, "recordings": [1]}
    again = {"kind": "import", "recordings": [1], "names": {"person": "hand"}}
    done = ended(live, client.post("/api/projects/two/jobs", json=again).json())
    assert done["message"] == "imported as labels: 15 hand in 5 frames"


def _stale(place: Path) -> Callable[..., os.stat_result]:
    """A `Path.stat` for which `place` is on a lost mount."""
    stat = Path.stat

    def asked(path: Path, **options: bool) -> os.stat_result:
        if path == place:
            raise OSError(errno.ESTALE, "Stale file handle")
        return stat(path, **options)

    return asked


def test_broken_frames_are_told_and_left_out(live: Live, own_copy: Callable[[str], Path], tmp_path: Path) -> None:
    folder = own_copy("people")
    (folder / "depth" / "000001.png").write_bytes(b"")
    with running(replace(live.settings, projects_root=tmp_path / "others", folders=(tmp_path,))) as server:
        client, body = server.client, {"path": f"{tmp_path.name}/people", "labels": False}
        client.post("/api/projects", json={"name": "two", "classes": ["person"]})
        (added,) = client.post("/api/projects/two/recordings", json=body).json()["added"]
        assert (added["recording"]["frames"], added["left_out"], added["can_leave_out"]) == (5, 0, True)
        assert [line.partition(";")[0] for line in added["broken"]] == [
            "1 of 5 frames cannot be read",
            f"1 frame (000001): {tmp_path.name}/people/depth/000001.png: the file is empty",
        ]
        (added,) = client.post("/api/projects/two/recordings", json=body | {"leave_out_broken": True}).json()["added"]
        assert (added["recording"]["frames"], added["left_out"], added["can_leave_out"]) == (4, 1, False)


def test_a_moved_recording_is_located(generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its frames can be read at once; on a lost mount, the reason is told."""
    root, place = tmp_path / "takes", "/api/projects/two/recordings/1"
    shutil.copytree(generated / "people", root / "people")
    with running(ServerSettings(tmp_path / "others", (root,), port=0)) as server:
        client = server.client
        client.post("/api/projects", json={"name": "two", "classes": ["person"]})
        client.post("/api/projects/two/recordings", json={"path": "takes/people", "labels": False})
        before = client.get("/api/projects/two/frames/1").json()
        (root / "archive").mkdir()
        (root / "people").rename(root / "archive" / "2024")
        with monkeypatch.context() as gone_mount:
            gone_mount.setattr(Path, "stat", _stale(root / "people"))
            gone = client.get("/api/projects/two/frames/3").json()["error"]["message"]
            assert gone.startswith("takes/people: cannot be read (Stale file handle); restore people, or")
        (listed,) = client.get("/api/projects").json()
        assert (listed["problem"], listed["missing"]) == (None, [{"id": 1, "name": "people"}])
        gone = client.get("/api/projects/two/frames/3").json()["error"]["message"]
        assert gone.startswith("takes/people: no such file or folder; restore people, or give its new path")
        for path, status in (("takes/archive", 400), ("../takes", 404)):
            assert client.patch(place, json={"path": path}).status_code == status
        moved = client.patch(place, json={"path": "takes/archive/2024"}).json()
        assert (moved["name"], moved["frames"], moved["missing"]) == ("people", 5, False)
        assert client.get("/api/projects/two/frames/1").json() == before
        assert client.get("/api/projects/two/frames/3").status_code == 200


REFUSED = [
    ("POST", "/api/projects", {"name": "room", "classes": ["a"]}, 400),
    ("POST", "/api/projects", {"name": "new", "classes": []}, 422),
    ("POST", "/api/projects", {"name": "new", "classes": ["a"], "more": 1}, 422),
    ("GET", "/api/projects/nobody", None, 404),
    ("PATCH", "/api/projects/room", {"classes": ["a", "a"]}, 400),
    ("POST", "/api/projects/room/recordings", {"path": "../people"}, 404),
    ("POST", "/api/projects/room/recordings", {"path": ""}, 422),
]


def test_invalid_requests_are_refused(live: Live, generated: Path) -> None:
    no_recording = ("POST", "/api/projects/room/recordings", {"path": generated.name}, 400)
    for method, path, body, status in (*REFUSED, no_recording):
        answer = live.client.request(method, path, json=body)
        assert answer.status_code == status, answer.text
        assert set(answer.json()["error"]) == {"kind", "message"}
    live.client.delete("/api/session")
    for path in ("/api/folders", "/api/projects", "/api/projects/room"):
        answer = live.client.get(path)
        assert (answer.status_code, answer.json()["error"]["kind"]) == (401, "NotSignedInError")


ROOM = "/api/projects/room"


def error(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["error"]["message"]


def label_one(live: Live) -> None:
    change(live.client, state(live.client)["frame"]["revision"], {"kind": "create", "label": "person", "box": BOX})


def test_a_renamed_project_keeps_its_labels_and_jobs(live: Live) -> None:
    label_one(live)
    job = done_export(live)
    live.client.post("/api/projects", json={"name": "taken", "classes": ["person"]})
    for name, status in (("taken", 400), ("No good", 400), ("x" * 65, 422)):
        assert live.client.post(f"{ROOM}/rename", json={"name": name}).status_code == status
    assert "choose another name" in error(live.client.post(f"{ROOM}/rename", json={"name": "taken"}))[1]

    with listen(live) as socket:
        renamed = live.client.post(f"{ROOM}/rename", json={"name": "hall"})
        assert next_of(socket, "renamed")["name"] == "hall"
    assert renamed.json()["labels_by_state"]["accepted"] == 1
    assert live.client.get(ROOM).status_code == 404
    assert len(live.client.get("/api/projects/hall/frames/1").json()["labels"]) == 1
    listed = {each["id"]: each["project"] for each in live.client.get("/api/jobs").json()}
    assert listed[job.id] == "hall"
    assert live.client.get(f"/api/jobs/{job.id}/download").status_code == 200


def test_a_sample_is_generated_once_and_can_be_read_also_from_other_computers(
    live: Live, in_threads: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("annotator.workflows.sample.FRAMES", 2)
    monkeypatch.setattr("annotator.web.context.is_loopback", lambda host: False)
    with running(replace(live.settings, projects_root=tmp_path / "others")) as server:
        first = server.client.post("/api/sample-project").json()
        assert ended(server, first["job"])["message"] == "2 frames generated"
        second = server.client.post("/api/sample-project").json()
        assert (first["name"], second) == ("sample", {"name": "sample-2", "job": None})
        for name in ("sample", "sample-2"):
            assert server.client.get(f"/api/projects/{name}/frames/1").status_code == 200
        listed = server.client.get("/api/projects").json()
        facts = [(each["name"], each["frames"], each["frames_done"], each["first_frame"]) for each in listed]
        assert facts == [("sample", 2, 0, 1), ("sample-2", 2, 0, 1)]


def test_a_removed_project_is_listed_and_brought_back_unless_its_name_is_taken(live: Live) -> None:
    label_one(live)
    removed = live.client.delete(ROOM).json()
    assert (removed["name"], live.client.get(ROOM).status_code) == ("room", 404)
    assert live.client.get("/api/removed-projects").json() == [removed]
    restore = f"/api/removed-projects/{removed['id']}/restore"
    live.client.post("/api/projects", json={"name": "room", "classes": ["person"]})
    assert live.client.post(restore).status_code == 400
    live.client.post(f"{ROOM}/rename", json={"name": "other"})
    assert live.client.post(restore).json()["labels_by_state"]["accepted"] == 1
    assert (live.client.get("/api/removed-projects").json(), live.client.post(restore).status_code) == ([], 404)


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
