"""A simulated operator at the API, who draws boxes on the image and the views like the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from annotator.geometry.outline import points_on_image
from annotator.rcv.teach import TaughtObject
from annotator.recordings import open_recording
from annotator.types import Box2D, Frame
from annotator.workflows.simulate import visible_objects


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame of a generated recording and its true objects."""

    frame: Frame
    objects: list[TaughtObject]

    @classmethod
    def of(cls, recording: Path, index: int, classes: Sequence[str]) -> Scene:
        opened = open_recording(recording)
        frame = opened.frame(index)
        return cls(frame, visible_objects(opened, index, frame, classes))

    def image_box(self, number: int) -> dict[str, Any]:
        item = self.objects[number]
        box = points_on_image(self.frame.camera, self.frame.cloud.xyz_m[item.points], item.label)
        assert box is not None
        return as_json(box)

    def view_box(self, number: int, view: dict[str, Any]) -> dict[str, Any]:
        """The box of the object's points on a view, given as its JSON."""
        item = self.objects[number]
        seen = self.frame.cloud.xyz_m[item.points] @ np.array(view["axes"])[:2].T
        px = (seen - np.array(view["origin_m"])) / view["metres_per_px"]
        px = px[((px >= -0.5) & (px <= np.array([view["width"], view["height"]]) - 0.5)).all(axis=1)]
        low, high = px.min(axis=0), px.max(axis=0)
        return as_json(Box2D(item.label, float(low[0]), float(low[1]), float(high[0]), float(high[1])))


def as_json(box: Box2D) -> dict[str, Any]:
    return {
        "label": box.label,
        "x_min": box.x_min,
        "y_min": box.y_min,
        "x_max": box.x_max,
        "y_max": box.y_max,
        "score": box.score,
    }


def draw_object(client: Any, project: str, frame_id: int, scene: Scene, number: int) -> dict[str, Any]:
    """Draws all five boxes and saves after each; returns the last answer."""
    base = f"/api/projects/{project}/frames/{frame_id}"
    state = client.get(base).json()
    image_box = scene.image_box(number)
    before = [] if state["image_boxes"] is None else state["image_boxes"]["boxes"]
    all_boxes = [*before, image_box]
    drawn: list[dict[str, Any]] = []
    answer: dict[str, Any] = {}
    for drag in range(5):
        if drag > 0:
            labelling = client.post(f"{base}/label/steps", json={"image_box": image_box, "boxes": drawn}).json()
            views = [view for step in labelling["steps"] for view in step["views"]]
            drawn = [*drawn, scene.view_box(number, views[drag - 1])]
        saved = client.post(
            f"{base}/label/object",
            json={
                "revision": state["frame"]["revision"],
                "image_boxes": all_boxes,
                "box_kind": "silhouette",
                "object": {"image_box": image_box, "boxes": drawn, "uid": None},
                "effort": {"actions": 1, "seconds": 2.5},
            },
        )
        assert saved.status_code == 200, saved.text
        answer = saved.json()
        state = answer["state"]
        assert (answer["uid"] is None) == (drag < 4)
    return answer
