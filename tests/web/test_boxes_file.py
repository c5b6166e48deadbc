"""2D boxes from a file that the page has sent: what it has, and the job that imports it."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import pytest
from coco_sample import coco
from room_api import ROOM

from annotator.project import Project, WriteContext
from annotator.project.event_types import ImageBoxesSet
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError, NotFoundError
from annotator.web import security, uploads
from annotator.web.jobs import work
from annotator.web.jobs.job_context import JobContext
from annotator.web.jobs.records import BoxesRequest
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.workflows.detectors import Detectors

FILES = f"{ROOM}/boxes-files"


def packed(texts: dict[str, str]) -> bytes:
    """A .zip of files; "__" in a name stands for "/", "_" before the suffix for "."."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, text in texts.items():
            archive.writestr(name, text)
    return content.getvalue()


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
    }
    assert live.client.get(f"{FILES}/{sent['id']}").json() == sent
    assert project.boxes.on_images() == (), "nothing is stored yet"
    done = run(project, tmp_path, upload=sent["id"], names={"Person": "person"}, box_kind="box")
    assert done.message == (
        f"{people} 2D boxes on 2 images imported, 1 boxes of other classes left out (dog), "
        "1 images without a frame left out"
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
    run(project, tmp_path, upload=sent["id"])
    undo, _ = project.history.next("Ada")
    assert undo == f"import 2D boxes (frames {first.key} to {second.key})"
    project.history.undo("Ada")
    (left,) = project.boxes.on_images()
    assert (left.frame_id, left.author, len(left.boxes)) == (second.id, "Bob", 1)
    project.history.redo("Ada")
    assert {boxes.author for boxes in project.boxes.on_images()} == {"Ada"}
    assert project.history.next("Bob")[0] is not None, "what another operator drew is not part of it"


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
        ("boxes.txt", b"0 0.5 0.5 0.1 0.1", "neither a COCO file (.json) nor a packed"),
        ("boxes.json", b"{", "boxes.json"),
        ("boxes.json", b'{"images": [], "annotations": [], "categories": []}', "none of the dataset's images"),
        ("set.zip", b"PK no zip", "cannot be unpacked"),
        ("set.zip", packed({"a.png": "x"}), "contains no dataset of 2D boxes"),
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
    monkeypatch.setattr(uploads, "MOST_BYTES", 10)
    message = send(live, "set.zip", packed({"classes.txt": "person and more\n"}), 400)["error"]["message"]
    assert "divide it" in message


def test_only_the_latest_files_are_kept(live: Live, generated: Path) -> None:
    project, content = live.context.project("room"), json.dumps(coco(generated)).encode()
    ids = [uploads.add_upload(project, "boxes.json", content).id for _ in range(uploads.MOST_KEPT + 1)]
    with pytest.raises(NotFoundError, match="choose it again"):
        uploads.find_upload(project, ids[0])
    assert uploads.find_upload(project, ids[-1]).path.name == "boxes.json"


def test_a_file_may_be_larger_than_other_requests(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    assert security.UPLOAD_LIMIT > security.BODY_LIMIT
    monkeypatch.setattr(security, "UPLOAD_LIMIT", security.BODY_LIMIT + 20)
    filled = b"[" + b" " * security.BODY_LIMIT
    assert "boxes.json" in send(live, "boxes.json", filled, 400)["error"]["message"]
    assert send(live, "boxes.json", filled + b" " * 20, 413)["error"]["kind"] == "TooLargeError"
    assert live.client.post(f"{ROOM}/jobs", content=filled).status_code == 413


def test_a_job_without_a_class_of_the_project_changes_nothing(live: Live, generated: Path, tmp_path: Path) -> None:
    project = live.context.project("room")
    sent = send(live, "boxes.json", json.dumps(coco(generated)).encode())
    with pytest.raises(FormatError, match="none of the dataset's classes is in the project"):
        run(project, tmp_path, upload=sent["id"])
    assert project.boxes.on_images() == ()
    assert live.client.get(f"{FILES}/{sent['id']}").status_code == 200, "another try needs no new upload"
