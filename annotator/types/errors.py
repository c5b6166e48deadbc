"""The errors that annotator raises on purpose.

A message says what is wrong, where (path, frame) and what to do next. These errors are caught in only three
places: the command line, the web layer and the batch loop (which stores the failed frame).
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

RESTORE = "restore it from a backup (`annotator project restore`)"
"""What to do about a damaged project, for messages."""


class AnnotatorError(Exception):
    """Base of all errors that a user is meant to read."""


class InputError(AnnotatorError):
    """Input from the user is not usable."""


class RecordingError(InputError):
    """A recording cannot be read."""


class UnknownFormatError(RecordingError):
    """No reader recognises the path; the message says what it looks like, and which path to give instead.

    Attributes:
        looked_for: what each reader looks for, as `NAME: FILES`.
    """

    def __init__(self, message: str, looked_for: tuple[str, ...] = ()) -> None:
        self.looked_for = looked_for
        super().__init__(message)


class BrokenStartError(RecordingError):
    """None of the first frames of a recording can be read; the others were not tried."""


class FrameError(RecordingError):
    """One frame cannot be read; the rest of the recording may be fine."""

    def __init__(self, path: Path, problem: str, remedy: str = "") -> None:
        self.path = path
        super().__init__(f"{path}: {problem}" + (f"; {remedy}" if remedy else ""))


class UnclearError(FrameError):
    """A file can be read in several ways, or its content contradicts its name or place."""


class DeviceError(RecordingError):
    """A camera cannot be opened, or has stopped delivering frames."""


class FormatError(InputError):
    """A label or dataset file does not follow its format.

    Attributes:
        line: 1-based line number; None for formats without lines.
    """

    def __init__(self, path: Path, problem: str, line: int | None = None) -> None:
        self.path = path
        self.line = line
        where = f"{path}:{line}" if line is not None else str(path)
        super().__init__(f"{where}: {problem}")


class UnitKind(StrEnum):
    """What is in another unit or order."""

    ANGLE = "angle"
    LENGTH = "length"
    QUATERNION = "quaternion"


class UnitError(FormatError):
    """The numbers of a label file are in another unit, or in another order, than its format has."""

    def __init__(self, kind: UnitKind, path: Path, problem: str, line: int | None = None) -> None:
        self.kind = kind
        super().__init__(path, problem, line)


class ConfigError(InputError):
    """A setting or a command-line value is not usable."""


class MovedError(ConfigError):
    """A recording that is to be added is one of the project whose path is gone: it has only moved."""

    def __init__(self, message: str, recording_id: int, name: str) -> None:
        self.recording_id, self.name = recording_id, name
        super().__init__(message)


class ArgumentError(InputError, ValueError):
    """An argument of the Python API cannot be used: a wrong shape, unit, type or camera."""


class GeometryError(AnnotatorError):
    """A computation has no result for this input, such as a box around an empty cloud."""


class DetectionError(AnnotatorError):
    """A 2D detector cannot be trained, loaded or run."""


class ProjectError(AnnotatorError):
    """The project store cannot be opened, or refuses an operation."""


class NotFoundError(ProjectError):
    """Nothing exists under a given name, id or path."""


class ReplacedError(ProjectError):
    """A project's database was removed, or the one that is open is no longer the one on disk."""


class InUseError(ProjectError):
    """A project cannot be moved or renamed while a job, or another process, has it open."""


class StaleRevisionError(ProjectError):
    """A change was based on an older revision of the frame than the stored one."""

    def __init__(self, where: str, expected: int, actual: int) -> None:
        self.expected = expected
        self.actual = actual
        super().__init__(
            f"{where} is at revision {actual}, but the change was made on revision {expected}; "
            "reload the frame and apply the change again"
        )


class TrackTakenError(ProjectError):
    """A track would get a second box in a frame, or a track id that was free when it was chosen is in use by now."""

    def __init__(self, message: str, track_id: int) -> None:
        self.track_id = track_id
        super().__init__(message)


class HistoryError(ProjectError):
    """There is nothing to undo or redo, or someone else has changed it since.

    Attributes:
        frame_id: the frame whose state prevents it; None if no single frame does.
        can_skip: whether the step before can be undone (or redone) instead.
    """

    def __init__(self, message: str, frame_id: int | None = None, *, can_skip: bool = False) -> None:
        self.frame_id, self.can_skip = frame_id, can_skip
        super().__init__(message)


class FinalisedFrameError(ProjectError):
    """An automatic pass cannot change a frame that an operator has finalised."""


class WorkerError(AnnotatorError):
    """A batch's worker processes cannot be started, or crash repeatedly."""


class MissingExtraError(AnnotatorError):
    """An optional package is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        self.extra = extra
        super().__init__(
            f'{package} is not installed; run pip install "rcv-annotator[{extra}]" (scripts/setup {extra} in a clone)'
        )
