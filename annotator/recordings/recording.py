"""The interface of recordings: a list of frames that are read one at a time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from annotator.recordings.options import Place
from annotator.types import Frame


@runtime_checkable
class Recording(Protocol):
    """A folder or file of frames. Opening it lists the frames; `frame` reads one without caching it."""

    @property
    def path(self) -> Path:
        """The path that was opened, as given."""

    @property
    def root(self) -> Path:
        """The folder of the frames (and labels): `path`, or its `training` subfolder."""

    @property
    def format(self) -> str:
        """The reader's name in `annotator.recordings.table`."""

    @property
    def name(self) -> str:
        """A short name to display: that of the folder or file."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The frames' names, unique and stable, in order."""

    @property
    def is_sequence(self) -> bool:
        """True if the frames are in time order."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know about how it is read, such as images without a cloud; one sentence each."""

    def __len__(self) -> int:
        """The number of frames, including broken ones."""

    def frame(self, i: int) -> Frame:
        """Reads frame number `i`, 0-based.

        Raises:
            FrameError: this frame cannot be read; others may be readable.
            IndexError: there is no such frame.
        """


@dataclass(frozen=True)
class NotFound:
    """A reader's result for a path that it does not recognise.

    Attributes:
        looked_for: what the reader recognises, for the error message.
    """

    looked_for: str


@dataclass(frozen=True, eq=False)
class KeyedFrames:
    """The common base of the readers' recordings; each adds its `format`, `is_sequence` and `frame`.

    Attributes:
        path: the path that was opened.
        keys: the frames' names, in order.
        is_parallel: several threads may call `frame` at the same time.
    """

    path: Path
    keys: tuple[str, ...]
    format: ClassVar[str]
    is_sequence: ClassVar[bool]
    is_parallel: ClassVar[bool] = False

    @property
    def root(self) -> Path:
        return self.path

    @property
    def name(self) -> str:
        return self.path.resolve().name

    @property
    def notes(self) -> tuple[str, ...]:
        return ()

    @property
    def origin(self) -> Place | None:
        """The origin in map coordinates (`clouds.origin`); None in a sensor's coordinates, or with a real camera."""
        return None

    def __len__(self) -> int:
        return len(self.keys)

    def files(self, i: int) -> tuple[Path, ...]:
        """Returns the files that only frame `i` is read from, as far as the reader knows them.

        Raises:
            FrameError: one of them is missing.
            IndexError: there is no such frame.
        """
        self.key(i)
        return ()

    def key(self, i: int) -> str:
        """Returns the key of frame `i`; unlike `keys[i]`, it raises for negative indices.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= i < len(self.keys):
            raise IndexError(f"frame {i} of a recording with {len(self.keys)} frames")
        return self.keys[i]


def is_parallel(recording: Recording) -> bool:
    """True if several threads may read frames of a recording at the same time."""
    return isinstance(recording, KeyedFrames) and recording.is_parallel


def files_of(recording: Recording, i: int) -> tuple[Path, ...]:
    """Returns the files that only frame `i` is read from, `KeyedFrames.files`."""
    return recording.files(i) if isinstance(recording, KeyedFrames) else ()


def origin_of(recording: Recording) -> Place | None:
    """Returns the origin of a recording in map coordinates, `KeyedFrames.origin`. It may read a cloud."""
    return recording.origin if isinstance(recording, KeyedFrames) else None
