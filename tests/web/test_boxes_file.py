"""2D boxes from a file that the page has sent: what it has, and the job that imports it."""

from __future__ import annotations

import io
import itertools
import json
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from live_server import PATIENCE_S, ended, look
from room_api import ROOM, coco

from annotator.project import Project, StoredFrame, WriteContext
from annotator.project.event_types import ImageBoxesSet
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import NotFoundError
from annotator.web import security, uploads
from annotator.web.jobs import work
from annotator.web.jobs.records import LIFT_STAGE, WORK, BoxesRequest, JobContext
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.workflows.detectors import Detectors

FILES = f"{ROOM}/boxes-files"
# Two images of one frame.
TWICE = json.dumps(
    {
        "images": [
            {"id": i, "file_name": f"{part}/000000.jpg", "width": 320, "height": 240} for i, part in enumerate("ab")
        ],
        "annotations": [],
        "categories": [{"id": 1, "name": "person"}],
    }
).encode()

# The labels of one frame in SUSTechPOINTS.
PSR = json.dumps(
    [
        {
            "obj_type": "person",
            "psr": {name: {"x": 1.0, "y": 1.0, "z": 1.0} for name in ("position", "scale", "rotation")},
        }
    ]
)


def packed(texts: dict[str, str]) -> bytes:
    """A .zip of files; "__" in a name stands for "/", "_" before the suffix for "."."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, text in texts.items():
            archive.writestr(name, text)
    return content.getvalue()


def damaged() -> bytes:
    """A .zip whose compressed data are damaged."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.json", json.dumps(list(range(1000))))
    changed = bytearray(content.getvalue())
    changed[60:100] = b"\xff" * 40
    return bytes(changed)


def send(live: Live, name: str, content: bytes, status: int = 201) -> dict[str, Any]:
    answer = live.client.post(FILES, params={"name": name}, content=content)
    assert answer.status_code == status, answer.text
    found: dict[str, Any] = answer.json()
    return found


def run(project: Project, folder: Path, operator: str = "Ada", **request: Any) -> work.Outcome:
    job = JobContext(project, folder, operator, lambda _: None, lambda: False)
    return work.boxes_work(job, BoxesRequest(kind="boxes", **request))


def test_a_coco_file_is_described_before_it_is_imported(live: Live, generated: Path, tmp_path: Path) -> None:
    project = live.context.project("room")
    sent = send(live, "street boxes.json", json.dumps(coco(generated)).encode())
    people = sent["boxes"]["Person"]
    assert people >= 2
    assert sent == {
        "id": sent["id"],
        "name": "street_boxes.json",
        "format": "coco",
        "images": 3,
        "unmatched": 1,
        "unmatched_names": ["elsewhere.jpg"],
        "ambiguous": 0,
        "boxes": {"Person": people, "dog": 1},
        "replaced": 0,
        "labelled": None,
        "finalised": None,
        "scores": None,
        "source": "street_boxes",
        "renamed": None,
        "taken_for": [],
    }
    assert live.client.get(f"{FILES}/{sent['id']}").json() == sent
    assert project.boxes.on_images() == (), "nothing is stored yet"
    done = run(project, tmp_path, upload=sent["id"], names={"Person": "person"}, box_kind="box")
    assert done.message == (
        f"{people} 2D boxes on 2 images imported, 1 box of other classes left out (dog), "
        "1 image without a frame left out"
    )
    drawn = project.boxes.on_images()
    assert [len(boxes.boxes) for boxes in drawn] and sum(len(boxes.boxes) for boxes in drawn) == people
    assert {(boxes.author, boxes.source, boxes.box_kind) for boxes in drawn} == {("Ada", Source.IMPORTED, BoxKind.BOX)}
    assert live.client.get(f"{FILES}/{sent['id']}").status_code == 404, "the file is not kept"


def test_an_import_is_undone_as_one_action(live: Live, generated: Path, tmp_path: Path) -> None:
    project = live.context.project("room")
    first, second = project.frames.of()[:2]
    drawn = ImageBoxesSet(boxes=(Box2D("person", 1.0, 2.0, 30.0, 40.0),), box_kind=BoxKind.SILHOUETTE)
    project.log.append(second.id, [drawn], WriteContext(second.revision, "Bob"))
    sent = send(live, "boxes.json", json.dumps(coco(generated, "person")).encode())
    assert sent["replaced"] == 1
    done = run(project, tmp_path, upload=sent["id"])
    assert "the drawn boxes on 1 image replaced" in done.message and done.result["replaced"] == 1
    undo, _ = project.history.next("Ada")
    assert undo == f"import 2D boxes (frames {first.key} to {second.key})"
    project.history.undo("Ada")
    (left,) = project.boxes.on_images()
    assert (left.frame_id, left.author, len(left.boxes)) == (second.id, "Bob", 1)
    project.history.redo("Ada")
    assert {boxes.author for boxes in project.boxes.on_images()} == {"Ada"}
    assert project.history.next("Bob")[0] is not None, "what another operator drew is not part of it"


@pytest.mark.parametrize("is_packed", [False, True])
def test_3d_boxes_are_described_and_become_proposals_or_labels_as_one_step(
    live: Live, tmp_path: Path, is_packed: bool
) -> None:
    project = live.context.project("room")
    first, second = (frame.key for frame in project.frames.of()[:2])
    if is_packed:
        row = "Car 0 0 0 10 10 50 50 1.5 1.6 4.0 {} 1.0 9.0 0.1 {}\n"
        rows = {first: row.format(0.0, -2.5) + row.format(5.0, 7.5), second: "", "elsewhere": ""}
        sent = send(live, "mine.zip", packed({f"label_2/{key}.txt": text for key, text in rows.items()}))
        low, high = -2.5, 7.5
        said = (
            "scores from -2.5 to 7.5 are now 0 to 1, 2 values of attributes left out: "
            "occlusion (not an attribute of the project; exports measure it), "
            "truncation (not an attribute of the project; exports measure it), "
        )
    else:
        entry = {"label": "Car", "size": [4.0, 1.6, 1.5], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
        boxes = [entry | {"center": [x, 0.0, 9.0], "score": score} for x, score in ((0.0, 0.25), (5.0, 0.75))]
        sent = send(live, "mine.json", json.dumps({first: boxes, second: [], "elsewhere": []}).encode())
        low, high, said = 0.25, 0.75, ""
    known = {key: sent[key] for key in ("images", "unmatched_names", "boxes", "labelled", "scores", "source")}
    assert known == {
        "images": 3,
        "unmatched_names": ["elsewhere"],
        "boxes": {"Car": 2},
        "labelled": 0,
        "scores": [low, high],
        "source": sent["name"].removesuffix(".json"),
    }
    done = run(project, tmp_path, upload=sent["id"], names={"Car": "person"}, source="mine", min_score=low + 0.1)
    assert done.message == (
        f"1 box of mine proposed in 2 frames, 1 box with a lower score left out, {said}"
        "1 frame that the project does not have left out"
    )
    (stored,) = project.labels.select()
    assert ([each.source for each in stored.said], stored.label.state.value) == (["mine"], "proposed")
    assert project.history.next("Ada")[0] == f"import boxes of mine (frames {first} to {second})"
    project.history.undo("Ada")
    assert project.labels.select() == ()
    if is_packed:
        return
    sent = send(live, "mine.json", json.dumps({first: boxes, second: boxes}).encode())
    done = run(project, tmp_path, upload=sent["id"], names={"Car": "person"}, become="labels")
    assert done.message == "4 labels imported in 2 frames"
    assert {each.label.author for each in project.labels.select()} == {"Ada"}
    assert send(live, "more.json", json.dumps({first: boxes}).encode())["labelled"] == 1
    assert project.history.next("Ada")[0] == f"import 3D boxes (frames {first} to {second})"
    project.history.undo("Ada")
    assert project.labels.select() == ()


def test_frames_that_an_import_leaves_unchanged_are_counted_before(live: Live, tmp_path: Path) -> None:
    """As labels: also those with proposals, and with rejected boxes only; as proposals: those that are finalised."""
    project = live.context.project("room")
    proposed, rejected, finalised, free = project.frames.of()[:4]
    entry = {"label": "person", "size": [4.0, 1.6, 1.5], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
    entry |= {"center": [0.0, 0.0, 9.0]}

    def sent(*frames: StoredFrame) -> dict[str, Any]:
        return send(live, "mine.json", json.dumps({frame.key: [entry] for frame in frames}).encode())

    run(project, tmp_path, upload=sent(proposed, rejected)["id"], become="proposals", source="mine")
    (uid,) = (label.uid for label in project.labels.of_frame(rejected.id))
    project.labels.reject(rejected.id, uid, WriteContext(project.frames.get(rejected.id).revision, "Bob"))
    project.frames.finalise(finalised.id, WriteContext(project.frames.get(finalised.id).revision, "Bob"))
    for become in ("labels", "proposals"):
        found = sent(proposed, rejected, finalised, free)
        assert (found["labelled"], found["finalised"]) == (3, 1)
        done = run(project, tmp_path, upload=found["id"], become=become, source="yours").message
        left = {"labels": "3 frames with labels or proposals", "proposals": "1 finalised frame"}[become]
        assert f"{left} left unchanged" in done
        project.history.undo("Ada")


@pytest.mark.usefixtures("in_threads")
def test_nothing_is_undone_while_an_import_stores_its_boxes(
    live: Live, generated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What an import stores after the undo of its action could not be undone."""
    monkeypatch.setitem(WORK, "boxes", "fake_jobs:boxes")
    project = live.context.project("room")
    sent = send(live, "boxes.json", json.dumps(coco(generated, "person")).encode())
    job = live.client.post(f"{ROOM}/jobs", json={"kind": "boxes", "upload": sent["id"]}).json()
    wait_for(live, job, "store the 2D boxes")
    assert live.context.jobs.uploads_in_use(project.path) == {sent["id"]}
    for step in ("undo", "redo"):
        refused = live.client.post(f"{ROOM}/{step}", json={})
        assert refused.status_code == 409
        assert "your import of boxes is still running" in refused.json()["error"]["message"]
    assert not live.context.jobs.stores_boxes("room", "Bob"), "other operators can undo what is theirs"
    (project.path / "go_on").touch()
    wait_for(live, job, LIFT_STAGE)
    assert "still running" not in live.client.post(f"{ROOM}/undo", json={}).json()["error"]["message"]
    live.client.post(f"/api/jobs/{job['id']}/cancel")
    ended(live, job)
    assert live.context.jobs.uploads_in_use(project.path) == set()


def wait_for(live: Live, job: dict[str, Any], stage: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while (now := look(live, job["id"]))["stage"] != stage:
        assert time.monotonic() < end and now["state"] in ("queued", "running"), now
        time.sleep(0.05)


def test_3d_boxes_are_proposed_from_the_file(
    live: Live, generated: Path, tmp_path: Path, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    project = live.context.project("room")
    sent = send(live, "boxes.json", json.dumps(coco(generated)).encode())
    perfect = ReadyDetector(knowing("people").view, BoxKind.BOX, Lock())
    monkeypatch.setattr(work, "require_view", lambda _: perfect)
    done = run(project, tmp_path, upload=sent["id"], names={"Person": "person"}, lift=True)
    assert done.result["proposals"] == sent["boxes"]["Person"] and done.result["failures"] == 0
    assert done.message.endswith("proposals in 2 frames, measured by: this project's view detector")
    assert len(project.labels.select()) == sent["boxes"]["Person"]


def test_a_packed_yolo_folder(live: Live, tmp_path: Path) -> None:
    project = live.context.project("room")
    key = project.frames.of()[0].key
    files = {"set/data.yaml": "train: images\nnames: [person, dog]\n", "set/images/big.png": "no image"}
    files[f"set/labels/{key}.txt"] = "0 0.5 0.5 0.2 0.4\n1 0.2 0.2 0.1 0.1\n"
    sent = send(live, "set.zip", packed(files))
    assert (sent["format"], sent["boxes"]) == ("yolo", {"dog": 1, "person": 1})
    assert not list(project.path.rglob("big.png")), "images are not unpacked"
    run(project, tmp_path, upload=sent["id"])
    (drawn,) = project.boxes.on_images()
    assert [box.label for box in drawn.boxes] == ["person"]


@pytest.mark.parametrize("is_packed", [False, True])
def test_a_box_csv(live: Live, tmp_path: Path, is_packed: bool) -> None:
    project = live.context.project("room")
    key = project.frames.of()[0].key
    rows = f"image,class,cx,cy,cz,l,w,h,yaw,score\n{key},person,0,3,0,1,1,1,0,0.25\n"
    sent = send(live, "mine.zip", packed({"a/mine.csv": rows})) if is_packed else send(live, "mine.csv", rows.encode())
    assert (sent["format"], sent["boxes"], sent["scores"]) == ("box-csv", {"person": 1}, [0.25, 0.25])
    assert run(project, tmp_path, upload=sent["id"], become="proposals").result["boxes"] == 1


@pytest.mark.parametrize("folder", ["", "data/room/label/"])
def test_a_packed_scene_with_labels_of_one_frame(live: Live, tmp_path: Path, folder: str) -> None:
    project = live.context.project("room")
    key = project.frames.of()[0].key
    sent = send(live, "room.zip", packed({f"{folder}{key}.json": PSR}))
    assert (sent["format"], sent["images"], sent["boxes"]) == ("sustechpoints", 1, {"person": 1})
    assert run(project, tmp_path, upload=sent["id"], become="labels").result["boxes"] == 1


def test_no_message_has_the_folder_of_an_upload(live: Live) -> None:
    folder = live.context.project("room").path / uploads.FOLDER / ("0f" * 16)
    said = live.context.public_message(f"{folder}/a/b.json: no boxes; give the folder of all: {folder}; see {folder}.")
    assert said == (
        "a/b.json: no boxes; give the folder of all: the folder that was sent; see the folder that was sent."
    )


def test_a_zip_of_macos_with_labels_beside_the_images(live: Live, tmp_path: Path) -> None:
    project = live.context.project("room")
    key = project.frames.of()[0].key
    files = {"set/classes.txt": "person\n", f"set/{key}.txt": "0 0.5 0.5 0.2 0.4\n"}
    hidden = {"__MACOSX/set/._classes.txt": "\x00\x05", f"__MACOSX/set/{key}.txt": "\x00", f"set/._{key}.txt": "\x00"}
    sent = send(live, "set.zip", packed(files | hidden))
    assert sent["boxes"] == {"person": 1}
    assert run(project, tmp_path, upload=sent["id"]).result["boxes"] == 1


def test_images_of_several_recordings_need_a_choice(live: Live, generated: Path) -> None:
    project = live.context.project("room")
    register_recording(project, open_recording(generated / "hands"))
    sent = send(live, "boxes.json", json.dumps(coco(generated)).encode())
    assert sent["ambiguous"] == 2
    first = project.recordings.all()[0].id
    assert live.client.get(f"{FILES}/{sent['id']}", params={"recording": first}).json()["ambiguous"] == 0
    assert live.client.get(f"{FILES}/{sent['id']}", params={"recording": 99}).status_code == 404


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("boxes.txt", b"0 0.5 0.5 0.1 0.1", "neither a file of boxes (.json, .csv) nor a packed"),
        ("boxes.csv", b"id,recording,key\n", "boxes.csv:1: the first line must name the columns image,class,cx"),
        ("boxes.json", b"{", "boxes.json"),
        ("boxes.json", b'{"images": [], "annotations": [], "categories": []}', "none of the dataset's images"),
        ("0.json", PSR.encode(), "0.json: has the labels of one frame; pack the folder of all frames as .zip"),
        ("set.zip", b"PK no zip", "cannot be unpacked"),
        ("set.zip", damaged(), "cannot be unpacked"),
        ("boxes.json", TWICE, "a/000000.jpg and b/000000.jpg both match frame 000000; keep one of them"),
        ("set.zip", packed({"a.png": "x"}), "contains no dataset of boxes"),
        ("set.zip", packed({"../../../out.json": "{}"}), "leads out of its folder"),
        ("set.zip", packed({"classes.txt": "person\n", "1.txt": "0 0.5\n"}), "1.txt"),
    ],
)  # fmt: skip
def test_files_that_cannot_be_imported_say_why_and_are_not_kept(
    live: Live, name: str, content: bytes, says: str
) -> None:
    message = send(live, name, content, 400)["error"]["message"]
    assert says in message
    assert str(live.context.project("room").path) not in message and uploads.FOLDER not in message
    assert list((live.context.project("room").path / uploads.FOLDER).glob("*")) == []


def test_a_packed_dataset_is_bounded(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    assert uploads.MOST_BYTES <= security.UPLOAD_LIMIT
    monkeypatch.setattr(uploads, "MOST_BYTES", 10)
    message = send(live, "set.zip", packed({"classes.txt": "person and more\n"}), 400)["error"]["message"]
    assert "divide it" in message


def test_only_the_latest_files_are_kept(live: Live, generated: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # all within one tick of the kernel's clock, by which a file system stamps
    times_ns = itertools.count(time.time_ns())
    monkeypatch.setattr(uploads, "time", SimpleNamespace(time_ns=lambda: next(times_ns)))
    project, content = live.context.project("room"), json.dumps(coco(generated)).encode()
    ids = [uploads.add_upload(project, "boxes.json", content).id for _ in range(uploads.MOST_KEPT + 1)]
    ages = [(project.path / uploads.FOLDER / upload_id).stat().st_mtime_ns for upload_id in ids[1:]]
    assert ages == list(range(ages[0], ages[0] + uploads.MOST_KEPT))
    with pytest.raises(NotFoundError, match="choose it again"):
        uploads.find_upload(project, ids[0])
    assert uploads.find_upload(project, ids[-1]).path.name == "boxes.json"
    for _ in range(uploads.MOST_KEPT + 1):
        uploads.add_upload(project, "boxes.json", content, in_use={ids[1]})
    assert uploads.find_upload(project, ids[1]), "a job still has to read it"
    with pytest.raises(NotFoundError):
        uploads.find_upload(project, ids[2])


def test_a_file_may_be_larger_than_other_requests(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    assert security.UPLOAD_LIMIT > security.BODY_LIMIT
    monkeypatch.setattr(security, "UPLOAD_LIMIT", security.BODY_LIMIT + 20)
    filled = b"[" + b" " * security.BODY_LIMIT
    assert "boxes.json" in send(live, "boxes.json", filled, 400)["error"]["message"]
    assert send(live, "boxes.json", filled + b" " * 20, 413)["error"]["kind"] == "TooLargeError"
    assert live.client.post(f"{ROOM}/jobs", content=filled).status_code == 413
