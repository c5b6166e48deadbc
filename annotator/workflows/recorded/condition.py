"""What the files of a recording show when it is added: that it has only moved, and which frames cannot be read.

A project keeps the fingerprint of a frame of each recording, which recognises one whose path is gone.
"""

from __future__ import annotations

import hashlib
import random
import re
import shlex
import time
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from annotator.files import open_file, why_missing
from annotator.image_bytes import JPEG_START, PNG_SIGNATURE
from annotator.project import Project, StoredRecording
from annotator.recordings import ReaderOptions, Recording, open_recording, stored_options
from annotator.recordings.listing import IMAGE_SUFFIXES
from annotator.types import Frame
from annotator.types.errors import ConfigError, FrameError, MovedError
from annotator.types.messages import amount, first_few


def fingerprint_of(frame: Frame) -> str:
    """SHA-256 (hex) of a frame's image and points, `:` and its key."""
    digest = hashlib.sha256()
    for array in (frame.rgb, frame.cloud.xyz_m):
        digest.update(repr(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return f"{digest.hexdigest()}:{frame.key}"


def require_not_moved(project: Project, recording: Recording, options: ReaderOptions) -> None:
    """Refuses a recording that the project has under a path that is gone, as its labels would be doubled.

    Args:
        recording: one that the project does not have at this path, as its files give it.
        options: of its reader; the origin is what was found, which may have been another one before.
    """
    options = options.model_copy(update={"origin": None})
    for known in (*project.recordings.all(), *project.recordings.removed()):
        stored = stored_options(known.options)
        is_alike = known.format == recording.format and options.may_be(stored)
        if not is_alike or why_missing(known.path) is None:
            continue
        is_same = ""
        with suppress(ConfigError):  # it has a camera, and the other one had none
            as_known = recording if stored.origin is None else open_recording(recording.path, stored)
            is_same = _is_same(project, known, as_known)
        if is_same:
            name = project.path.name
            # the page lists only those that are in the project
            locate = ", or Locate on the start page" if known.removed_by is None else ""
            words = shlex.join(["annotator", "project", "move", name, known.name, str(recording.path)])
            raise MovedError(
                f"{recording.path}: {is_same} {known.name}, which was at {known.path}; "
                f"to keep its labels, set its new path with `{words}`{locate}; --as-new adds it as another recording",
                known.id,
                known.name,
            )


def _is_same(project: Project, known: StoredRecording, recording: Recording) -> str:
    """Such as "is the recording"; "" if the recordings are different."""
    keys = project.recordings.used_keys(known.id)
    if not keys or not keys <= set(recording.keys):
        return ""
    if known.fingerprint is None:
        return "has the frames of the recording"
    key = known.fingerprint.partition(":")[2]
    with suppress(ValueError, FrameError):
        if fingerprint_of(recording.frame(recording.keys.index(key))) == known.fingerprint:
            return "is the recording"
    return ""


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
            # errors of one kind differ in keys and numbers
            kinds.setdefault(_NUMBER.sub("#", error.replace(key, "#")), []).append(key)
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
    keys = recording.keys
    is_suspicious = [key in suspects or _is_suspicious(recording, i) for i, key in enumerate(keys)]
    errors = {i: _error(recording, i) for i in np.flatnonzero(is_suspicious).tolist()}
    others = np.flatnonzero(~np.array(is_suspicious, bool)).tolist()
    random.Random(0).shuffle(others)
    end = time.monotonic() + seconds
    while others and time.monotonic() <= end:
        i = others.pop()
        errors[i] = _error(recording, i)
    broken = {keys[i]: error for i, error in sorted(errors.items()) if error is not None}
    return BrokenFrames(len(recording), broken, len(others))


def still_broken(recording: Recording, keys: Collection[str]) -> frozenset[str]:
    """Returns those of some frames that cannot be read."""
    broken = (key for i, key in enumerate(recording.keys) if key in keys and _error(recording, i) is not None)
    return frozenset(broken)


def _error(recording: Recording, i: int) -> str | None:
    """Reads a frame, and returns why it cannot be read; None if it can."""
    try:
        recording.frame(i)
    except FrameError as error:
        # the exception itself would keep the images that have been read
        return str(error)
    return None


def _is_suspicious(recording: Recording, i: int) -> bool:
    """True if a file of a frame is missing or empty, or begins like no image although it should."""
    try:
        for file in recording.files(i):
            with open_file(file) as opened:
                head = opened.read(len(PNG_SIGNATURE))
            is_image = head.startswith((PNG_SIGNATURE, JPEG_START))
            if not head or (file.suffix.lower() in IMAGE_SUFFIXES and not is_image):
                return True
    except (FrameError, OSError):
        return True
    return False
