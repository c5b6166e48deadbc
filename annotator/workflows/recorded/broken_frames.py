"""The frames of a recording that cannot be read, and why; told when it is added."""

from __future__ import annotations

import random
import re
import time
from collections.abc import Collection
from dataclasses import dataclass, field

from annotator.files import open_file
from annotator.image_bytes import JPEG_START, PNG_SIGNATURE
from annotator.recordings import Recording
from annotator.recordings.listing import IMAGE_SUFFIXES
from annotator.recordings.recording import files_of
from annotator.types.errors import FrameError
from annotator.types.messages import amount, first_few

# Frames are read for this long; of those that are left then, only the files are looked at.
SECONDS = 3.0
# Keys that a message lists for each kind of fault.
MOST_NAMED = 4
_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True)
class BrokenFrames:
    """The result of a look at all frames of a recording.

    Attributes:
        frames: number of frames.
        errors: why frames cannot be read, by key, in the recording's order.
        unread: number of frames of which at most the files were looked at, where the reader knows them.
    """

    frames: int = 0
    errors: dict[str, str] = field(default_factory=dict)
    unread: int = 0

    @property
    def sentences(self) -> tuple[str, ...]:
        """How many frames cannot be read, and for each kind of fault, whose they are, and the first; () without any."""
        if not self.errors:
            return ()
        kinds: dict[str, list[str]] = {}
        for key, error in self.errors.items():
            kinds.setdefault(_kind(key, error), []).append(key)
        first = f"{len(self.errors)} of {amount(self.frames, 'frame')} cannot be read"
        if self.unread:
            first += f" (of {self.unread}, at most the files were looked at)"
        return (
            first,
            *(
                f"{amount(len(keys), 'frame')} ({first_few(keys, MOST_NAMED)}): {self.errors[keys[0]]}"
                for keys in sorted(kinds.values(), key=len, reverse=True)
            ),
        )


def broken_frames(recording: Recording, suspects: Collection[str] = (), seconds: float = SECONDS) -> BrokenFrames:
    """Reads the frames of a recording.

    Args:
        suspects: keys of frames that are read in any case, as are those whose files are missing, empty or no images.
        seconds: how long the other frames are read, in random order.
    """
    errors: dict[int, str] = {}
    others = []
    for i, key in enumerate(recording.keys):
        if key in suspects or _is_suspicious(recording, i):
            errors |= _error(recording, i)
        else:
            others.append(i)
    random.Random(0).shuffle(others)
    end, unread = time.monotonic() + seconds, len(others)
    for i in others:
        if time.monotonic() > end:
            break
        errors |= _error(recording, i)
        unread -= 1
    return BrokenFrames(len(recording), {recording.keys[i]: errors[i] for i in sorted(errors)}, unread)


def still_broken(recording: Recording, keys: Collection[str]) -> frozenset[str]:
    """Returns those of some frames that cannot be read."""
    return frozenset(key for i, key in enumerate(recording.keys) if key in keys and _error(recording, i))


def _error(recording: Recording, i: int) -> dict[int, str]:
    """Reads a frame, and returns its error by its number; {} if it can be read."""
    try:
        recording.frame(i)
    except FrameError as error:
        # the exception itself would keep the images that have been read
        return {i: str(error)}
    return {}


def _is_suspicious(recording: Recording, i: int) -> bool:
    """True if a file of a frame is missing or empty, or begins like no image although it should."""
    try:
        files = files_of(recording, i)
    except FrameError:
        return True
    for file in files:
        try:
            with open_file(file) as opened:
                head = opened.read(len(PNG_SIGNATURE))
        except OSError:
            return True
        if not head or (file.suffix.lower() in IMAGE_SUFFIXES and not head.startswith((PNG_SIGNATURE, JPEG_START))):
            return True
    return False


def _kind(key: str, error: str) -> str:
    """Returns what the errors of one kind have in common: they differ in keys and numbers."""
    return _NUMBER.sub("#", error.replace(key, "#"))
