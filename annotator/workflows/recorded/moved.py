"""Recognises a recording that the project has under a path that is gone: it has only moved.

A project keeps the fingerprint of a frame of each recording. Without one (no frame could be read), the names of the
frames must do, which other recordings may share; so an operator can add it as a new one.
"""

from __future__ import annotations

import hashlib
import shlex

import numpy as np

from annotator.files import why_missing
from annotator.project import Project, StoredRecording
from annotator.recordings import ReaderOptions, Recording, open_recording, stored_options
from annotator.types import Frame
from annotator.types.errors import ConfigError, FrameError, MovedError


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

    Raises:
        MovedError: it has only moved, or seems to; the message says how to set its path.
    """
    options = options.model_copy(update={"origin": None})
    for known in (*project.recordings.all(), *project.recordings.removed()):
        stored = stored_options(known.options)
        is_alike = known.format == recording.format and options.may_be(stored)
        if not is_alike or why_missing(known.path) is None:
            continue
        try:
            as_known = recording if stored.origin is None else open_recording(recording.path, stored)
        except ConfigError:  # it has a camera, and the other one had none
            continue
        is_same = _is_same(project, known, as_known)
        if not is_same:
            continue
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
    if key not in recording.keys:
        return ""
    try:
        frame = recording.frame(recording.keys.index(key))
    except FrameError:
        return ""
    return "is the recording" if fingerprint_of(frame) == known.fingerprint else ""
