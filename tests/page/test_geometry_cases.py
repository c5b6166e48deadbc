"""The package's own numbers that the page's geometry must reproduce (geometry.test.js): they are in geometry.json.

After a change of the package's geometry: `python tests/page/test_geometry_cases.py` writes the file anew.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import box_corners, turn_of_heading
from annotator.geometry.outline import box_on_image, heading_px
from annotator.geometry.projection import project
from annotator.types import Camera, OrientedBox, PointCloud
from annotator.web.schemas import CameraJson
from annotator.workflows.workbench.contact_sheet import views_of_points

FILE = Path(__file__).parent / "geometry.json"
LENS = (0.1, -0.2, 0.001, 0.002, 0.05, 0.01, 0.02, 3e-3, 1e-3, 2e-3, 3e-3, 1e-3)
LENSES = [(), LENS[:5], LENS, (*LENS, 0.02, -0.03)]
POINTS = [[0.0, 0.0, 2.0], [0.7, -0.4, 2.0], [-0.9, 0.6, 3.0]]


def cases() -> dict[str, Any]:
    """Boxes with their corners, the server's views of them, and what four cameras see."""
    rng = np.random.default_rng(7)
    boxes = [
        OrientedBox.from_parts(rng.uniform([-1, -1, 3], [1, 1, 6]), turn, rng.uniform(0.3, 2.0, 3))
        for turn in Rotation.random(3, random_state=7).as_matrix()
    ]
    cameras = [Camera(640, 480, 500.0, 510.0, 321.5, 240.5, lens) for lens in LENSES]
    return {
        "turn_of_heading": turn_of_heading(*boxes[:2]),
        "boxes": [
            {
                "box": {name: np.round(value, 12).tolist() for name, value in _parts(box)},
                "corners": box_corners(box).tolist(),
                "views": _views(box),
                "heading_px": heading_px(cameras[0], box, 10.0)[0].tolist(),
            }
            for box in boxes
        ],
        "cameras": [
            {
                "camera": {
                    "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
                    "width": camera.width_px, "height": camera.height_px, "distortion": list(lens),
                    "most_q": CameraJson.of(camera).most_q,
                },
                "points": POINTS,
                "px": project(camera, np.array(POINTS)).tolist(),
                "extents": [_extent(camera, box) for box in boxes],
            }
            for camera, lens in zip(cameras, LENSES, strict=True)
        ],
    }  # fmt: skip


def _parts(box: OrientedBox) -> list[tuple[str, np.ndarray]]:
    return [("center", box.center_m), ("size", box.size_m), ("rotation", box.rotation)]


def _views(box: OrientedBox) -> dict[str, Any]:
    """Review's three views as the server draws them, with about 1 cm per pixel."""
    cloud = PointCloud(np.zeros((0, 3), np.float32), None, None)
    drawn = views_of_points(cloud, np.zeros(0, np.int64), box, round(1.7 * box.size_m.max() / 0.01))
    return {
        name: {
            "axes": view.axes.tolist(),
            "metres_per_px": view.metres_per_px,
            "origin_m": view.origin_m.tolist(),
        }
        for name, view in drawn.items()
    }


def _extent(camera: Camera, box: OrientedBox) -> list[float]:
    seen = box_on_image(camera, box, "thing")
    assert seen is not None
    return [seen.x_min, seen.y_min, seen.x_max, seen.y_max]


def _numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        value = list(value.values())
    return (
        [number for each in value for number in _numbers(each)]
        if isinstance(value, list)
        else [np.nan if value is None else value]
    )


def test_the_numbers_of_the_page_are_the_packages() -> None:
    kept, now = json.loads(FILE.read_text()), cases()
    assert kept.keys() == now.keys()
    np.testing.assert_allclose(_numbers(kept), _numbers(now), rtol=1e-9, atol=1e-9)


if __name__ == "__main__":
    FILE.write_text(json.dumps(cases()) + "\n")
