"""A project's two detectors, ready to run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from annotator.detection.config import DetectorConfig
from annotator.detection.trained import read_trained
from annotator.detection.yolo import YoloDetector
from annotator.project.models import Role, StoredModel
from annotator.project.project import Project
from annotator.types import BoxKind, Detector
from annotator.types.errors import DetectionError


@dataclass(frozen=True, eq=False)
class Detectors:
    """One detector for camera images, one for pseudo-views, and what the boxes of the latter measure."""

    image: Detector
    view: Detector
    box_kind: BoxKind = BoxKind.BOX


def load_detector(weights: Path) -> Detector:
    """A trained detector from the folder of its training, at the picture size that it was trained at.

    Raises:
        DetectionError: missing or unreadable weights.
        FormatError: what should lie beside them is missing.
    """
    return YoloDetector(weights, DetectorConfig(image_size_px=read_trained(weights.parent).image_size_px))


def active_detectors(project: Project) -> Detectors:
    """The detectors that the project uses now.

    Raises:
        DetectionError: one of them has not been trained yet.
    """
    image, view = _active(project, Role.IMAGE), _active(project, Role.VIEW)
    return Detectors(load_detector(image.path), load_detector(view.path), view.box_kind)


def _active(project: Project, role: Role) -> StoredModel:
    model = project.models.active(role)
    if model is None:
        raise DetectionError(
            f"project {project.config.name} has no {role.value} detector yet; "
            f"run `annotator train {project.config.name}`"
        )
    return model
