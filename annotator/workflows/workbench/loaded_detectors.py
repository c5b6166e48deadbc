"""The active detectors of projects, loaded in the background and used by one thread at a time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from annotator.project import Project
from annotator.types import Box2D, BoxKind, Detector, DetectorKind, Image, Suggestion
from annotator.types.detector import Picture
from annotator.types.errors import AnnotatorError
from annotator.workflows.detectors import Names, UsedModel, detector_title, load_detector, required_model, used_model
from annotator.workflows.warm_up import warm_up_with

LOG = logging.getLogger("annotator.detectors")


@dataclass(frozen=True, eq=False)
class ReadyDetector:
    """A detector that runs one call at a time.

    Attributes:
        box_kind, class_agnostic: as in `workflows.detectors.Detectors`.
        name: the base detector's name, or "" for the project's own detector.
        training: name of the folder of its training, or "" for the base detector.
    """

    detector: Detector
    box_kind: BoxKind
    lock: threading.Lock
    class_agnostic: bool = False
    name: str = ""
    training: str = ""

    @property
    def trained(self) -> bool:
        """Whether it was trained on objects of the project."""
        return not self.name

    @property
    def title(self) -> str:
        """Its name for people."""
        return detector_title(self.name)

    @property
    def suggestion(self) -> Suggestion:
        """What a label records whose boxes it suggested."""
        return Suggestion(self.training or self.title, self.fingerprint)

    @property
    def labels(self) -> tuple[str, ...]:
        """The classes it detects."""
        return self.detector.labels

    @property
    def fingerprint(self) -> str:
        """As `Detector.fingerprint`."""
        return self.detector.fingerprint

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """As `Detector.detect`."""
        with self.lock:
            return self.detector.detect(images)


@dataclass(frozen=True, eq=False)
class Readiness:
    """The state of a role's detector.

    Attributes:
        state: none = there is no active model.
        problem: why it failed, as shown to the operator.
    """

    state: Literal["none", "loading", "ready", "failed"]
    detector: ReadyDetector | None = None
    problem: str | None = None


def ready_view(project: Project) -> ReadyDetector | None:
    """Loads the view detector that a project uses, its own or the base detector; None if there is none."""
    model = used_model(project, DetectorKind.VIEW)
    return None if model is None else _ready(model, threading.Lock())


def has_view_with_classes(project: Project) -> bool:
    """True if the project uses a view detector that knows its classes, which following needs to look for an object."""
    model = used_model(project, DetectorKind.VIEW)
    return model is not None and not model.class_agnostic


def view_with_classes(project: Project) -> ReadyDetector | None:
    """Loads the project's view detector; None without one, or if it is class-agnostic."""
    return ready_view(project) if has_view_with_classes(project) else None


def require_view(project: Project) -> ReadyDetector:
    """As `ready_view`, but an error if there is none."""
    return _ready(required_model(project, DetectorKind.VIEW), threading.Lock())


def _ready(model: UsedModel, lock: threading.Lock) -> ReadyDetector:
    training = "" if model.name else model.path.parent.name
    detector = load_detector(model.path, names=model.names)
    return ReadyDetector(detector, model.box_kind, lock, model.class_agnostic, model.name, training)


class ReadyDetectors:
    """Loads detectors in the background and keeps them. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._use = threading.Lock()
        self._loader = ThreadPoolExecutor(1, "detectors")
        self._loading: dict[tuple[Path, DetectorKind], tuple[tuple[str, Names], Future[ReadyDetector]]] = {}

    def get(self, project: Project, role: DetectorKind, wait_s: float | None = None) -> ReadyDetector | None:
        """Returns the active detector of a role, or None if there is none, or it is not loaded.

        Args:
            wait_s: how long to wait while it loads, seconds; None = until it is loaded.
        """
        return self.readiness(project, role, wait_s).detector

    def readiness(self, project: Project, role: DetectorKind, wait_s: float | None = None) -> Readiness:
        """As `get`, with the state and the reason of a failure.

        A failure does not raise, since labels can be drawn without a detector. It stays until another model is active.
        """
        model = used_model(project, role)
        if model is None:
            return Readiness("none")
        try:
            return Readiness("ready", self._future(project, role, model).result(wait_s))
        except NotYetError:
            return Readiness("loading")
        except AnnotatorError as error:
            return Readiness("failed", problem=str(error))
        except Exception:
            return Readiness("failed", problem="internal error, see the server's log")

    def warm(self, project: Project) -> None:
        """Begins to load the project's detectors, since an operator is about to draw."""
        for role in DetectorKind:
            if (model := used_model(project, role)) is not None:
                self._future(project, role, model)

    def close(self) -> None:
        """Stops loading."""
        self._loader.shutdown(wait=False, cancel_futures=True)

    def _future(self, project: Project, role: DetectorKind, model: UsedModel) -> Future[ReadyDetector]:
        key = (project.path, role)
        with self._lock:
            known = self._loading.get(key)
            # another model, or the same one trained again
            if known is None or known[0] != (model.fingerprint, model.names):
                known = ((model.fingerprint, model.names), self._loader.submit(self._load, role, model))
                self._loading[key] = known
            return known[1]

    def _load(self, role: DetectorKind, model: UsedModel) -> ReadyDetector:
        try:
            ready = _ready(model, self._use)
            if role is DetectorKind.VIEW:
                warm_up_with(ready, ready.box_kind, ready.class_agnostic)
            else:
                # the first call is slow
                ready.detect([Picture(np.full((64, 64, 3), 114, np.uint8))])
        except AnnotatorError as error:
            LOG.warning("the %s detector %s cannot be loaded: %s", role.value, model.path, error)
            raise
        except Exception:
            LOG.exception("the %s detector %s cannot be loaded", role.value, model.path)
            raise
        return ready
