"""2D boxes from a file that the page has sent: what it has, and the job that imports it."""

from __future__ import annotations

import io
import json
import os
import re
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import pytest
from room_api import ROOM, coco

from annotator.project import Project, WriteContext, create_project
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError, NotFoundError
from annotator.web import security, uploads
from annotator.web.jobs import work
from annotator.web.jobs.records import BoxesRequest, JobContext, LiftRequest
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.importing import Preview, preview_boxes
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


def test_a_coco_file_is_described_imported_and_undone_as_one_action(
    live: Live, generated: Path, tmp_path: Path
) -> None:
    project = live.context.project("room")
    second = project.frames.of()[1]
    drawn = (Box2D("person", 1.0, 2.0, 30.0, 40.0),)
    project.boxes.set_on_image(second.id, drawn, BoxKind.SILHOUETTE, WriteContext(second.revision, "Bob"))
    sent = send(live, "street boxes.json", json.dumps(coco(generated)).encode())
    people = sent["boxes"]["Person"]
    facts = {"name": "street_boxes.json", "format": "coco", "is_3d": False, "ambiguous": 0, "scores": None}
    facts |= {"boxes": {"Person": people, "dog": 1}, "source": "street_boxes"}
    assert {key: sent[key] for key in facts} == facts
    assert sent["found"] == f"{people + 1} boxes on 2 images of this project's frames."
    assert sent["notes"][0] == "The import replaces the boxes drawn on 1 image."
    register_recording(project, open_recording(generated / "hands"))
    assert live.client.get(f"{FILES}/{sent['id']}").json()["ambiguous"] == 2
    recording = {"recording": project.recordings.all()[0].id}
    assert live.client.get(f"{FILES}/{sent['id']}", params=recording).json() == sent
    with pytest.raises(FormatError, match="none of the dataset's classes is in the project"):
        run(project, tmp_path, upload=sent["id"], names={"Person": ""}, **recording)
    # another try needs no new upload
    done = run(project, tmp_path, upload=sent["id"], box_kind="box", **recording)
    assert done.message.startswith(f"imported as 2D boxes: {people} person on 2 camera images; replaced: ")
    stored = project.boxes.on_images()
    assert {(boxes.author, boxes.source, boxes.box_kind) for boxes in stored} == {("Ada", Source.IMPORTED, BoxKind.BOX)}
    assert live.client.get(f"{FILES}/{sent['id']}").status_code == 404, "the file is not kept"
    project.history.undo("Ada")
    (left,) = project.boxes.on_images()
    assert (left.frame_id, left.author, len(left.boxes)) == (second.id, "Bob", 1)


def test_3d_boxes_are_described_and_become_proposals_or_labels_as_one_step(live: Live, tmp_path: Path) -> None:
    project = live.context.project("room")
    first, second = (frame.key for frame in project.frames.of()[:2])
    entry = {"label": "Car", "size": [4.0, 1.6, 1.5], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
    entry |= {"attributes": {"age": 7}}
    boxes = [entry | {"center": [x, 0.0, 9.0], "score": score} for x, score in ((0.0, 0.25), (5.0, 0.75))]
    content = json.dumps({first: boxes, second: [], "elsewhere": []}).encode()
    sent = send(live, "mine.json", content)
    assert (sent["is_3d"], sent["boxes"], sent["scores"], sent["source"]) == (True, {"Car": 2}, [0.25, 0.75], "mine")
    given = {"names": {"Car": "person"}, "source": "mine", "min_score": 0.5, "add_attributes": True}
    done = run(project, tmp_path, upload=sent["id"], **given)
    assert done.message.startswith("proposed by mine: 1 person in 2 frames; skipped: 1 box with a lower score; ")
    project.history.undo("Ada")
    assert project.labels.select() == ()
    again = send(live, "mine.json", content)["id"]
    done = run(project, tmp_path, upload=again, names={"Car": "person"}, become="labels")
    assert done.message.startswith("imported as labels: 2 person in 2 frames")
    assert {(each.label.author, each.label.attributes["age"]) for each in project.labels.select()} == {("Ada", 7)}
    project.history.undo("Ada")
    assert project.labels.select() == ()


def test_3d_boxes_are_proposed_from_2d_boxes_of_the_project(
    live: Live, generated: Path, tmp_path: Path, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = send(live, "boxes.json", json.dumps(coco(generated, "person")).encode())
    monkeypatch.setattr(work, "require_view", lambda _: ReadyDetector(knowing("people").view, BoxKind.BOX, Lock()))
    project = live.context.project("room")
    run(project, tmp_path, upload=sent["id"])
    assert live.client.get(f"{ROOM}/models").json()["material"]["to_lift"] == 2
    job = JobContext(project, tmp_path, "Ada", lambda _: None, lambda: False)
    assert work.lift_work(job, LiftRequest(kind="lift")).result["proposals"] == sent["boxes"]["person"]
    assert live.client.get(f"{ROOM}/models").json()["material"]["to_lift"] == 0


@pytest.fixture
def room(tmp_path: Path, generated: Path) -> Iterator[Project]:
    with create_project(tmp_path, "room", ["person"]) as project:
        register_recording(project, open_recording(generated / "people"))
        yield project


def read(project: Project, name: str, content: bytes) -> Preview:
    upload = uploads.add_upload(project, name, content)
    return preview_boxes(project, upload.path, upload.format, None)


@pytest.mark.parametrize(
    ("files", "boxes"),
    [
        (
            {
                "set/data.yaml": "train: images\nnames: [person, dog]\n",
                "set/images/big.png": "no image",
                "set/labels/KEY.txt": "0 0.5 0.5 0.2 0.4\n1 0.2 0.2 0.1 0.1\n",
            },
            {"dog": 1, "person": 1},
        ),
        ({"KEY.json": PSR}, {"person": 1}),
        # of macOS, with labels beside the images
        (
            {
                "set/classes.txt": "person\n",
                "set/KEY.txt": "0 0.5 0.5 0.2 0.4\n",
                "__MACOSX/set/._classes.txt": "\x00\x05",
                "__MACOSX/set/KEY.txt": "\x00",
                "set/._KEY.txt": "\x00",
            },
            {"person": 1},
        ),
    ],
    ids=["yolo", "one frame", "macos"],
)
def test_packed_folders(room: Project, files: dict[str, str], boxes: dict[str, int]) -> None:
    key = room.frames.of()[0].key
    content = packed({name.replace("KEY", key): text.replace("KEY", key) for name, text in files.items()})
    assert read(room, "set.zip", content).boxes == boxes
    assert not list(room.path.rglob("*.png")), "images are not unpacked"


def test_no_message_has_the_folder_of_an_upload(live: Live) -> None:
    project = live.context.project("room")
    folder = project.path / uploads.FOLDER / ("0f" * 16)
    said = live.context.public_message(f"{folder}/a/b.json: no boxes; give the folder of all: {folder}; see {folder}.")
    assert said == (
        "a/b.json: no boxes; give the folder of all: the folder that was sent; see the folder that was sent."
    )
    message = send(live, "boxes.json", TWICE, 400)["error"]["message"]
    assert message.startswith("boxes.json: a/000000.jpg and b/000000.jpg both match frame 000000; keep one of them")
    assert list((project.path / uploads.FOLDER).glob("*")) == [], "a file that cannot be imported is not kept"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("boxes.txt", b"0 0.5 0.5 0.1 0.1", "neither a file of boxes (.json, .csv) nor a packed"),
        ("boxes.json", b'{"images": [], "annotations": [], "categories": []}', "none of the dataset's images"),
        ("0.json", PSR.encode(), "0.json: has the labels of one frame; pack the folder of all frames as .zip"),
        ("set.zip", damaged(), "cannot be unpacked"),
        ("set.zip", packed({"a.png": "x"}), "contains no dataset of boxes"),
        ("set.zip", packed({"../../../out.json": "{}"}), "leads out of its folder"),
        ("set.zip", packed({"classes.txt": "person\n", "1.txt": "0 0.5\n"}), "1.txt"),
    ],
)
def test_files_that_cannot_be_imported_say_why(room: Project, name: str, content: bytes, says: str) -> None:
    with pytest.raises(FormatError, match=re.escape(says)):
        read(room, name, content)


def test_a_packed_dataset_is_bounded(room: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    assert uploads.MOST_BYTES <= security.UPLOAD_LIMIT
    for limit, files in (("MOST_BYTES", {"classes.txt": "person and more\n"}), ("MOST_FILES", dict.fromkeys("ab", ""))):
        with monkeypatch.context() as patch:
            patch.setattr(uploads, limit, 1)
            with pytest.raises(FormatError, match="divide it"):
                read(room, "set.zip", packed({f"{name}.txt": text for name, text in files.items()}))


def test_files_that_nobody_imports_are_kept_for_a_day(room: Project, generated: Path) -> None:
    content = json.dumps(coco(generated)).encode()
    ids = [uploads.add_upload(room, "boxes.json", content).id for _ in range(2)]
    for upload, age_s in zip(ids, (uploads.KEPT_S + 60, uploads.KEPT_S - 60), strict=True):
        os.utime(room.path / uploads.FOLDER / upload, (time.time() - age_s,) * 2)
    uploads.add_upload(room, "boxes.json", content)
    with pytest.raises(NotFoundError, match="choose it again"):
        uploads.find_upload(room, ids[0])
    assert uploads.find_upload(room, ids[1]).path.name == "boxes.json"


def test_a_file_may_be_larger_than_other_requests(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    assert security.UPLOAD_LIMIT > security.BODY_LIMIT
    monkeypatch.setattr(security, "UPLOAD_LIMIT", security.BODY_LIMIT + 20)
    filled = b"[" + b" " * security.BODY_LIMIT
    assert "boxes.json" in send(live, "boxes.json", filled, 400)["error"]["message"]
    assert send(live, "boxes.json", filled + b" " * 20, 413)["error"]["kind"] == "TooLargeError"
    assert live.client.post(f"{ROOM}/jobs", content=filled).status_code == 413
