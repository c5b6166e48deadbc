"""A COCO file of the generated people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drawing import Scene

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
