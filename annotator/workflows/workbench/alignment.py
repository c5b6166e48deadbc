"""What the page needs to show how a frame's cloud lies on its image, and to correct it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32

from annotator.geometry.projection import thin
from annotator.project import Project, StoredRecording
from annotator.project.adjusting.adjustment import Up
from annotator.recordings.clouds.virtual_image import has_virtual_image
from annotator.recordings.times import has_times, recorded_times
from annotator.types import Frame
from annotator.workflows.workbench.frame_cache import FrameCache

MOST_POINTS = 15_000
# Images that are offered: 30 seconds before and after at 30 Hz, some 90 kB of JSON.
MOST_IMAGES = 2000

UpSource = Literal["unknown", "files", "project"]


@dataclass(frozen=True, eq=False)
class Alignment:
    """A frame as its recording's files give it, and the recording's adjustment.

    Attributes:
        recorded: the frame without the correction.
        xyz_m: some of its points, (n, 3).
        recording: with the correction.
        up: unit vector against gravity in the corrected camera frame.
        up_source: where `up` comes from.
        images: (id, seconds after this frame) of the frames whose images a time offset may show, nearest times first.
        labels: number of labels in the recording.
        drawn_images: number of its frames with boxes on their image.
        is_virtual: the image is drawn from the cloud, so there is no calibration to correct.
    """

    recorded: Frame
    xyz_m: Float32[np.ndarray, "n 3"]
    recording: StoredRecording
    up: Up | None
    up_source: UpSource
    images: tuple[tuple[int, float], ...]
    labels: int
    drawn_images: int
    is_virtual: bool


def alignment(project: Project, cache: FrameCache, frame_id: int) -> Alignment:
    """Reads the alignment of a frame.

    Raises:
        NotFoundError: no such frame.
        FrameError, RecordingError: it cannot be read.
    """
    stored = project.frames.get(frame_id)
    recording = project.recordings.get(stored.recording_id)
    frame, up = cache.recorded(project, frame_id), cache.read(project, frame_id).up
    keep = thin(len(frame.cloud), MOST_POINTS)
    return Alignment(
        frame,
        frame.cloud.xyz_m if keep is None else frame.cloud.xyz_m[keep],
        recording,
        None if up is None else _vector(up),
        "unknown" if up is None else "files" if recording.up is None else "project",
        _images(project, cache, stored.recording_id, stored.key),
        len(project.labels.signals(recordings=[stored.recording_id])),
        len(project.boxes.on_images([stored.recording_id])),
        has_virtual_image(frame),
    )


def _images(project: Project, cache: FrameCache, recording_id: int, key: str) -> tuple[tuple[int, float], ...]:
    recording = cache.recording(project, recording_id)
    times = recorded_times(recording) if has_times(recording) else None
    now = None if times is None else times.get(key)
    if times is None or now is None:
        return ()
    frames = [(frame, times.get(frame.key)) for frame in project.frames.of([recording_id]) if frame.index is not None]
    apart = [(frame.id, (time - now) / 1e9) for frame, time in frames if time is not None]
    return tuple(sorted(apart, key=lambda each: abs(each[1]))[:MOST_IMAGES])


def _vector(up: np.ndarray) -> Up:
    x, y, z = up.tolist()
    return x, y, z
