"""Requests to the annotation API of the project `room`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx
import numpy as np
from drawing import Scene
from scipy.spatial.transform import Rotation

from annotator.project import NewLabel, Project, WriteContext, create_project
from annotator.types import Box2D, OrientedBox, Proposal, Quality, Source
from annotator.web.security import ServerSettings

ROOM = "/api/projects/room"
TURNED = Rotation.from_quat([0.9, 0.1, 0.4, 0.1], scalar_first=True).as_matrix().tolist()
BOX = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "rotation": TURNED}


def propose(project: Project, frame: int, *places: float) -> list[str]:
    """Creates proposals in front of the camera at these x coordinates, metres; returns their uids."""
    proposals = [
        Proposal(
            "person",
            0.8,
            OrientedBox.from_parts(np.array([x, 0.0, 3.0]), np.eye(3), np.array([0.8, 0.5, 1.7])),
            Box2D("person", 1.0, 2.0, 30.0, 40.0),
            (),
            Quality(0.1, 0.9, 0.05, 0.8, 0.2),
        )
        for x in places
    ]
    context = WriteContext(project.frames.get(frame).revision, "rcv", Source.AUTO)
    return [uid for uid in project.proposals.replace(frame, proposals, context).uids if uid is not None]


def state(client: httpx.Client, frame: int = 1) -> dict[str, Any]:
    """The state of a frame."""
    answer = client.get(f"{ROOM}/frames/{frame}")
    assert answer.status_code == 200, answer.text
    frame_state: dict[str, Any] = answer.json()
    return frame_state


def change(client: httpx.Client, revision: int, *changes: dict[str, Any], frame: int = 1) -> httpx.Response:
    """Sends changes of a frame like the page."""
    return client.post(f"{ROOM}/frames/{frame}/changes", json={"revision": revision, "changes": list(changes)})


EDGES = ("x_min", "y_min", "x_max", "y_max")


def coco(generated: Path, name: str = "Person") -> dict[str, Any]:
    """The true boxes on the first two frames of the people, and an image of another recording."""
    images, boxes = [{"id": 9, "file_name": "elsewhere.jpg", "width": 320, "height": 240}], []
    for index in range(2):
        scene = Scene.of(generated / "people", index, ["person"])
        camera = scene.frame.camera
        file_name = f"{scene.frame.key}.jpg"
        images.append({"id": index, "file_name": file_name, "width": camera.width_px, "height": camera.height_px})
        for number in range(len(scene.objects)):
            left, top, right, bottom = (scene.image_box(number)[edge] for edge in EDGES)
            # COCO's pixels begin at the corner of the first one
            corner = [left + 0.5, top + 0.5, right - left, bottom - top]
            boxes.append({"id": len(boxes), "image_id": index, "category_id": 1, "bbox": corner})
    boxes.append({"id": len(boxes), "image_id": 1, "category_id": 2, "bbox": [1.0, 1.0, 9.0, 9.0]})
    return {"images": images, "annotations": boxes, "categories": [{"id": 1, "name": name}, {"id": 2, "name": "dog"}]}


# 45 degrees to the left of ahead.
PLACE = np.array([10.0, 10.0, 0.0])


def rig_settings(folder: Path) -> ServerSettings:
    """Settings of a server with the empty project `room`, and the folder `clouds` with the recording `drive`."""
    rng = np.random.default_rng(0)
    (folder / "clouds" / "drive").mkdir(parents=True)
    points = np.vstack([rng.uniform([-30, -30, -2], [30, 30, -1.6], (3000, 3)), PLACE + rng.normal(0, 0.5, (500, 3))])
    np.save(folder / "clouds" / "drive" / "0.npy", points.astype(np.float32))
    create_project(folder / "projects", "room", ("car",)).close()
    return ServerSettings(folder / "projects", (folder / "clouds",), port=0)


def label_object(project: Project, frame_id: int, right_m: float) -> str:
    """Labels the object this far to a level camera's right: -10 m for the one ahead, 10 m for the one to its left."""
    box = OrientedBox.from_parts(np.array([right_m, 0.0, 10.0]), np.eye(3), np.array([2.0, 2.0, 2.0]))
    context = WriteContext(project.frames.get(frame_id).revision, "maria", Source.MANUAL)
    return project.labels.create(frame_id, [NewLabel("car", box, track_id=3)], context).uids[0]
