"""Exports a project: datasets of 3D boxes, and the one function for all formats."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from annotator import __version__
from annotator.formats.dataset_writing import (
    DatasetInfo,
    DatasetItem,
    Detector,
    Lost,
    write_dataset,
)
from annotator.formats.table import FORMATS, ExportFormat
from annotator.project import Project, StoredLabel
from annotator.recordings import Recording
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.look_around import LookAround, Scanned
from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.types.messages import amount
from annotator.workflows.detectors import base_titles, lifted_from
from annotator.workflows.exporting.choose import ExportFilter, Split
from annotator.workflows.exporting.job import Chosen, ExportJob, ExportOptions, ExportReport
from annotator.workflows.exporting.pictures import PictureExport
from annotator.workflows.recorded.reading import dont_care_rows


def _is_cut(recording: Recording) -> bool:
    """True if the frames' clouds are the part of a scan that the camera sees."""
    whole = isinstance(recording, CloudFolder) and recording.images is None
    return isinstance(recording, LookAround) or (isinstance(recording, Scanned) and not whole)


UNREGISTERED = "unregistered"


class BoxExport(ExportJob):
    """Writes frames with their 3D boxes."""

    def write(self) -> ExportReport:
        project, options = self.project, self.options
        frames = self._chosen()
        recordings = {chosen.recording: chosen.stored.recording_id for chosen in frames}
        is_tracking = self.format is ExportFormat.KITTI_TRACKING
        if is_tracking:
            _require_sequences(project, frames)
        info = DatasetInfo(
            classes=project.config.classes,
            generator=f"annotator {__version__}",
            image_format=options.image_format,
            vertices=options.vertices,
            detectors=_detectors(project, [entry for chosen in frames for entry in chosen.labels]),
            places=[(each.recording, each.stored.key, each.stored.index or 0) for each in frames],
            free_tracks={name: project.labels.next_track_id(id) for name, id in recordings.items()}
            if is_tracking
            else {},
        )
        written = write_dataset(
            FORMATS[self.format], self.out, self._items(frames), info, self.losses, overwrite=self.overwrite
        )
        splits = Counter(origin.split for origin in written.origins if origin.split is not None)
        return self._report(written.counts, splits, len(written.origins), [*written.notes, *self._waiting(frames)])

    def _chosen(self) -> list[Chosen]:
        """Returns the frames to export, in the project's order."""
        if not self.labels and not self.choose.empty_frames:
            waiting = 0 if ReviewState.PROPOSED in self.states else len(self._selected([ReviewState.PROPOSED]))
            advice = (
                f"{waiting} are proposed and not reviewed: review them (`annotator serve`), or also choose the state "
                "proposed to export them as they are"
                if waiting
                else "run `annotator annotate` first, or choose other states"
            )
            raise ConfigError(
                f"project {self.project.config.name} has no labels in state {', '.join(self.states)} to export; "
                f"{advice}"
            )
        every = self.project.frames.of(self.choose.recordings)
        has_all = self.choose.empty_frames
        return self._divided([f for f in every if f.id in self.labels or (has_all and f.index is not None)])

    def _waiting(self, chosen: Sequence[Chosen]) -> list[str]:
        """Notes about exported frames with unreviewed proposals, which are left out."""
        if ReviewState.PROPOSED in self.states:
            return []
        exported = {each.stored.id for each in chosen}
        proposed = self._selected([ReviewState.PROPOSED])
        frames = [entry.frame_id for entry in proposed if entry.frame_id in exported]
        note = (
            f"left out: {amount(len(frames), 'unreviewed proposal')} on {len(set(frames))} of these frames; finish the "
            "review first if the labels must be complete"
        )
        return [note] if frames else []

    def _items(self, frames: Sequence[Chosen]) -> Iterator[DatasetItem]:
        """Reads the frames one by one."""
        for chosen in self._each(frames):
            frame = self._read(chosen)
            if frame is None:
                continue
            recording = self.source.recording(chosen.stored.recording_id)
            labels = [replace(each.label, said=each.said) for each in chosen.labels]
            if _is_cut(recording):
                self.losses.add(Lost.CUT)
            rows = dont_care_rows(recording, chosen.stored.key) if FORMATS[self.format].areas else ()
            areas = [(row.left, row.top, row.right, row.bottom) for row in rows]
            values = self._frame_values(chosen.stored.id)
            yield DatasetItem(chosen.recording, frame, labels, chosen.split, values, areas)
        self._require_some(len(frames) - len(self.unreadable))


def _detectors(project: Project, labels: Sequence[StoredLabel]) -> tuple[Detector, ...]:
    """Returns the detectors that proposed these labels, in the order of their runs, and those that suggested them."""
    run_ids, titles = {entry.run_id for entry in labels}, base_titles(project)
    names = {(model.role.value, model.fingerprint): model.path.parent.name for model in project.models.all()}
    used = dict[tuple[str, str], None]()
    for run in project.jobs.all():
        image, view = ("image", run.image_detector), ("view", run.view_detector)
        used |= {image: None, view: None} if run.id in run_ids else {}
        if run.id in titles:
            names[view] = titles[run.id]
        if origin := lifted_from(run):
            names[image] = origin
    # other detectors that were not trained in the project (as in the benchmarks) have no name
    for entry in labels:
        if (suggestion := entry.label.suggestion) is not None:
            names.setdefault(("view", suggestion.fingerprint), suggestion.detector)
            used.setdefault(("view", suggestion.fingerprint))
    return tuple(Detector(role=r, name=names.get((r, f), UNREGISTERED), fingerprint=f) for r, f in used)


def _require_sequences(project: Project, frames: Sequence[Chosen]) -> None:
    parts: dict[str, str | None] = {}
    for chosen in frames:
        name = chosen.recording
        if name not in parts and not project.recordings.get(chosen.stored.recording_id).is_sequence:
            raise ConfigError(
                f"the frames of {name} are not a sequence; export it as kitti, or choose the other recordings with "
                "--recordings"
            )
        if parts.setdefault(name, chosen.split) != chosen.split:
            raise ConfigError(f"a sequence cannot be divided, and {name} is in several parts; divide by recording")


def export_project(
    project: Project,
    out: Path,
    format: ExportFormat = ExportFormat.RCV,
    *,
    choose: ExportFilter | None = None,
    split: Split | None = None,
    options: ExportOptions | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ExportReport:
    """Writes the chosen labels with their images and clouds to `out`, atomically; arguments as in `ExportJob`."""
    kind = PictureExport if FORMATS[format].flat else BoxExport
    job = kind(project, format, out, choose or ExportFilter(), split, options or ExportOptions(), overwrite, progress)
    return job.write()
