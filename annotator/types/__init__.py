"""The shared value types: frozen, checked on construction."""

from annotator.types.boxes import Box2D, OrientedBox
from annotator.types.detector import Detector, DetectorKind, Image, PseudoView, Region
from annotator.types.frame import NO_CORRECTION, Camera, Correction, Frame, PointCloud
from annotator.types.label import (
    BoxKind,
    BoxTrace,
    Label,
    LostObject,
    Proposal,
    Quality,
    ReviewState,
    Source,
    StepTrace,
    StopReason,
    Suggestion,
    Truth,
    ViewTrace,
)
