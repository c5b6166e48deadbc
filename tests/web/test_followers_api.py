"""What follows from a change of labels or boxes on the image for everything that was drawn from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from drawing import Scene, as_json, draw_object
from room_api import BOX, ROOM, change, propose, state

from annotator.geometry.iou import iou_3d
from annotator.project import Project
from annotator.web.wire import Box3DJson

if TYPE_CHECKING:
    from live_server import Live


@pytest.fixture
def project(live: Live) -> Project:
    return live.context.project("room")


def learned(project: Project) -> tuple[int, list[str], int]:
    """What detectors would learn from: boxes on images, kinds of those on views, 3D labels."""
    on_images = sum(len(boxes.boxes) for boxes in project.boxes.on_images())
    kinds = sorted(view.box_kind.value for view in project.boxes.on_views() for _ in view.boxes)
    return on_images, kinds, len(project.labels.select())


def test_an_object_that_is_deleted_teaches_nothing_until_it_is_undone(
    live: Live, project: Project, generated: Path
) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    uids = [draw_object(live.client, "room", 1, scene, number)["uid"] for number in range(2)]
    drawn = state(live.client)
    assert learned(project) == (2, ["silhouette"] * 8, 2)
    removal = [
        {"kind": "delete", "uid": uids[0]},
        {"kind": "image_boxes", "boxes": [scene.image_box(1)], "box_kind": "silhouette"},
    ]
    left = change(live.client, drawn["frame"]["revision"], *removal).json()
    assert learned(project) == (1, ["silhouette"] * 4, 1)
    assert left["objects"] == [drawn["objects"][1]]
    undone = live.client.post(f"{ROOM}/undo", json={}).json()
    assert undone["done"] == "delete person (frame 000000)"
    assert (undone["state"]["objects"], undone["state"]["labels"]) == (drawn["objects"], drawn["labels"])
    assert learned(project) == (2, ["silhouette"] * 8, 2)
    live.client.post(f"{ROOM}/redo", json={})
    assert learned(project) == (1, ["silhouette"] * 4, 1)


@pytest.mark.parametrize("kind", ["delete", "reject"])
def test_a_drawn_label_takes_its_boxes_along_when_review_throws_it_out(
    live: Live, project: Project, generated: Path, kind: str
) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    uids = [draw_object(live.client, "room", 1, scene, number)["uid"] for number in range(2)]
    drawn = state(live.client)
    (proposed,) = propose(project, 1, 5.0)
    revision = state(live.client)["frame"]["revision"]
    both = [{"kind": kind, "uid": uids[0]}, {"kind": kind, "uid": proposed}]
    left = change(live.client, revision, *both).json()
    on_images, kinds, _ = learned(project)
    assert (on_images, kinds) == (1, ["silhouette"] * 4)
    assert left["objects"] == [drawn["objects"][1]] and left["image_boxes"]["boxes"] == [scene.image_box(1)]
    undone = live.client.post(f"{ROOM}/undo", json={}).json()["state"]
    assert undone["objects"] == drawn["objects"] and undone["labels"][:2] == drawn["labels"]
    assert learned(project)[:2] == (2, ["silhouette"] * 8)
    redone = live.client.post(f"{ROOM}/redo", json={}).json()["state"]
    assert redone["objects"] == left["objects"]
    if kind == "delete":
        return
    back = change(live.client, redone["frame"]["revision"], {"kind": "accept", "uid": uids[0]}).json()
    assert [entry["uid"] for entry in back["objects"]] == [uids[1], uids[0]], "it is no background"


def test_boxes_that_measure_something_else_measure_finished_objects_anew(
    live: Live, project: Project, generated: Path
) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    uids = [draw_object(live.client, "room", 1, scene, number)["uid"] for number in range(2)]
    drawn = {uid: project.labels.get(uid).label.box for uid in uids}
    revision = state(live.client)["frame"]["revision"]
    corrected = {"kind": "edit", "uid": uids[1], "label": "person", "box": BOX, "track_id": None}
    revision = change(live.client, revision, corrected).json()["frame"]["revision"]
    (on_image,) = project.boxes.on_images()
    boxes = {"kind": "image_boxes", "boxes": [as_json(box) for box in on_image.boxes], "box_kind": "box"}
    revision = change(live.client, revision, boxes).json()["frame"]["revision"]
    kept = {uid: project.labels.get(uid).label.box for uid in uids}
    assert iou_3d(kept[uids[1]], Box3DJson(**BOX).box()) == pytest.approx(1), "what was corrected stays"
    assert iou_3d(kept[uids[0]], drawn[uids[0]]) < 0.999
    views = state(live.client)["objects"][0]["views"]
    steps = {"image_box": scene.image_box(0), "boxes": [box for _, box in views], "box_kind": "box"}
    told = live.client.post(f"{ROOM}/frames/1/label/steps", json=steps).json()
    assert iou_3d(kept[uids[0]], Box3DJson(**told["box"]).box()) == pytest.approx(1), "as if it were drawn so"
    # and back, by the same way
    change(live.client, revision, {**boxes, "box_kind": "silhouette"})
    assert iou_3d(project.labels.get(uids[0]).label.box, drawn[uids[0]]) == pytest.approx(1)
    for _ in range(2):
        live.client.post(f"{ROOM}/undo", json={})
    assert iou_3d(project.labels.get(uids[0]).label.box, drawn[uids[0]]) == pytest.approx(1)


def test_boxes_that_measure_something_else_do_so_on_views_too(live: Live, project: Project, generated: Path) -> None:
    scene = Scene.of(generated / "people", 0, ["person"])
    revision = draw_object(live.client, "room", 1, scene, 0)["state"]["frame"]["revision"]
    views = [(view.view_id, view.boxes, view.step, view.geometry) for view in project.boxes.on_views()]
    boxes = {"kind": "image_boxes", "boxes": [scene.image_box(0)], "box_kind": "box"}
    answer = change(live.client, revision, boxes).json()
    assert (answer["image_boxes"]["box_kind"], len(answer["objects"][0]["views"])) == ("box", 4)
    assert learned(project) == (1, ["box"] * 4, 1)
    assert [(view.view_id, view.boxes, view.step, view.geometry) for view in project.boxes.on_views()] == views
    live.client.post(f"{ROOM}/undo", json={})
    assert learned(project) == (1, ["silhouette"] * 4, 1)
    assert state(live.client)["image_boxes"]["box_kind"] == "silhouette"
