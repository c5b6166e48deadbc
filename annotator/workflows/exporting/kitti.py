"""Labels as a KITTI object folder."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.formats.dataset import DatasetItem
from annotator.formats.kitti import KittiLabel
from annotator.formats.kitti_folder import write_kitti
from annotator.formats.numbered import six_digit_ids
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport
from annotator.workflows.frames import FrameSource
from annotator.workflows.kitti_view import dont_care_rows


def write(job: ExportJob) -> ExportReport:
    """KITTI's own recordings keep their DontCare areas: nobody has labelled these here either.

    Raises as `write_kitti`, `dont_care_rows` and `ExportJob.items`.
    """
    ids = six_digit_ids([(chosen.recording, chosen.stored.key) for chosen in job.chosen])
    source = FrameSource(job.project)
    stored = {chosen.recording: chosen.stored.recording_id for chosen in job.chosen}

    def areas(item: DatasetItem) -> Sequence[KittiLabel]:
        return dont_care_rows(source.recording(stored[item.recording]), item.frame.key)

    counts = write_kitti(job.out, job.items(), ids, job.classes, job.losses, areas=areas, overwrite=job.overwrite)
    return job.report("kitti", counts)
