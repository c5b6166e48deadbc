"""Changes of labels or image boxes also update the views and labels that depend on them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from drawing import Scene, as_json, draw_object
from room_api import BOX, ROOM, change, propose, state

from annotator.geometry.iou import iou_3d
from annotator.project import Project
from annotator.web.schemas import Box3DJson

if TYPE_CHECKING:
    from live_server import Live


@pytest.fixture
def project(live: Live) -> Project:
    return live.context.project("room")


def training_data(project: Project) -> tuple[int, list[str], int]:
    """The detectors' training data: number of boxes on images, kinds of boxes on views, number of 3D labels."""
    on_images = sum(len(boxes.boxes) for boxes in project.boxes.on_images())
    kinds = sorted(view.box_kind.value for view in project.boxes.on_views() for _ in view.boxes)
    return on_images, kinds, len(project.labels.select())


def test_a_deleted_object_is_no_training_data_until_the_undo(live: Live, project: Project, generated: Path) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    uids = [draw_object(live.client, "room", 1, scene, number)["uid"] for number in range(2)]
    drawn = state(live.client)
    assert training_data(project) == (2, ["silhouette"] * 8, 2)
    removal = [
        {"kind": "delete", "uid": uids[0]},
        {"kind": "image_boxes", "boxes": [scene.image_box(1)], "box_kind": "silhouette"},
    ]
    left = change(live.client, drawn["frame"]["revision"], *removal).json()
    assert training_data(project) == (1, ["silhouette"] * 4, 1)
    assert left["objects"] == [drawn["objects"][1]]
    undone = live.client.post(f"{ROOM}/undo", json={}).json()
    assert undone["done"] == "delete person (frame 000000)"
    assert (undone["state"]["objects"], undone["state"]["labels"]) == (drawn["objects"], drawn["labels"])
    assert training_data(project) == (2, ["silhouette"] * 8, 2)
    live.client.post(f"{ROOM}/redo", json={})
    assert training_data(project) == (1, ["silhouette"] * 4, 1)


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
