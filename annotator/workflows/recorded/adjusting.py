"""Adjustments of a recording: which way is up in it, and corrections of its calibration.

Some frames of a recording tell which way is up if they show a floor, a table, the ground or walls, and agree. Reviewed
boxes tell if they stand along one axis and are turned about it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from annotator.geometry.oriented_box import common_axis
from annotator.geometry.up_direction import UpEstimate, estimate_up
from annotator.project import Basis, BoxRotation, Project, StoredFrame
from annotator.project.adjusting import Up
from annotator.project.labels import StoredLabel
from annotator.recordings.clouds.virtual_camera import has_virtual_image
from annotator.recordings.frame_times import has_times
from annotator.types import NO_CORRECTION, Correction, Frame
from annotator.types.errors import ConfigError, FrameError, RecordingError
from annotator.types.messages import amount
from annotator.workflows.frame_source import FrameSource

AUTHOR = "up direction of reviewed boxes"

# Frames that are read, spread over the recording.
MOST_FRAMES = 8
LEAST_CERTAINTY = 0.6
# Frames of a camera that stands still agree within this angle.
AGREE_RAD = np.radians(3.0)
# Share of the certain frames that must agree.
LEAST_AGREEING = 0.8
# Frames with reviewed boxes from which the boxes tell, and the number of the latest boxes that count.
LEAST_BOX_FRAMES, MOST_BOXES = 8, 60
# Of boxes drawn with free rotation around standing objects, nine of ten are within 8 to 11 degrees of an axis, which is
# within 4 degrees of the vertical; of eight random boxes, none better than within 18 degrees (docs/benchmarks.md).
MOST_SPREAD_RAD = np.radians(15.0)
# Nine of ten randomly rotated boxes have an axis within this angle of any direction, so such a spread tells nothing.
WORTHLESS_SPREAD_RAD = np.radians(45.0)
# Boxes of an object that did not turn share all their axes.
MOST_ALIKE = 0.8
# Most cameras are held nearly level, so an axis that is further from the top of the image is another one.
MOST_TILT_RAD = np.radians(35.0)


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
    """Estimates the up direction of a recording from some of its frames, as they are corrected now; if these do not
    tell, from its reviewed boxes.
    """
    project.recordings.get(recording_id)
    frames = [frame for frame in project.frames.of([recording_id]) if frame.index is not None]
    picked = sorted(set(np.linspace(0, len(frames) - 1, min(MOST_FRAMES, len(frames))).round().astype(int).tolist()))
    seen = agreed_up([estimate_up(frame) for frame in _readable(FrameSource(project), [frames[i] for i in picked])])
    return seen if seen.up is not None else up_of_boxes(_reviewed(project, recording_id)) or seen


def learn_up(
    project: Project, rotation: BoxRotation | None = None, recordings: Sequence[int] | None = None
) -> tuple[str, ...]:
    """Sets the up direction of recordings whose reviewed boxes tell it, so that further boxes are upright.

    This is done if the rotation of boxes follows the up direction, for recordings whose files do not give it and which
    have never been adjusted. So a direction that was undone or cleared is not set again.

    Returns:
        a message for each such recording.
    """
    if (rotation or project.config.settings.rotation) is not BoxRotation.AUTO:
        return ()
    source, messages = FrameSource(project), []
    for stored in project.recordings.all():
        if stored.up is not None or stored.adjusted or (recordings is not None and stored.id not in recordings):
            continue
        labels = _reviewed(project, stored.id)
        found = up_of_boxes(labels)
        if found is None or found.up is None or _is_known(source, project.frames.get(labels[0].frame_id)):
            continue
        project.adjustments.set_up(stored.id, found.up, AUTHOR)
        messages.append(
            f"{stored.name}: boxes are upright from now on, since {found.reason}; "
            f"`annotator up {project.path.name} {stored.name} --clear` takes the up direction back"
        )
    return tuple(messages)


def up_of_boxes(labels: Sequence[StoredLabel]) -> RecordingUp | None:
    """The up direction that a recording's reviewed boxes share; None if they do not tell."""
    frames = len({each.frame_id for each in labels})
    if frames < LEAST_BOX_FRAMES:
        return None
    shared = common_axis(np.stack([each.label.box.pose[:3, :3] for each in labels]))
    up = shared.axis * (-1 if shared.axis[1] > 0 else 1)  # the image's y axis points down
    if shared.spread_rad > MOST_SPREAD_RAD or shared.alike > MOST_ALIKE or -up[1] < np.cos(MOST_TILT_RAD):
        return None
    x, y, z = up.tolist()
    reason = f"{amount(len(labels), 'reviewed box')} stand along it and are turned about it"
    certainty = 1 - shared.spread_rad / WORTHLESS_SPREAD_RAD
    return RecordingUp((x, y, z), certainty, shared.spread_rad, frames, frames, reason)


def _reviewed(project: Project, recording_id: int) -> tuple[StoredLabel, ...]:
    return project.labels.recent(MOST_BOXES, recording=recording_id)


def _is_known(source: FrameSource, frame: StoredFrame) -> bool:
    """Whether the recording's files give the up direction; if they cannot be read, the work on them reports it."""
    try:
        return source.read(frame).up is not None
    except (FrameError, RecordingError):
        return True


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


def correct_calibration(
    project: Project, recording_id: int, correction: Correction, author: str, basis: Basis | None = None
) -> int:
    """Corrects the calibration of a recording; its labels stay where they are in the clouds.

    Returns:
        number of labels in the recording.
    """
    source, name = FrameSource(project), project.recordings.get(recording_id).name
    if correction != NO_CORRECTION and _has_virtual_images(project, source, recording_id):
        raise ConfigError(f"{name}: its images are drawn from its clouds, so there is no calibration to correct")
    if correction.time_offset_s and not has_times(source.recording(recording_id)):
        raise ConfigError(
            f"{name}: its frames have no times, so there is nothing to offset; a timestamps.csv beside them gives some"
        )
    project.adjustments.correct(recording_id, correction, author, basis or Basis())
    return project.labels.count(recordings=[recording_id])


def _has_virtual_images(project: Project, source: FrameSource, recording_id: int) -> bool:
    """Looks at the first frame that can be read."""
    for frame in project.frames.of([recording_id]):
        with suppress(FrameError):
            return has_virtual_image(source.recorded(frame))
    return False
