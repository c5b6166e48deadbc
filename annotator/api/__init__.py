"""The public Python API, which `annotator` exports and lists in its `__all__`; docs/python.md describes it."""

# ruff: noqa: F401

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
