"""Which way is up in a recording that does not know it: estimated from some of its frames, if they agree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from annotator.geometry.up_direction import UpEstimate, estimate_up
from annotator.project import Project, StoredFrame
from annotator.project.adjusting.adjustment import Up
from annotator.types import Frame
from annotator.types.errors import FrameError
from annotator.workflows.frame_source import FrameSource

# Frames that are read, spread over the recording.
MOST_FRAMES = 8
LEAST_CERTAINTY = 0.6
# Frames of a camera that stands still agree within this angle.
AGREE_RAD = np.radians(3.0)
# Share of the certain frames that must agree.
LEAST_AGREEING = 0.8


@dataclass(frozen=True)
class RecordingUp:
    """The up direction of a whole recording.

    Attributes:
        up: unit vector against gravity, camera frame; None if the frames do not tell.
        certainty: 0..1, that `up` is within a few degrees.
        spread_rad: largest angle between `up` and the estimate of a frame that agrees with it.
        frames, agreeing: number of frames that were read, and of those that agree.
        reason: what `up` is based on, or why it is None.
    """

    up: Up | None
    certainty: float
    spread_rad: float
    frames: int
    agreeing: int
    reason: str


def estimate_recording_up(project: Project, recording_id: int) -> RecordingUp:
    """Estimates the up direction of a recording from some of its frames, as they are corrected now.

    Raises:
        NotFoundError: no such recording.
        FrameError: none of the frames can be read.
        RecordingError: the recording is missing or cannot be read.
    """
    project.recordings.get(recording_id)
    frames = [frame for frame in project.frames.of([recording_id]) if frame.index is not None]
    picked = sorted(set(np.linspace(0, len(frames) - 1, min(MOST_FRAMES, len(frames))).round().astype(int).tolist()))
    return agreed_up([estimate_up(frame) for frame in _readable(FrameSource(project), [frames[i] for i in picked])])


def _readable(source: FrameSource, stored: Sequence[StoredFrame]) -> Iterator[Frame]:
    """The frames that can be read; raises the first error if none can."""
    first, read = None, 0
    for each in stored:
        try:
            frame = source.read(each)
        except FrameError as error:
            first = first or error
            continue
        read += 1
        yield frame
    if read == 0 and first is not None:
        raise first


def agreed_up(estimates: Sequence[UpEstimate | None]) -> RecordingUp:
    """The direction on which the frames of one recording agree."""
    known = [each for each in estimates if each is not None]
    if not known:
        return _refused(0.0, len(estimates), "no frame shows a floor, a table, the ground or walls")
    ups, certainties = np.array([each.up for each in known]), np.array([each.certainty for each in known])
    apart = np.arccos(np.clip(ups @ ups.T, -1, 1))
    near = (apart < AGREE_RAD).astype(float)
    best = int(np.argmax(near @ certainties))
    agreeing = near[best] > 0
    certainty = float(certainties[agreeing].max())
    if certainty < LEAST_CERTAINTY:
        return _refused(certainty, len(estimates), "the surfaces in its frames do not tell which way is up")
    certain = certainties >= LEAST_CERTAINTY
    share = certainties[agreeing & certain].sum() / certainties[certain].sum()
    if share < LEAST_AGREEING:
        turn = np.degrees(apart[best][certain].max())
        return _refused(
            float(certainty * share),
            len(estimates),
            f"its frames differ by up to {turn:.0f} degrees: the camera turns, so there is no one direction",
        )
    up = certainties[agreeing] @ ups[agreeing]
    up /= np.linalg.norm(up)
    spread = float(np.arccos(np.clip(ups[agreeing] @ up, -1, 1)).max())
    x, y, z = up.tolist()
    seen = known[int(np.argmax(certainties * agreeing))]
    reason = f"{seen.level_share:.0%} of the seen surface is level, {seen.upright_share:.0%} upright"
    return RecordingUp((x, y, z), certainty, spread, len(estimates), int(agreeing.sum()), reason)


def _refused(certainty: float, frames: int, reason: str) -> RecordingUp:
    return RecordingUp(None, certainty, 0.0, frames, 0, reason)
