"""The steps of one recursion: the pseudo-views with the detected boxes. Writes 03_trace.png."""

from tempfile import TemporaryDirectory

import cv2
import numpy as np

import annotator

SIDE_PX, COLUMNS = 160, 8
pictures: list[np.ndarray] = []
nearest = annotator.NearestCluster("hand")


def hand(view: annotator.PseudoView) -> list[annotator.Box2D]:
    """Detects the hand, and keeps a picture of the view with its box."""
    (boxes,) = nearest.detect([view])
    picture = view.rgb.copy()
    for box in boxes:
        x_min, y_min, x_max, y_max = (round(edge) for edge in box.xyxy)
        cv2.rectangle(picture, (x_min, y_min), (x_max, y_max), (230, 60, 50), 1)
    scale = SIDE_PX / max(picture.shape)
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    below, right = (SIDE_PX + 4 - length for length in picture.shape[:2])
    pictures.append(np.pad(picture, ((0, below), (0, right), (0, 0)), constant_values=255))
    return boxes


with TemporaryDirectory() as folder:
    frame = annotator.generate_recording(f"{folder}/room", "hands", frames=1).frame(0)
boxes = [annotator.Box2D("hand", 389, 199, 511, 349)]
(proposal,) = annotator.propose(frame, image_boxes=boxes, view_detector=hand, rotation="free").proposals
for number, step in enumerate(proposal.trace, 1):
    size = "no box" if step.box is None else " x ".join(f"{side * 100:.1f}" for side in step.box.size_m) + " cm"
    print(f"step {number}: {len(step.views)} views, {step.points_kept} points kept, {size}, {step.stop}")
pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % COLUMNS)
rows = [pictures[i : i + COLUMNS] for i in range(0, len(pictures), COLUMNS)]
cv2.imwrite("03_trace.png", np.vstack([np.hstack(row) for row in rows])[..., ::-1])
