"""The header times of bags that are slow to read, kept in the user's cache folder.

To find the times of a bag that is compressed with bz2, half of it must be decompressed: half a minute for 2 GB.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from annotator.files import TABLE_BYTES, read_file, write_atomic
from annotator.recordings.ros.bag import Topic

LOG = logging.getLogger("annotator.bags")
# Faster topics are not kept.
SLOW_S = 2.0


def kept_times(topic: Topic, read: Callable[[], Int64[np.ndarray, "n"]]) -> Int64[np.ndarray, "n"]:
    """Returns the times of a topic's messages: those that were kept for these files, else what `read` returns."""
    path = cache_folder() / f"{_fingerprint(topic)}.npy"
    try:
        kept = np.load(io.BytesIO(read_file(path, TABLE_BYTES)), allow_pickle=False)
        if kept.shape == (len(topic),) and kept.dtype == np.int64:
            return np.asarray(kept)
    except (OSError, ValueError, EOFError):  # not kept, or damaged
        pass
    started = time.monotonic()
    times = read()
    if time.monotonic() - started > SLOW_S:
        content = io.BytesIO()
        np.save(content, times)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, content.getvalue())
        except OSError as error:
            LOG.warning("%s: the times of %s cannot be kept (%s)", path, topic.name, error.strerror)
    return times


def cache_folder() -> Path:
    """Returns the folder of the kept times, which may be removed at any time."""
    place = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(place) if place else Path.home() / ".cache") / "annotator" / "bags"


def _fingerprint(topic: Topic) -> str:
    """Returns a name for a topic in these files, as they are now."""
    parts = [topic.name, topic.type, str(len(topic))]
    for file, _ in topic.sources:
        stat = file.path.stat()
        parts += [str(file.path.resolve()), str(stat.st_size), str(stat.st_mtime_ns)]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()
