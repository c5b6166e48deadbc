"""A project's active detectors, loaded when they are first wanted and kept; used by one thread at a time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from dataclasses import dataclass
from pathlib import Path

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
        """The active detector of a role; None where there is none, or where it is not loaded yet.

        One that cannot be loaded is told in the log, and is as if it were not there: a label can be drawn without.

        Args:
            wait_s: how long to wait for one that is being loaded, seconds; None = until it is.
        """
        model = project.models.active(role)
        if model is None:
            return None
        try:
            return self._future(project, model).result(wait_s)
        except NotYetError:
            return None
        except AnnotatorError as error:
            LOG.warning("project %s: %s", project.path.name, error)
            return None

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
        ready = ReadyDetector(load_detector(model.path), model.box_kind, self._use)
        ready.detect([_Blank(np.full((64, 64, 3), 114, np.uint8))])
        return ready
