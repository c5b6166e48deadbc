"""Labels as a KITTI tracking folder: a sequence for each recording."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.formats.dataset import DatasetItem
from annotator.formats.kitti import KittiLabel
from annotator.formats.kitti_tracking import sequence_ids, write_kitti_tracking
from annotator.types.errors import ConfigError
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport
from annotator.workflows.frames import FrameSource
from annotator.workflows.kitti_view import dont_care_rows
from annotator.workflows.tracks.place import next_track_id


def write(job: ExportJob) -> ExportReport:
    """Boxes without a track id get one of their own, which the report tells.

    Raises:
        ConfigError: frames of a recording that do not follow each other in time, or are in several parts.
        FormatError, RecordingError: as `write_kitti_tracking`, `dont_care_rows` and `ExportJob.items`.
    """
    stored = {chosen.recording: chosen.stored.recording_id for chosen in job.chosen}
    _check(job, stored)
    ids = sequence_ids([(each.recording, each.stored.key, each.stored.index or 0) for each in job.chosen])
    source = FrameSource(job.project)

    def areas(item: DatasetItem) -> Sequence[KittiLabel]:
        return dont_care_rows(source.recording(stored[item.recording]), item.frame.key)

    free = {name: next_track_id(job.project, recording_id) for name, recording_id in stored.items()}
    counts, untracked = write_kitti_tracking(
        job.out, job.items(), ids, free, job.classes, job.losses, areas=areas, overwrite=job.overwrite
    )
    report = job.report("kitti-tracking", counts)
    if not untracked:
        return report
    note = f"{untracked} boxes had no track id of their own, and each got a new one; `annotator track` links boxes"
    return report.model_copy(update={"notes": (*report.notes, note)})


def _check(job: ExportJob, stored: dict[str, int]) -> None:
    parts: dict[str, set[str | None]] = {}
    for chosen in job.chosen:
        parts.setdefault(chosen.recording, set()).add(chosen.split)
    for name, recording_id in stored.items():
        if not job.project.recordings.get(recording_id).is_sequence:
            raise ConfigError(
                f"the frames of {name} do not follow each other in time; export it as kitti, or name the others with "
                "--recordings"
            )
        if len(parts[name]) > 1:
            raise ConfigError(f"a sequence cannot be divided, and {name} is in several parts; divide by recording")
