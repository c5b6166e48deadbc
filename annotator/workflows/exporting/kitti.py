"""Labels as a KITTI object folder."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.frame_class_names import six_digit_ids
from annotator.formats.kitti.label_files import KittiLabel
from annotator.formats.kitti.object_folder import write_kitti
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.kitti_rows import dont_care_rows


def write(job: ExportJob) -> ExportReport:
    """Writes the folder; KITTI's own recordings keep their DontCare areas.

    Raises as `write_kitti`, `dont_care_rows` and `ExportJob.items`.
    """
    ids = six_digit_ids([(chosen.recording, chosen.stored.key) for chosen in job.chosen])
    source = FrameSource(job.project)
    stored = {chosen.recording: chosen.stored.recording_id for chosen in job.chosen}

    def areas(item: DatasetItem) -> Sequence[KittiLabel]:
        return dont_care_rows(source.recording(stored[item.recording]), item.frame.key)

    counts = write_kitti(job.out, job.items(), ids, job.classes, job.losses, areas=areas, overwrite=job.overwrite)
    return job.report("kitti", counts)
