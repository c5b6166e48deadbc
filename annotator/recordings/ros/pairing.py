"""Pairs the images of a bag with its clouds by time.

The header times of bags that are slow to read are kept in the user's cache folder: to find those of a bag that is
compressed with bz2, half of it must be decompressed, half a minute for 2 GB.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from annotator.files import TABLE_BYTES, read_file, write_atomic
from annotator.recordings.frame_times import nearest
from annotator.recordings.ros.bag import Topic
from annotator.recordings.ros.messages import SECOND, quick_stamp_ns
from annotator.types.messages import amount

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
    parts = [topic.name, topic.type, str(len(topic))]
    for file in topic.files:
        stat = file.path.stat()
        parts += [str(file.path.resolve()), str(stat.st_size), str(stat.st_mtime_ns)]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


# Topics whose stamps are further apart than this, measured against the log, have different clocks.
MOST_APART_NS = SECOND
# Parts of a topic that each thread reads.
PARTS = 4


@dataclass(frozen=True, eq=False)
class Pairs:
    """Message numbers of images and of their clouds, sorted by the image's time, and both times.

    The notes say what has no partner, and what is wrong with the times.
    """

    image: Int64[np.ndarray, "n"]
    cloud: Int64[np.ndarray, "n"]
    time_ns: Int64[np.ndarray, "n"]
    cloud_time_ns: Int64[np.ndarray, "n"]
    notes: tuple[str, ...]


def pair(images: Topic, clouds: Topic, tolerance_s: float) -> Pairs:
    """Pairs each image with a cloud: both are each other's nearest, and within the tolerance.

    Times are those of the messages' headers, unless these are not set or the topics have different clocks.
    """
    notes: list[str] = []
    image_ns, cloud_ns = _times(images, clouds, notes)
    for topic, times in ((images, image_ns), (clouds, cloud_ns)):
        backward = int((np.diff(times) < 0).sum())
        if backward:
            notes.append(
                f"the times of {topic.name} run backward in {amount(backward, 'place')}; its messages are sorted"
            )
    image, cloud = _mutual_nearest(image_ns, cloud_ns)
    apart_ns = np.abs(image_ns[image] - cloud_ns[cloud])
    near = apart_ns <= round(tolerance_s * SECOND)
    lonely_images, lonely_clouds = len(images) - int(near.sum()), len(clouds) - int(near.sum())
    if lonely_images:
        notes.append(
            f"{lonely_images} of {amount(len(images), 'image')} of {images.name} without a partner in {clouds.name} "
            f"within {tolerance_s:g} s"
        )
    if lonely_clouds:
        notes.append(
            f"{lonely_clouds} of {amount(len(clouds), 'message')} of {clouds.name} without an image of its own"
        )
    if len(image) and not near.any():
        notes.append(f"the nearest pair is {apart_ns.min() / SECOND:.3f} s apart; give --tolerance")
    image, cloud = image[near], cloud[near]
    order = np.argsort(image_ns[image], kind="stable")
    image, cloud = image[order], cloud[order]
    return Pairs(image, cloud, image_ns[image], cloud_ns[cloud], tuple(notes))


@lru_cache(maxsize=16)
def stamps_ns(topic: Topic) -> Int64[np.ndarray, "n"]:
    """Returns the times in the headers of a topic's messages; 0 = not set or damaged."""
    return kept_times(topic, partial(_header_times, topic))


def _header_times(topic: Topic) -> Int64[np.ndarray, "n"]:
    threads = (os.cpu_count() or 1) if any(file.is_slow for file in topic.files) else 1
    # neighbours are often in one chunk
    parts = np.array_split(np.arange(len(topic)), PARTS * threads)
    with ThreadPoolExecutor(threads) as pool:
        return np.concatenate([*pool.map(partial(_read_stamps, topic), parts)])


def _read_stamps(topic: Topic, numbers: Int64[np.ndarray, "n"]) -> Int64[np.ndarray, "n"]:
    return np.array([quick_stamp_ns(topic, i) or 0 for i in numbers.tolist()], np.int64)


def _times(images: Topic, clouds: Topic, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    found, late_ns = [], []
    for topic in (images, clouds):
        times = stamps_ns(topic)
        known = times > 0
        unset = amount(len(times) - int(known.sum()), "message")
        if 2 * int(known.sum()) <= len(times):
            notes.append(f"{unset} of {topic.name} without a time in the header; log times are used")
            return images.log_ns, clouds.log_ns
        if not known.all():
            notes.append(f"{unset} of {topic.name} without a readable time, which is taken from the log times")
        late_ns.append(float(np.median((topic.log_ns - times)[known])))
        # taken to be logged as late as the others
        found.append(np.where(known, times, np.maximum(topic.log_ns - round(late_ns[-1]), 0)))
    apart_ns = abs(late_ns[0] - late_ns[1])
    if apart_ns > MOST_APART_NS:
        notes.append(
            f"the header times of {images.name} and {clouds.name} are from clocks {apart_ns / SECOND:.1f} s apart; "
            "log times are used"
        )
        return images.log_ns, clouds.log_ns
    return found[0], found[1]


def _mutual_nearest(a_ns: np.ndarray, b_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not len(a_ns) or not len(b_ns):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    to_b, to_a = nearest(a_ns, b_ns), nearest(b_ns, a_ns)
    mutual = np.flatnonzero(to_a[to_b] == np.arange(len(a_ns)))
    return mutual, to_b[mutual]
