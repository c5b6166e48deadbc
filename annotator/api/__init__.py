"""The public Python API, exported as `annotator.NAME` and built on the workflows; docs/python.md describes it."""

from annotator.api.frames import frame_from_points, frame_from_rgbd
from annotator.api.labels import (
    draw_boxes,
    evaluate,
    evaluate_files,
    generate_recording,
    open_recording,
    perfect_detector,
    read_labels,
    read_truth,
    write_labels,
)
from annotator.api.project import Project, create_project, open_project
from annotator.api.proposing import propose, watch
from annotator.detection.perfect import NearestCluster
from annotator.geometry.iou import iou_3d, nms_3d
from annotator.rcv.finish import FrameProposals
from annotator.recordings import Recording
from annotator.types import (
    Box2D,
    BoxKind,
    Camera,
    Detector,
    Frame,
    Image,
    Label,
    OrientedBox,
    PointCloud,
    Proposal,
    PseudoView,
    ReviewState,
    Truth,
)
from annotator.types.errors import AnnotatorError, ArgumentError

__all__ = [
    "AnnotatorError",
    "ArgumentError",
    "Box2D",
    "BoxKind",
    "Camera",
    "Detector",
    "Frame",
    "FrameProposals",
    "Image",
    "Label",
    "NearestCluster",
    "OrientedBox",
    "PointCloud",
    "Project",
    "Proposal",
    "PseudoView",
    "Recording",
    "ReviewState",
    "Truth",
    "create_project",
    "draw_boxes",
    "evaluate",
    "evaluate_files",
    "frame_from_points",
    "frame_from_rgbd",
    "generate_recording",
    "iou_3d",
    "nms_3d",
    "open_project",
    "open_recording",
    "perfect_detector",
    "propose",
    "read_labels",
    "read_truth",
    "watch",
    "write_labels",
]
