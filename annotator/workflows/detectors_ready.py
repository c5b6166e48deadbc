"""A project's active detectors, loaded when they are first wanted and kept; used by one thread at a time."""

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

from annotator.project import Project, Role, StoredModel
from annotator.types import Box2D, BoxKind, Detector, Image
from annotator.types.errors import AnnotatorError
from annotator.workflows.detectors import load_detector

LOG = logging.getLogger("annotator.detectors")


@dataclass(frozen=True, eq=False)
class ReadyDetector:
    """A detector whose calls wait for each other, and what its boxes measure."""

    detector: Detector
    box_kind: BoxKind
    lock: threading.Lock

    @property
    def labels(self) -> tuple[str, ...]:
        """The class names that it can find."""
        return self.detector.labels

    @property
    def fingerprint(self) -> str:
        """Changes whenever the answers may."""
        return self.detector.fingerprint

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """As `Detector.detect`."""
        with self.lock:
            return self.detector.detect(images)


@dataclass(frozen=True, eq=False)
class Readiness:
    """How far a role's detector is.

    Attributes:
        state: none = there is no active model.
        detector: where it is ready.
        problem: why it failed, for who reads the page.
    """

    state: Literal["none", "loading", "ready", "failed"]
    detector: ReadyDetector | None = None
    problem: str | None = None


@dataclass(frozen=True)
class _Blank:
    """A picture to wake a detector with: its first call is slow."""

    rgb: np.ndarray


class ReadyDetectors:
    """Loads in the background, so that nobody waits for more than they can bear. Threads share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._use = threading.Lock()
        self._loader = ThreadPoolExecutor(1, "detectors")
        self._warmed: set[Path] = set()
        self._loading: dict[tuple[Path, Role], tuple[str, Future[ReadyDetector]]] = {}

    def get(self, project: Project, role: Role, wait_s: float | None = None) -> ReadyDetector | None:
        """The active detector of a role; None where there is none, where it cannot be loaded, or is not loaded yet.

        Args:
            wait_s: how long to wait for one that is being loaded, seconds; None = until it is.
        """
        return self.look(project, role, wait_s).detector

    def look(self, project: Project, role: Role, wait_s: float | None = None) -> Readiness:
        """As `get`, with the reason where there is no detector. One that failed stays so until another is active.

        A failure is no error here: a label can be drawn without a detector.
        """
        model = project.models.active(role)
        if model is None:
            return Readiness("none")
        try:
            return Readiness("ready", self._future(project, model).result(wait_s))
        except NotYetError:
            return Readiness("loading")
        except AnnotatorError as error:
            return Readiness("failed", problem=str(error))
        except Exception:
            return Readiness("failed", problem="internal error, see the server's log")

    def warm(self, project: Project) -> None:
        """Begins to load what the project's pages will ask for; once a project is enough."""
        with self._lock:
            if project.path in self._warmed:
                return
            self._warmed.add(project.path)
        for role in Role:
            self.get(project, role, wait_s=0.0)

    def close(self) -> None:
        """Lets nothing more be loaded."""
        self._loader.shutdown(wait=False, cancel_futures=True)

    def _future(self, project: Project, model: StoredModel) -> Future[ReadyDetector]:
        key = (project.path, model.role)
        with self._lock:
            known = self._loading.get(key)
            # another model, or the same trained anew
            if known is None or known[0] != model.fingerprint:
                known = (model.fingerprint, self._loader.submit(self._load, model))
                self._loading[key] = known
            return known[1]

    def _load(self, model: StoredModel) -> ReadyDetector:
        try:
            ready = ReadyDetector(load_detector(model.path), model.box_kind, self._use)
            ready.detect([_Blank(np.full((64, 64, 3), 114, np.uint8))])
        except AnnotatorError as error:
            LOG.warning("the %s detector %s cannot be loaded: %s", model.role.value, model.path, error)
            raise
        except Exception:
            LOG.exception("the %s detector %s cannot be loaded", model.role.value, model.path)
            raise
        return ready
