"""A project's two detectors, ready to run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.trained import read_trained
from annotator.detection.yolo import YoloDetector
from annotator.gpu.compute import torch_compute
from annotator.project.models import Role, StoredModel
from annotator.project.project import Project
from annotator.rcv.compute import NUMPY, Compute
from annotator.types import BoxKind, Detector
from annotator.types.errors import ConfigError, DetectionError


@dataclass(frozen=True, eq=False)
class Detectors:
    """One detector for camera images, one for pseudo-views, and what the boxes of the latter measure."""

    image: Detector
    view: Detector
    box_kind: BoxKind = BoxKind.BOX

    @property
    def backends(self) -> tuple[str, str]:
        """What runs the image and the view detector, such as ("openvino", "openvino"); "" where one does not say."""
        return str(getattr(self.image, "backend", "")), str(getattr(self.view, "backend", ""))

    @property
    def compute(self) -> Compute:
        """Where points are drawn and clustered: where the view detector runs, if that is a CUDA device.

        Raises:
            ComputeError: the device cannot be used.
        """
        device = self.view.device if isinstance(self.view, YoloDetector) else "cpu"
        return torch_compute(device) if device.startswith("cuda") else NUMPY


def load_detector(
    weights: Path, backend: Backend = "auto", image_size_px: int | None = None, threads: int | None = None
) -> Detector:
    """A trained detector from the folder of its training.

    Args:
        weights: its weights file.
        backend: what runs it; as of `open_network`.
        image_size_px: the longer side of a picture in the network; None: the size that it was trained at.
        threads: of the processor; None: all cores that the process may use.

    Raises:
        ConfigError: the size or the threads are of no use.
        DetectionError: missing or unreadable weights, or a backend that cannot be used.
        FormatError: what should lie beside the weights is missing.
    """
    size = read_trained(weights.parent).image_size_px if image_size_px is None else image_size_px
    try:
        config = DetectorConfig(image_size_px=size, backend=backend, threads=threads)
    except ValidationError as error:
        problem = error.errors()[0]
        raise ConfigError(
            f"detector setting {problem['loc'][0]}: {problem['msg']}, not {problem['input']!r}"
        ) from error
    return YoloDetector(weights, config)


def active_detectors(project: Project, *, backend: Backend = "auto", threads: int | None = None) -> Detectors:
    """The detectors that the project uses now.

    Args:
        backend, threads: as in `load_detector`.

    Raises:
        ConfigError, DetectionError, FormatError: as `load_detector`; or one of them has not been trained yet.
    """
    image, view = active_model(project, Role.IMAGE), active_model(project, Role.VIEW)
    return Detectors(
        load_detector(image.path, backend, threads=threads),
        load_detector(view.path, backend, threads=threads),
        view.box_kind,
    )


def active_model(project: Project, role: Role) -> StoredModel:
    """The model that a project uses now.

    Raises:
        DetectionError: it has not been trained yet.
    """
    model = project.models.active(role)
    if model is None:
        raise DetectionError(
            f"project {project.config.name} has no {role.value} detector yet; "
            f"run `annotator train {project.config.name}`"
        )
    return model
