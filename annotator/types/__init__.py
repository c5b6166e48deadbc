"""The shared value types: frozen, checked on construction."""

from annotator.types.boxes import Box2D, OrientedBox
from annotator.types.camera import Camera
from annotator.types.correction import NO_CORRECTION, Correction
from annotator.types.detector import Detector, DetectorKind, Image, Region
from annotator.types.frame import Frame
from annotator.types.label import BoxKind, Label, ReviewState, Source, Suggestion, Truth
from annotator.types.point_cloud import PointCloud
from annotator.types.proposal import (
    BoxTrace,
    LostObject,
    Proposal,
    Quality,
    StepTrace,
    StopReason,
    ViewTrace,
)
from annotator.types.pseudo_view import PseudoView

__all__ = [
    "NO_CORRECTION",
    "Box2D",
    "BoxKind",
    "BoxTrace",
    "Camera",
    "Correction",
    "Detector",
    "DetectorKind",
    "Frame",
    "Image",
    "Label",
    "LostObject",
    "OrientedBox",
    "PointCloud",
    "Proposal",
    "PseudoView",
    "Quality",
    "Region",
    "ReviewState",
    "Source",
    "StepTrace",
    "StopReason",
    "Suggestion",
    "Truth",
    "ViewTrace",
]
