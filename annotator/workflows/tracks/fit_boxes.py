"""Fits boxes carried over from another frame to the points of the new frame."""

from __future__ import annotations

from collections.abc import Callable

from annotator.geometry.iou import iou_3d
from annotator.project import Project, StoredFrame
from annotator.types import Label, OrientedBox
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.loaded_detectors import ReadyDetector
from annotator.workflows.workbench.open_frame import OpenFrame
from annotator.workflows.workbench.refit import refit

# 3D IoU of the fitted with the given box below which the fit is rejected: it has found another object, or a part.
MIN_IOU = 0.4

FitBox = Callable[[StoredFrame, OrientedBox, Label], OrientedBox]
"""(frame, box, label of the object in another frame) -> the box fitted to the frame's points.

The given box if the fit is rejected, or if the detector measures another kind of box than the label's.
"""


def box_fitter(
    project: Project, open_frame: Callable[[StoredFrame], OpenFrame], detector: ReadyDetector | None
) -> FitBox:
    """Returns a function that fits boxes with `refit`.

    Args:
        open_frame: returns a frame; its errors are passed on.
        detector: for pseudo-views; without one the sides move to the points inside.
    """

    def fit(frame: StoredFrame, box: OrientedBox, label: Label) -> OrientedBox:
        opened = open_frame(frame)
        config = frame_config(project, opened.frame, detector, label.box_kind)
        if detector is not None and config.box_kind is not label.box_kind:
            return box
        fitted = refit(opened, box, label.label, config, detector).box
        return fitted if iou_3d(fitted, box) >= MIN_IOU else box

    return fit
