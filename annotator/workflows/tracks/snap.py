"""Boxes that were carried over from other frames, moved onto the points that are there."""

from __future__ import annotations

from collections.abc import Callable

from annotator.geometry.iou import iou_3d
from annotator.project import Project, StoredFrame
from annotator.types import BoxKind, Detector, OrientedBox
from annotator.workflows.labelling import frame_config
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.refit import refit

# What overlaps the box less that it was fitted from is another object, or a part of it (exact 3D IoU).
LEAST_IOU = 0.4

Snap = Callable[[StoredFrame, OrientedBox, str], OrientedBox]
"""A box of a frame and its class -> the box fitted to the frame's points; the same box where that goes wrong."""


def snapper(
    project: Project, open_frame: Callable[[StoredFrame], OpenFrame], detector: Detector | None, kind: BoxKind
) -> Snap:
    """Fits boxes anew from where they are (`refit`).

    Args:
        open_frame: gives a frame itself; its errors come through.
        detector: for pseudo-views; without one the sides move to the points inside.
        kind: what the detector's boxes measure.
    """

    def snap(frame: StoredFrame, box: OrientedBox, label: str) -> OrientedBox:
        opened = open_frame(frame)
        config = frame_config(project, opened.frame).model_copy(update={"box_kind": kind})
        found = refit(opened, box, label, config, detector).box
        return found if iou_3d(found, box) >= LEAST_IOU else box

    return snap
