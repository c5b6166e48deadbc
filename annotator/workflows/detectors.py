"""Loads a project's image and pseudo-view detectors."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.pretrained import NAME, TITLE, base_weights, has_base
from annotator.detection.trained import read_trained
from annotator.detection.yolo import YoloDetector
from annotator.project import Statistics
from annotator.project.jobs import Run
from annotator.project.models import StoredModel
from annotator.project.project import Project
from annotator.rcv.config import AGNOSTIC_LABELS, RcvConfig
from annotator.types import BoxKind, Detector, DetectorKind
from annotator.types.errors import ConfigError, DetectionError

Names = tuple[tuple[str, str | None], ...]
AGNOSTIC = tuple(AGNOSTIC_LABELS.values())
# Key of a run's settings: where the 2D boxes come from that it lifted to 3D.
LIFTED_FROM = "lifted from"


@dataclass(frozen=True, eq=False)
class Detectors:
    """The image detector and the pseudo-view detector.

    Attributes:
        box_kind: what the view detector's boxes measure.
        class_agnostic: whether it measures objects of any class, as the base detector does.
        image_kind: what the image detector's boxes enclose.
        trained: whether the view detector was trained on objects of the project.
    """

    image: Detector
    view: Detector
    box_kind: BoxKind = BoxKind.BOX
    class_agnostic: bool = False
    image_kind: BoxKind = BoxKind.BOX
    trained: bool = False

    @property
    def kinds(self) -> tuple[BoxKind, bool, BoxKind, bool]:
        """The arguments of `RcvConfig.for_detector`."""
        return self.box_kind, self.class_agnostic, self.image_kind, self.trained

    def load(self, threads: int | None) -> Detectors:
        """As `TrainedDetectors.load`: they are loaded already."""
        return self

    def settings(self, config: RcvConfig) -> RcvConfig:
        """Adapts the settings `config` to these detectors."""
        return config.for_detector(*self.kinds)

    @property
    def backends(self) -> tuple[str, str]:
        """The backends of the image and the view detector, e.g. ("openvino", "openvino"); "" if unknown."""
        return str(getattr(self.image, "backend", "")), str(getattr(self.view, "backend", ""))


def load_detector(
    weights: Path,
    backend: Backend = "auto",
    image_size_px: int | None = None,
    threads: int | None = None,
    names: Names = (),
) -> Detector:
    """Loads a trained detector.

    Args:
        weights: the weights file in the folder of its training.
        backend: as for `open_network`.
        image_size_px: longer side of the network's input; None = as trained, and with the expected errors of edges that
            its training found.
        threads: processor threads; None = all cores that the process may use.
        names: as in `UsedModel`.
    """
    settings: dict[str, Any] = {"image_size_px": image_size_px, "names": dict(names)}
    if image_size_px is None:
        trained = read_trained(weights.parent)
        settings |= {"image_size_px": trained.image_size_px, "edge_errors": trained.edge_errors}
    try:
        config = DetectorConfig(backend=backend, threads=threads, **settings)
    except ValidationError as error:
        problem = error.errors()[0]
        raise ConfigError(
            f"detector setting {problem['loc'][0]}: {problem['msg']}, not {problem['input']!r}"
        ) from error
    return YoloDetector(weights, config)


@dataclass(frozen=True)
class UsedModel:
    """The detector that a project uses for a role.

    Attributes:
        path: weights file, in the folder of its training.
        box_kind, class_agnostic: as in `Detectors`.
        fingerprint: changes with the detector.
        name: for people: the base detector's name, or "" for the project's own detector.
        manifest: the list of its training data, if known.
        names: (name in the network, present name) of classes that were changed after its training; None = removed.
    """

    path: Path
    box_kind: BoxKind
    class_agnostic: bool
    fingerprint: str
    name: str = ""
    manifest: Path | None = None
    names: Names = ()

    @property
    def trained(self) -> bool:
        return not self.name

    @property
    def described(self) -> str:
        return self.name or f"project's detector {self.path.parent.name}"


@dataclass(frozen=True)
class TrainedDetectors:
    """A pair of trained detectors that is not loaded yet; can be pickled.

    Attributes:
        backend: as for `load_detector`.
    """

    image: UsedModel
    view: UsedModel
    backend: Backend = "auto"

    def load(self, threads: int | None = None) -> Detectors:
        """Loads the detectors, each with a number of processor threads (None = all cores)."""
        image, view = (
            load_detector(model.path, self.backend, threads=threads, names=model.names)
            for model in (self.image, self.view)
        )
        kinds = (self.view.box_kind, self.view.class_agnostic, self.image.box_kind)
        return Detectors(image, view, *kinds, self.view.trained)


def trained_detectors(project: Project, backend: Backend = "auto") -> TrainedDetectors:
    """Describes the project's active detectors without loading them."""
    image, view = (required_model(project, role) for role in (DetectorKind.IMAGE, DetectorKind.VIEW))
    return TrainedDetectors(image, view, backend)


def active_detectors(project: Project, *, backend: Backend = "auto") -> Detectors:
    """Loads the project's active detectors; `backend` as for `load_detector`."""
    return trained_detectors(project, backend).load()


def own_model(project: Project, model: StoredModel) -> UsedModel:
    """A model of the project; a training that started from the base detector gives a class-agnostic one."""
    class_agnostic = model.labels == AGNOSTIC and model.labels != project.config.classes
    names: Names = ()
    if not class_agnostic:
        now = project.present_names(model.labels, model.created_ns)
        names = tuple((before, after) for before, after in now.items() if before != after)
    return UsedModel(
        model.path, model.box_kind, class_agnostic, model.fingerprint, manifest=model.manifest, names=names
    )


def base_model() -> UsedModel:
    return UsedModel(base_weights(), BoxKind.BOX, True, NAME, NAME)


def detector_title(name: str) -> str:
    return TITLE if name == NAME else "this project's view detector"


def base_titles(project: Project) -> dict[int, str]:
    """Names the base detector for people, by the id of each batch run whose boxes it measured."""
    own = {model.fingerprint for model in project.models.all(DetectorKind.VIEW)}
    return {
        run.id: TITLE
        for run in project.jobs.all()
        # a project's own detector is class-agnostic, too, if its training continued the base detector
        if json.loads(run.config).get("class_agnostic") and run.view_detector not in own
    }


def lifted_from(run: Run) -> str | None:
    """The origin of the 2D boxes that a run lifted to 3D; None for a run of an image detector."""
    origin = json.loads(run.config).get(LIFTED_FROM)
    return None if origin is None else str(origin)


class ReportedStatistics(Statistics):
    """Statistics, and the name of the view detector that the project uses; None without one."""

    view_detector: str | None


def reported_statistics(project: Project) -> ReportedStatistics:
    used = used_model(project, DetectorKind.VIEW)
    named = None if used is None else detector_title(used.name)
    return ReportedStatistics(**dict(project.statistics()), view_detector=named)


def used_model(project: Project, role: DetectorKind) -> UsedModel | None:
    """Returns the project's active model; without an active view detector, the base detector; None without both."""
    model = project.models.active(role)
    if model is not None:
        return own_model(project, model)
    return base_model() if role is DetectorKind.VIEW and has_base() else None


def stand_in(project: Project) -> str | None:
    """Names the detector that is used in place of a view detector of the project, for people; None if it has its own,
    or if nothing takes its place."""
    used = used_model(project, DetectorKind.VIEW)
    return None if used is None or not used.name else detector_title(used.name)


def required_model(project: Project, role: DetectorKind) -> UsedModel:
    """As `used_model`; it is an error if there is none."""
    model = used_model(project, role)
    if model is None:
        name = project.config.name
        raise DetectionError(f"project {name} has no {role.value} detector yet; run `annotator train {name}`")
    return model
