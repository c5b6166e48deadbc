"""Where a worker gets its detectors from: a description that can be pickled, and is loaded where the work is."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from annotator.detection.config import Backend
from annotator.detection.trained import MODEL_NAME
from annotator.files import write_atomic
from annotator.project.models import Role
from annotator.project.project import Project
from annotator.types import BoxKind
from annotator.types.errors import DetectionError
from annotator.workflows.detectors import Detectors, active_model, load_detector
from annotator.workflows.engines.scratch import scratch_folder


@runtime_checkable
class DetectorSource(Protocol):
    """Can be pickled, and loads a pair of detectors wherever it is unpickled.

    Attributes:
        box_kind: what the boxes of the pseudo-view detector measure.
    """

    @property
    def box_kind(self) -> BoxKind: ...

    def load(self, threads: int | None) -> Detectors:
        """The pair, each with so many threads of the processor (None: all cores).

        Raises:
            AnnotatorError: they cannot be loaded.
        """
        ...


@dataclass(frozen=True, eq=False)
class GivenDetectors:
    """Detectors that exist already; they are pickled themselves where they have to travel."""

    detectors: Detectors

    @property
    def box_kind(self) -> BoxKind:
        """As of the pair."""
        return self.detectors.box_kind

    def load(self, threads: int | None) -> Detectors:
        """The pair as it is."""
        return self.detectors


@dataclass(frozen=True)
class TrainedDetectors:
    """The weights files of a project's detectors.

    Attributes:
        image, view: weights files, in the folders of their trainings.
        box_kind: what the boxes of the view detector measure.
        backend: what runs them.
    """

    image: Path
    view: Path
    box_kind: BoxKind
    backend: Backend = "auto"

    def load(self, threads: int | None) -> Detectors:
        """The pair.

        Raises:
            DetectionError, FormatError: as `load_detector`.
        """
        return Detectors(
            load_detector(self.image, self.backend, threads=threads),
            load_detector(self.view, self.backend, threads=threads),
            self.box_kind,
        )


def trained_detectors(project: Project, backend: Backend = "auto") -> TrainedDetectors:
    """The detectors that a project uses now, not loaded.

    Raises:
        DetectionError: one of them has not been trained yet.
    """
    image, view = active_model(project, Role.IMAGE), active_model(project, Role.VIEW)
    return TrainedDetectors(image.path, view.path, view.box_kind, backend)


@dataclass(frozen=True)
class _Files:
    """A training's weights with what must lie beside them: names and contents."""

    weights: str
    contents: tuple[tuple[str, bytes], ...]

    @classmethod
    def of(cls, weights: Path) -> _Files:
        try:
            return cls(
                weights.name, tuple((name, (weights.parent / name).read_bytes()) for name in (weights.name, MODEL_NAME))
            )
        except OSError as error:
            raise DetectionError(
                f"{error.filename}: cannot be read ({error.strerror}); train the detector again"
            ) from error

    def unpacked(self, folder: Path) -> Path:
        """The weights file in a folder below `folder` that is named by the contents; several processes may ask at
        once, and whatever else is made beside it (exports) is found by the next one. Files that have gone meanwhile,
        as they do where temporary files are cleared away after some days, are written again.

        Raises:
            DetectionError: they cannot be written.
        """
        digest = hashlib.sha256(b"".join(hashlib.sha256(content).digest() for _, content in self.contents))
        place = folder / digest.hexdigest()[:24]
        try:
            place.mkdir(parents=True, exist_ok=True)
            for name, content in self.contents:
                if not (place / name).is_file():
                    write_atomic(place / name, content)
        except OSError as error:
            raise DetectionError(
                f"{place}: cannot be written ({error.strerror}); make room, or name another place in TMPDIR"
            ) from error
        return place / self.weights


@dataclass(frozen=True)
class PackedDetectors:
    """Trained detectors with their weights inside, for machines that do not see the project's folder.

    Attributes:
        image, view: files of the two trainings.
        box_kind, backend: as in `TrainedDetectors`.
    """

    image: _Files
    view: _Files
    box_kind: BoxKind
    backend: Backend

    @classmethod
    def of(cls, trained: TrainedDetectors) -> PackedDetectors:
        """Reads the weights.

        Raises:
            DetectionError: they cannot be read.
        """
        return cls(_Files.of(trained.image), _Files.of(trained.view), trained.box_kind, trained.backend)

    def load(self, threads: int | None) -> Detectors:
        """The pair, from files in the machine's folder for temporary ones, which stay there for the next time.

        Raises:
            DetectionError, FormatError: as `load_detector`.
        """
        folder = scratch_folder() / "detectors"
        files = TrainedDetectors(self.image.unpacked(folder), self.view.unpacked(folder), self.box_kind, self.backend)
        return files.load(threads)
