"""The figure docs/loop.jpg: how 2D boxes on views give an oriented 3D box, on a generated recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from page import DOCS

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.oriented_box import EDGES, box_corners, contains
from annotator.geometry.projection import in_frustum, project
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.propose import propose
from annotator.rcv.pseudo_view import render_pairs
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types import Frame, PointCloud, Proposal, StepTrace
from annotator.workflows.recorded.reading import load_truth

OUT = DOCS / "loop.jpg"
RED, GREEN, YELLOW = (230, 60, 50), (60, 220, 90), (250, 220, 60)
TILE, GAP, BAR, COLUMNS = 232, 8, 26, 6


def main() -> None:
    with TemporaryDirectory() as folder:
        write_generated(Path(folder) / "room", "people", 6, seed=3)
        recording = open_recording(Path(folder) / "room")
        frame = recording.frame(4)
        truths = [t for t in load_truth(recording, 4, frame) if contains(t.box, frame.cloud.xyz_m).sum() > 2000]
    config = RcvConfig(orientation=Orientation.UPRIGHT, view_px=TILE)
    detector = PerfectDetector.for_frame(frame, truths, jitter=0.01)
    proposals = propose([frame], detector, detector, config)[0].proposals
    shown = max(proposals, key=lambda p: p.image_box.width_px * p.image_box.height_px)
    camera = np.hstack([camera_image(frame, [shown], boxes_3d=False), gap(480), camera_image(frame, proposals)])
    tiles = [tile for step in shown.trace[:3] for tile in step_tiles(frame, shown, step)][: 2 * COLUMNS]
    views = np.vstack([np.hstack(tiles[:COLUMNS]), np.hstack(tiles[COLUMNS:])])
    width = camera.shape[1]
    views = cv2.resize(views, (width, round(views.shape[0] * width / views.shape[1])), interpolation=cv2.INTER_AREA)
    column = width // COLUMNS
    rows = [
        title({0: "1  a box on the camera image cuts a frustum", 648: "4  the fitted boxes, fully oriented"}, width),
        camera,
        title({0: "2  front and side pseudo-view", 2 * column: "3  what is kept, along several axes at once"}, width),
        views,
    ]
    cv2.imwrite(str(OUT), np.vstack(rows)[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def title(texts: dict[int, str], width: int) -> np.ndarray:
    bar = np.full((BAR, width, 3), 255, np.uint8)
    for x, text in texts.items():
        cv2.putText(bar, text, (x + 8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return bar


def gap(height: int) -> np.ndarray:
    return np.full((height, GAP, 3), 255, np.uint8)


def camera_image(frame: Frame, proposals: Sequence[Proposal], boxes_3d: bool = True) -> np.ndarray:
    image = np.ascontiguousarray(frame.rgb).copy()
    for proposal in proposals:
        if boxes_3d:
            corners = np.rint(project(frame.camera, box_corners(proposal.box))).astype(int)
            for a, b in EDGES:
                cv2.line(image, tuple(map(int, corners[a])), tuple(map(int, corners[b])), GREEN, 2, cv2.LINE_AA)
        else:
            low_high = np.rint(np.array(proposal.image_box.xyxy)).astype(int).tolist()
            cv2.rectangle(image, tuple(low_high[:2]), tuple(low_high[2:]), RED, 2, cv2.LINE_AA)
    return image


def step_tiles(frame: Frame, proposal: Proposal, step: StepTrace) -> list[np.ndarray]:
    """The step's pseudo-views with the boxes that were used, rendered again from the points of the step."""
    cloud = cloud_of(frame, proposal, step)
    axes = [np.array(view.axes) for view in step.views[::2]]
    rendered = render_pairs(cloud, axes, TILE)
    tiles = []
    for view, trace in zip(rendered, step.views, strict=True):
        tile = np.ascontiguousarray(view.rgb).copy()
        if trace.used is not None:
            box = trace.boxes[trace.used]
            spans = np.array(trace.origin_m) + np.array([[box.x_min, box.y_min], [box.x_max, box.y_max]]) * (
                trace.metres_per_px
            )
            low, high = np.rint((spans - view.origin_m) / view.metres_per_px).astype(int)
            cv2.rectangle(tile, tuple(map(int, low)), tuple(map(int, high)), RED, 2)
        square = np.full((TILE + GAP, TILE + GAP, 3), 255, np.uint8)
        height, width = tile.shape[:2]
        top, left = (TILE - height) // 2, (TILE - width) // 2
        square[:TILE, :TILE] = 114
        square[top : top + height, left : left + width] = tile
        tiles.append(square)
    return tiles


def cloud_of(frame: Frame, proposal: Proposal, step: StepTrace) -> PointCloud:
    """The points of a step: those of the frustum in the first step, else those of it near the final box."""
    mask = in_frustum(frame.camera, frame.cloud.xyz_m, proposal.image_box)
    if step is not proposal.trace[0]:
        mask &= contains(proposal.box, frame.cloud.xyz_m, 0.08)
    return frame.cloud.select(mask)
