"""What every reader gives: a list of frames that load one at a time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from annotator.types import Frame


@runtime_checkable
class Recording(Protocol):
    """A folder or file of frames. Opening it lists the frames; `frame` reads one, and nothing is kept."""

    @property
    def path(self) -> Path:
        """What was opened, as it was given."""

    @property
    def root(self) -> Path:
        """The folder that holds the frames (and labels): `path`, or its `training` sub-folder."""

    @property
    def format(self) -> str:
        """The reader's name in `annotator.recordings.table`."""

    @property
    def name(self) -> str:
        """A short name for people: the folder's."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The frames' names, unique and stable, in order."""

    @property
    def is_sequence(self) -> bool:
        """True where the order of the frames is the order of time."""

    def __len__(self) -> int:
        """How many frames there are, broken ones included."""

    def frame(self, i: int) -> Frame:
        """Frame number `i`, 0-based.

        Raises:
            FrameError: this frame cannot be read; the others may be fine.
            IndexError: there is no such frame.
        """


@dataclass(frozen=True)
class NotFound:
    """A reader's answer to a path that it does not recognise.

    Attributes:
        looked_for: what it would have recognised, in words for a user.
    """

    looked_for: str


@dataclass(frozen=True, eq=False)
class KeyedFrames:
    """What the readers' recordings have in common; each adds its `format`, `is_sequence` and `frame`.

    Attributes:
        path: what was opened.
        keys: the frames' names, in order.
    """

    path: Path
    keys: tuple[str, ...]
    format: ClassVar[str]
    is_sequence: ClassVar[bool]

    @property
    def root(self) -> Path:
        return self.path

    @property
    def name(self) -> str:
        return self.path.resolve().name

    def __len__(self) -> int:
        return len(self.keys)

    def key(self, i: int) -> str:
        """The key of frame `i`; unlike `keys[i]`, a negative index is an error too.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= i < len(self.keys):
            raise IndexError(f"frame {i} of a recording with {len(self.keys)} frames")
        return self.keys[i]
