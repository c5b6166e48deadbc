"""Correcting the calibration of a recording: where its clouds lie relative to its images, in space and time."""

from __future__ import annotations

from contextlib import suppress

from annotator.project import Basis, Project
from annotator.recordings.clouds.virtual_camera import has_virtual_image
from annotator.recordings.frame_times import has_times
from annotator.types import NO_CORRECTION, Correction
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.frame_source import FrameSource


def correct_calibration(
    project: Project, recording_id: int, correction: Correction, author: str, basis: Basis | None = None
) -> int:
    """Corrects the calibration of a recording; its labels stay where they are in the clouds.

    Returns:
        number of labels in the recording.

    Raises:
        ConfigError: a time offset for a recording without times, or a recording whose images show its clouds.
        StaleRevisionError: someone else has adjusted the recording since `basis`.
        RecordingError: the recording is missing or cannot be read.
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
