"""The public Python API, which `annotator` exports and lists in its `__all__`; docs/python.md describes it."""

# ruff: noqa: I001

from annotator.api.frames import frame_from_points as frame_from_points, frame_from_rgbd as frame_from_rgbd
from annotator.api.labels import (
    draw_boxes as draw_boxes,
    evaluate as evaluate,
    evaluate_files as evaluate_files,
    generate_recording as generate_recording,
    open_recording as open_recording,
    perfect_detector as perfect_detector,
    read_labels as read_labels,
    read_truth as read_truth,
    write_labels as write_labels,
)
from annotator.api.project import Project as Project, create_project as create_project, open_project as open_project
from annotator.api.proposing import propose as propose, watch as watch
from annotator.detection.perfect import NearestCluster as NearestCluster
from annotator.geometry.iou import iou_3d as iou_3d, nms_3d as nms_3d
from annotator.rcv.finish import FrameProposals as FrameProposals
from annotator.recordings import Recording as Recording
from annotator.types import (
    Box2D as Box2D,
    BoxKind as BoxKind,
    Camera as Camera,
    Detector as Detector,
    Frame as Frame,
    Image as Image,
    Label as Label,
    OrientedBox as OrientedBox,
    PointCloud as PointCloud,
    Proposal as Proposal,
    PseudoView as PseudoView,
    ReviewState as ReviewState,
    Truth as Truth,
)
from annotator.types.errors import AnnotatorError as AnnotatorError, ArgumentError as ArgumentError
