"""Labels as a KITTI tracking folder: one sequence per recording."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.kitti.label_files import KittiLabel
from annotator.formats.kitti.tracking_folder import sequence_ids, write_kitti_tracking
from annotator.types.errors import ConfigError
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.kitti_rows import dont_care_rows
from annotator.workflows.tracks.propose_boxes import next_track_id


def write(job: ExportJob) -> ExportReport:
    """Writes the folder; boxes without a track id get a new one, and the report counts them.

    Raises:
        ConfigError: the frames of a recording are not a sequence, or are in several parts.
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
    note = f"{untracked} boxes had no track id of their own and got a new one each; `annotator track` links boxes"
    return report.model_copy(update={"notes": (*report.notes, note)})


def _check(job: ExportJob, stored: dict[str, int]) -> None:
    parts: dict[str, set[str | None]] = {}
    for chosen in job.chosen:
        parts.setdefault(chosen.recording, set()).add(chosen.split)
    for name, recording_id in stored.items():
        if not job.project.recordings.get(recording_id).is_sequence:
            raise ConfigError(
                f"the frames of {name} are not a sequence; export it as kitti, or choose the other recordings with "
                "--recordings"
            )
        if len(parts[name]) > 1:
            raise ConfigError(f"a sequence cannot be divided, and {name} is in several parts; divide by recording")
