"""Writes 3D boxes in each format. All functions raise as the writer in `annotator.formats` and `ExportJob.items`."""

from __future__ import annotations

from collections.abc import Sequence

from annotator import __version__
from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.frame_class_names import six_digit_ids
from annotator.formats.kitti.label_files import KittiLabel
from annotator.formats.kitti.object_folder import write_kitti
from annotator.formats.kitti.tracking_folder import sequence_ids, write_kitti_tracking
from annotator.formats.labelcloud import write_labelcloud
from annotator.formats.nuscenes import write_nuscenes
from annotator.formats.openlabel import write_openlabel
from annotator.formats.rcv import RcvDetector, RcvInfo, RcvOptions, export_rcv
from annotator.formats.sunrgbd.folder import write_sunrgbd
from annotator.formats.sustechpoints import write_sustechpoints
from annotator.types.errors import ConfigError
from annotator.types.messages import amount
from annotator.workflows.detectors import base_titles, lifted_from
from annotator.workflows.exporting.job import ExportJob, ExportReport
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.kitti_rows import dont_care_rows
from annotator.workflows.tracks.propose_boxes import next_track_id

UNREGISTERED = "unregistered"
# SUN RGB-D numbers its frames from 1.
FIRST_SUNRGBD = 1


def rcv_dataset(job: ExportJob) -> ExportReport:
    """Writes a dataset in the `rcv` format, which stores all data of the labels."""
    info = RcvInfo(
        classes=job.classes,
        detectors=_detectors(job),
        generator=f"annotator {__version__}",
        options=RcvOptions(image_format=job.options.image_format),
    )
    manifest = export_rcv(job.out, job.items(), info, overwrite=job.overwrite)
    return job.report("rcv", manifest.counts.objects_by_class)


def _detectors(job: ExportJob) -> tuple[RcvDetector, ...]:
    """Returns the detectors that proposed these labels, in the order of their runs, and those that suggested them."""
    project = job.project
    run_ids = {entry.run_id for chosen in job.chosen for entry in chosen.labels}
    names = {(model.role.value, model.fingerprint): model.path.parent.name for model in project.models.all()}
    detectors = dict.fromkeys(
        used
        for run in project.jobs.all()
        if run.id in run_ids
        for used in (("image", run.image_detector), ("view", run.view_detector))
    )
    titles = base_titles(project)
    for run in project.jobs.all():
        if run.id in titles:
            names["view", run.view_detector] = titles[run.id]
        if origin := lifted_from(run):
            names["image", run.image_detector] = origin
    # other detectors that were not trained in the project (as in the benchmarks) have no name
    for suggestion in [entry.label.suggestion for chosen in job.chosen for entry in chosen.labels]:
        if suggestion is not None:
            names.setdefault(("view", suggestion.fingerprint), suggestion.detector)
            detectors.setdefault(("view", suggestion.fingerprint))
    return tuple(RcvDetector(role=r, name=names.get((r, f), UNREGISTERED), fingerprint=f) for r, f in detectors)


def kitti_folder(job: ExportJob) -> ExportReport:
    """Writes a KITTI object folder; KITTI's own recordings keep their DontCare areas."""
    ids = six_digit_ids([(chosen.recording, chosen.stored.key) for chosen in job.chosen])
    areas = _DontCareAreas(job)
    counts = write_kitti(job.out, job.items(), ids, job.classes, job.losses, areas=areas, overwrite=job.overwrite)
    return job.report("kitti", counts)


def kitti_tracking_folder(job: ExportJob) -> ExportReport:
    """Writes a KITTI tracking folder, one sequence per recording; KITTI's own recordings keep their DontCare areas.

    Boxes without a track id get a new one, and the report counts them.

    Raises:
        ConfigError: the frames of a recording are not a sequence, or are in several parts.
    """
    areas = _DontCareAreas(job)
    _require_sequences(job, areas.recordings)
    ids = sequence_ids([(each.recording, each.stored.key, each.stored.index or 0) for each in job.chosen])
    free = {name: next_track_id(job.project, recording_id) for name, recording_id in areas.recordings.items()}
    counts, untracked = write_kitti_tracking(
        job.out, job.items(), ids, free, job.classes, job.losses, areas=areas, overwrite=job.overwrite
    )
    report = job.report("kitti-tracking", counts)
    if not untracked:
        return report
    note = f"{amount(untracked, 'box')} without a track id got a new one each; `annotator track` links boxes"
    return report.model_copy(update={"notes": (*report.notes, note)})


class _DontCareAreas:
    """Reads the DontCare areas of exported frames.

    Attributes:
        recordings: id of each exported recording, by name.
    """

    def __init__(self, job: ExportJob) -> None:
        self.recordings = {chosen.recording: chosen.stored.recording_id for chosen in job.chosen}
        self._source = FrameSource(job.project)

    def __call__(self, item: DatasetItem) -> Sequence[KittiLabel]:
        return dont_care_rows(self._source.recording(self.recordings[item.recording]), item.frame.key)


def _require_sequences(job: ExportJob, recordings: dict[str, int]) -> None:
    parts: dict[str, set[str | None]] = {}
    for chosen in job.chosen:
        parts.setdefault(chosen.recording, set()).add(chosen.split)
    for name, recording_id in recordings.items():
        if not job.project.recordings.get(recording_id).is_sequence:
            raise ConfigError(
                f"the frames of {name} are not a sequence; export it as kitti, or choose the other recordings with "
                "--recordings"
            )
        if len(parts[name]) > 1:
            raise ConfigError(f"a sequence cannot be divided, and {name} is in several parts; divide by recording")


def sunrgbd_folder(job: ExportJob) -> ExportReport:
    """Writes a SUN RGB-D folder in the layout that VoteNet extracts."""
    ids = six_digit_ids([(chosen.recording, chosen.stored.key) for chosen in job.chosen], FIRST_SUNRGBD)
    counts = write_sunrgbd(job.out, job.items(), ids, job.classes, job.losses, overwrite=job.overwrite)
    return job.report("sunrgbd", counts)


def openlabel_documents(job: ExportJob) -> ExportReport:
    """Writes OpenLABEL documents, which store each box's rotation, track, score, state and author."""
    used = [f"{detector.role}: {detector.name}" for detector in _detectors(job)]
    objects = write_openlabel(
        job.out,
        job.items(),
        f"annotator {__version__}",
        job.options.image_format,
        comment=f"Detectors that proposed boxes: {'; '.join(used)}" if used else None,
        losses=job.losses,
        overwrite=job.overwrite,
    )
    return job.report("openlabel", dict(objects))


def labelcloud_project(job: ExportJob) -> ExportReport:
    """Writes a labelCloud project."""
    objects = write_labelcloud(
        job.out,
        job.items(),
        job.classes,
        job.losses,
        __version__,
        vertices=job.options.vertices,
        image_format=job.options.image_format,
        overwrite=job.overwrite,
    )
    return job.report("labelcloud", dict(objects))


def nuscenes_tables(job: ExportJob) -> ExportReport:
    """Writes nuScenes tables."""
    objects = write_nuscenes(
        job.out,
        job.items(),
        job.classes,
        job.losses,
        image_format=job.options.image_format,
        overwrite=job.overwrite,
    )
    return job.report("nuscenes", dict(objects))


def sustechpoints_scenes(job: ExportJob) -> ExportReport:
    """Writes SUSTechPOINTS' data folder."""
    objects = write_sustechpoints(
        job.out, job.items(), job.losses, image_format=job.options.image_format, overwrite=job.overwrite
    )
    return job.report("sustechpoints", dict(objects))
