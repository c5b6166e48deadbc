"""Label mode and boxes drawn in Review: what a drag stores and answers, and what follows from changed boxes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from drawing import Scene, as_json, draw_object
from room_api import BOX, ROOM, change, propose, state

from annotator.geometry.iou import iou_3d
from annotator.project import Project
from annotator.types import BoxKind, DetectorKind
from annotator.web.schemas import Box3DJson
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.workflows.detectors import Detectors


STEPS, SAVE = (f"/api/projects/room/frames/1/label/{name}" for name in ("steps", "object"))


@pytest.fixture
def silhouettes(live: Live, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch) -> None:
    """The project has a view detector that knows the objects' silhouettes."""
    detector = ReadyDetector(knowing("people", kind=BoxKind.SILHOUETTE).view, BoxKind.SILHOUETTE, Lock())
    ready = Readiness("ready", detector)
    monkeypatch.setattr(live.context.caches.detectors, "readiness", lambda project, role, wait_s=None: ready)


@pytest.mark.usefixtures("silhouettes")
def test_one_request_stores_a_drag_and_answers_with_all_that_follows(live: Live, generated: Path) -> None:
    image_box = Scene.of(generated / "people", 0, ["person"]).image_box(0)
    body = {"revision": 0, "image_boxes": [image_box], "object": {"image_box": image_box, "boxes": []}}
    saved = live.client.post(SAVE, json=body)
    assert saved.status_code == 200, saved.text
    answer, drawn = saved.json(), saved.json()["drawn"]
    assert answer["uid"] is None and answer["state"]["image_boxes"]["boxes"] == [image_box]
    suggested = [box for step in drawn["steps"] for box in step["suggested"]]
    assert len(suggested) == 4 and None not in suggested
    assert drawn["box"] is not None and drawn["measured_by"] == "this project's view detector"
    plain = live.client.post(STEPS, json={"image_box": image_box, "boxes": [], "suggest": False}).json()
    assert [step["suggested"] for step in plain["steps"]] == [[None, None]]
    # Enter: the suggestions become the object's boxes, and its label is the box that was shown
    boxes, axes = suggested, drawn["steps"][1]["views"][0]["axes"]
    accepted = {**body, "revision": 1, "object": {"image_box": image_box, "boxes": boxes, "axes": axes}}
    finished = live.client.post(SAVE, json=accepted)
    assert finished.status_code == 200, finished.text
    (label,) = finished.json()["state"]["labels"]
    assert label["uid"] == finished.json()["uid"] is not None
    for part in ("center", "size"):
        np.testing.assert_allclose(label["box"][part], drawn["box"][part], atol=1e-9)


def test_a_failed_detector_is_reported_with_its_problem(live: Live, generated: Path, tmp_path: Path) -> None:
    project = live.context.project("room")
    weights = project.models_folder / "broken" / "best.pt"
    weights.parent.mkdir()
    weights.write_bytes(b"no weights")
    for role in DetectorKind:
        project.models.register(
            role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=f"broken {role.value}"
        )
    live.context.caches.detectors.readiness(project, DetectorKind.VIEW)
    body = {"image_box": Scene.of(generated / "people", 0, ["person"]).image_box(0), "boxes": []}
    for suggest in (False, True):
        found = live.client.post(STEPS, json={**body, "suggest": suggest}).json()
        assert found["detector"] == "failed" and "model.json: no such file" in found["problem"]
        assert len(found["steps"][0]["views"]) == 2
    suggestions = live.client.get("/api/projects/room/frames/1/label/suggestions").json()
    assert suggestions["boxes"] == [] and "model.json: no such file" in suggestions["problem"]
    # the same in Review
    box = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "quaternion": [0.9, 0.1, 0.4, 0.1]}
    frame = "/api/projects/room/frames/1"
    for tool, request in (("refit", {"box": box, "label": "person"}), ("fit", {"image_box": body["image_box"]})):
        note = live.client.post(f"{frame}/{tool}", json=request).json()["note"]
        assert "no pseudo-view detector: " in note and "model.json: no such file" in note
        assert str(tmp_path) not in note


FRAME = "/api/projects/room/frames/1"


@pytest.fixture
def scene(generated: Path) -> Scene:
    return Scene.of(generated / "people", 0, ("person",))


@pytest.fixture
def taught(live: Live, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch) -> Live:
    """A server whose project has a view detector with ground-truth detections."""
    ready = Readiness("ready", ReadyDetector(knowing("people", kind=BoxKind.BOX).view, BoxKind.BOX, Lock()))
    answer = lambda project, role, wait_s=None: ready if role is DetectorKind.VIEW else Readiness("none")  # noqa: E731
    monkeypatch.setattr(live.context.caches.detectors, "readiness", answer)
    return live


def fit(live: Live, image_box: dict[str, Any]) -> dict[str, Any]:
    answer = live.client.post(f"{FRAME}/fit", json={"image_box": image_box})
    assert answer.status_code == 200, answer.text
    fitted: dict[str, Any] = answer.json()
    return fitted


def test_a_drawn_box_is_fitted_and_its_label_counts_as_drawn(taught: Live, scene: Scene) -> None:
    image_box = {**scene.image_box(0), "score": 0.0}  # a drawn box has no detector confidence
    found = fit(taught, image_box)
    box = Box3DJson(**found["box"]).box()
    assert iou_3d(box, scene.objects[0].box) > 0.8
    assert found["note"] is None and found["points"] > 100 and len(found["outline"]) > 0
    assert 0 < found["quality"]["image_agreement"] <= 1
    assert taught.client.get(FRAME).json()["labels"] == []  # nothing is stored yet

    created = {"kind": "create", "label": "person", "box": found["box"], "image_box": image_box}
    created["suggestion"] = found["suggestion"]
    body = {"revision": 0, "changes": [created], "effort": {"actions": 2, "seconds": 4.0}}
    answer = taught.client.post(f"{FRAME}/changes", json=body)
    assert answer.status_code == 200, answer.text
    (label,) = answer.json()["labels"]
    assert (label["state"], label["author"]) == ("accepted", "Ada")
    assert label["suggestion"] == found["suggestion"]
    assert (label["suggestion"]["detector"], label["suggestion"]["corrected"]) == (
        "this project's view detector",
        False,
    )
    np.testing.assert_allclose(label["box"]["center"], found["box"]["center"], atol=1e-9)
    stored = taught.context.project("room").labels.get(label["uid"])
    assert stored.image_box is not None and stored.image_box.xyxy == tuple(
        image_box[edge] for edge in ("x_min", "y_min", "x_max", "y_max")
    )
    effort = taught.client.get("/api/projects/room/statistics").json()["effort"]["by_origin"]
    assert effort["from nothing"] == {"boxes": 1, "seconds_a_box": 4.0, "actions_a_box": 2.0}


def test_without_a_detector_the_answer_says_so(live: Live, scene: Scene) -> None:
    found = fit(live, scene.image_box(0))
    assert (found["note"], found["too_few_points"]) == ("there is no pseudo-view detector yet", False)
    corner = fit(live, {"label": "person", "x_min": 0.0, "y_min": 0.0, "x_max": 3.0, "y_max": 3.0})
    assert (corner["note"], corner["too_few_points"]) == ("fewer than 5 points lie in this box", True)


@pytest.fixture
def project(live: Live) -> Project:
    return live.context.project("room")


def training_data(project: Project) -> tuple[int, list[str], int]:
    """The detectors' training data: number of boxes on images, kinds of boxes on views, number of 3D labels."""
    on_images = sum(len(boxes.boxes) for boxes in project.boxes.on_images())
    kinds = sorted(view.box_kind.value for view in project.boxes.on_views() for _ in view.boxes)
    return on_images, kinds, len(project.labels.select())


def test_rejecting_a_drawn_label_in_review_removes_its_boxes(live: Live, project: Project, generated: Path) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    uids = [draw_object(live.client, "room", 1, scene, number)["uid"] for number in range(2)]
    drawn = state(live.client)
    (proposed,) = propose(project, 1, 5.0)
    revision = state(live.client)["frame"]["revision"]
    both = [{"kind": "reject", "uid": uids[0]}, {"kind": "reject", "uid": proposed}]
    left = change(live.client, revision, *both).json()
    on_images, kinds, _ = training_data(project)
    assert (on_images, kinds) == (1, ["silhouette"] * 4)
    assert left["objects"] == [drawn["objects"][1]] and left["image_boxes"]["boxes"] == [scene.image_box(1)]
    undone = live.client.post(f"{ROOM}/undo", json={}).json()["state"]
    assert undone["objects"] == drawn["objects"] and undone["labels"][:2] == drawn["labels"]
    assert training_data(project)[:2] == (2, ["silhouette"] * 8)
    redone = live.client.post(f"{ROOM}/redo", json={}).json()["state"]
    assert redone["objects"] == left["objects"]
    back = change(live.client, redone["frame"]["revision"], {"kind": "accept", "uid": uids[0]}).json()
    assert [entry["uid"] for entry in back["objects"]] == [uids[1], uids[0]], "an accepted object is not background"


def test_a_changed_box_kind_measures_finished_objects_again(live: Live, project: Project, generated: Path) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    uids = [draw_object(live.client, "room", 1, scene, number)["uid"] for number in range(2)]
    drawn = {uid: project.labels.get(uid).label.box for uid in uids}
    revision = state(live.client)["frame"]["revision"]
    corrected = {"kind": "edit", "uid": uids[1], "label": "person", "box": BOX, "track_id": None}
    revision = change(live.client, revision, corrected).json()["frame"]["revision"]
    (on_image,) = project.boxes.on_images()
    boxes = {"kind": "image_boxes", "boxes": [as_json(box) for box in on_image.boxes], "box_kind": "box"}
    revision = change(live.client, revision, boxes).json()["frame"]["revision"]
    measured = {uid: project.labels.get(uid).label.box for uid in uids}
    assert iou_3d(measured[uids[1]], Box3DJson(**BOX).box()) == pytest.approx(1), "a corrected box stays"
    assert iou_3d(measured[uids[0]], drawn[uids[0]]) < 0.999
    views = state(live.client)["objects"][0]["views"]
    steps = {"image_box": scene.image_box(0), "boxes": [box for _, box in views], "box_kind": "box"}
    again = live.client.post(f"{ROOM}/frames/1/label/steps", json=steps).json()
    assert iou_3d(measured[uids[0]], Box3DJson(**again["box"]).box()) == pytest.approx(1), "as if drawn with this kind"
    # and back again
    change(live.client, revision, {**boxes, "box_kind": "silhouette"})
    assert iou_3d(project.labels.get(uids[0]).label.box, drawn[uids[0]]) == pytest.approx(1)
    for _ in range(2):
        live.client.post(f"{ROOM}/undo", json={})
    assert iou_3d(project.labels.get(uids[0]).label.box, drawn[uids[0]]) == pytest.approx(1)
