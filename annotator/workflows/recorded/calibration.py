"""Correcting the calibration of a recording: where its clouds lie relative to its images, in space and time."""

from __future__ import annotations

from annotator.project import Basis, Project
from annotator.recordings.times import has_times
from annotator.types import Correction
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import FrameSource


def correct_calibration(
    project: Project, recording_id: int, correction: Correction, author: str, basis: Basis | None = None
) -> int:
    """Corrects the calibration of a recording; its labels stay where they are in the clouds.

    Returns:
        number of labels in the recording.

    Raises:
        ConfigError: a time offset for a recording without times.
        StaleRevisionError: someone else has adjusted the recording since `basis`.
        RecordingError: the recording is missing or cannot be read.
    """
    if correction.time_offset_s and not has_times(FrameSource(project).recording(recording_id)):
        name = project.recordings.get(recording_id).name
        raise ConfigError(
            f"{name}: its frames have no times, so there is nothing to offset; a timestamps.csv beside them gives some"
        )
    project.adjustments.correct(recording_id, correction, author, basis or Basis())
    return len(project.labels.signals(recordings=[recording_id]))
