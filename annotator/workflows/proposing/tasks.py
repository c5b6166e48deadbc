"""Tasks, answers, and what workers load for them: picklable values that describe frames, places and detectors.

Workers read recordings at the project's path, or at another path or URL: the driver's `/data/room` may be
`/mnt/data/room` on a worker's machine, or `s3://bucket/room` in an object storage. URLs are read through fsspec
(`annotator.recordings.mirror`).
"""

from __future__ import annotations

import copyreg
import os
import stat
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.detection.trained import MODEL_NAME
from annotator.files import NETWORK_BYTES, read_file
from annotator.project import StoredRecording
from annotator.project.config import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.starts import WarmStart
from annotator.recordings import stored_options
from annotator.types import BoxKind
from annotator.types.errors import ConfigError, DetectionError, WorkerError
from annotator.workflows.detectors import Detectors, TrainedDetectors
from annotator.workflows.frame_source import OpenedRecording, open_stored


@dataclass(frozen=True, eq=False)
class FrameSpec:
    """A frame to process.

    Attributes:
        recording: workers may read it elsewhere (`Storage`).
        key: its name in the recording, which identifies it.
        seeds: boxes of the previous frame, in this frame's camera frame.
    """

    recording: StoredRecording
    key: str
    seeds: tuple[WarmStart, ...] = ()


@dataclass(frozen=True, eq=False)
class Task:
    """A few frames that go through the recursion together.

    Every engine gets the same groups, since the other images of a batch may change a detector's results in their last
    bits.

    Attributes:
        project: the project's name, for messages.
        config: settings; the orientation is replaced for each frame.
    """

    number: int
    project: str
    frames: tuple[FrameSpec, ...]
    config: RcvConfig
    rotation: BoxRotation


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """The `result` of a frame, or the `reason` of its failure.

    Attributes:
        seconds: processing time, without waiting.
    """

    result: FrameProposals | None
    reason: str | None
    seconds: float


@dataclass(frozen=True, eq=False)
class Answer:
    """The answer to a task: one answer per frame, in the task's order."""

    number: int
    frames: tuple[FrameAnswer, ...]


@dataclass(frozen=True)
class Identity:
    """The identity of a worker's detectors; workers with the same identity give the same results.

    Attributes:
        image, view: fingerprints of the detectors.
        kinds: as `Detectors.kinds`.
    """

    image: str
    view: str
    backends: tuple[str, str]
    kinds: tuple[BoxKind, bool, BoxKind, bool]


def transform_of(matrix: Float64[np.ndarray, "*n 4 4"]) -> RigidTransform:
    """Returns the transform with exactly this matrix."""
    return RigidTransform(matrix, normalize=False)


def pickle_exactly() -> None:
    """Makes pickling of poses exact in this process: scipy's own pickle recomputes rotations inexactly."""
    copyreg.pickle(RigidTransform, lambda T: (transform_of, (np.asarray(T.as_matrix(), np.float64),)))


CACHE_MB = 4000
# Maximum number of open recordings of a worker: each holds its frame names and a share of the cache.
MAX_OPEN = 2


@dataclass(frozen=True)
class Storage:
    """Where a worker reads recordings.

    Attributes:
        elsewhere: pairs of a folder on the driver, and its path or URL for workers; the first match is used.
        cache_mb: size of a worker's disk cache for recordings at URLs, MB.
    """

    elsewhere: tuple[tuple[Path, str], ...] = ()
    cache_mb: int = CACHE_MB

    def __post_init__(self) -> None:
        if self.cache_mb < 1:
            raise ConfigError(f"--cache-mb {self.cache_mb} is too small; give 1 or more")

    def place(self, path: Path) -> str:
        """Returns the workers' path or URL of a path of the project."""
        for folder, other in self.elsewhere:
            if path.is_relative_to(folder):
                below = PurePosixPath(path.relative_to(folder))
                return other.rstrip("/") + (f"/{below}" if below.parts else "")
        return str(path)

    def open(self, recording: StoredRecording, project: str) -> OpenedRecording:
        """Opens a recording at the workers' path or URL."""
        place = self.place(recording.path)
        if "://" not in place:
            return open_stored(replace(recording, path=Path(place)), project)
        from annotator.recordings.mirror import open_mirror

        limit_bytes, options = self.cache_mb * 10**6 // MAX_OPEN, stored_options(recording.options)
        mirror = open_mirror(place, scratch_folder() / "recordings", limit_bytes, options)
        return OpenedRecording(mirror, recording)


def parse_elsewhere(words: Sequence[str]) -> tuple[tuple[Path, str], ...]:
    """Parses options of the form FOLDER=PLACE."""
    pairs = []
    for word in words:
        folder, equals, other = word.partition("=")
        if not folder or not equals or not other:
            raise ConfigError(f"{word!r} is not of the form FOLDER=PLACE; write e.g. /data=s3://bucket/data")
        pairs.append((Path(folder).resolve(), other))
    return tuple(pairs)


def scratch_folder() -> Path:
    """Creates and returns the user's own temporary folder, which only the user can write to.

    It holds cached recordings.
    """
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"annotator-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise WorkerError(f"{folder}: cannot be created ({error.strerror}); set TMPDIR to another folder") from error
    is_own = stat.S_ISDIR(status.st_mode) and (os.name == "nt" or status.st_uid == user)
    if not is_own or (os.name != "nt" and stat.S_IMODE(status.st_mode) & 0o022):
        raise WorkerError(f"{folder}: other users can write to it; remove it, or set TMPDIR to another folder")
    return folder


@runtime_checkable
class DetectorSource(Protocol):
    """A picklable description of a pair of detectors."""

    def load(self, threads: int | None) -> Detectors:
        """Loads the detectors, each with a number of processor threads (None = all cores)."""
        ...


@dataclass(frozen=True, eq=False)
class PackedDetectors:
    """Trained detectors with the files of each, for machines without the project.

    Attributes:
        files: contents of the weights and of the file beside them, by name, of the image and the view detector.
    """

    trained: TrainedDetectors
    files: tuple[dict[str, bytes], ...]

    @classmethod
    def of(cls, trained: TrainedDetectors) -> PackedDetectors:
        paths = (trained.image.path, trained.view.path)
        try:
            names = [(path.parent, name) for path in paths for name in (path.name, MODEL_NAME)]
            read = [(name, read_file(folder / name, NETWORK_BYTES)) for folder, name in names]
        except OSError as error:
            raise DetectionError(
                f"{error.filename}: cannot be read ({error.strerror}); train the detector again"
            ) from error
        return cls(trained, (dict(read[:2]), dict(read[2:])))

    def load(self, threads: int | None) -> Detectors:
        """Loads the detectors from a temporary folder."""
        with TemporaryDirectory() as temporary:
            image, view = (
                replace(model, path=Path(temporary) / role / model.path.name)
                for role, model in (("image", self.trained.image), ("view", self.trained.view))
            )
            try:
                for model, files in zip((image, view), self.files, strict=True):
                    model.path.parent.mkdir()
                    for name, content in files.items():
                        (model.path.parent / name).write_bytes(content)
            except OSError as error:
                raise DetectionError(
                    f"{temporary}: cannot be written ({error.strerror}); free some space, or set TMPDIR"
                ) from error
            return replace(self.trained, image=image, view=view).load(threads)
