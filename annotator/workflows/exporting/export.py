"""Exports a project: chooses the frames, leaves out unreadable ones if requested, and writes the dataset.

A dataset of 2D boxes has camera images, pseudo-views, or both, written one image in memory at a time. Beside the
format's files it has `frames.csv` (the frame of each camera image) and, in each image folder with pseudo-views,
`views.json` (their geometry), so that an import can match both.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from pydantic import Field

from annotator import __version__
from annotator.files import new_folder
from annotator.formats.dataset_writing import (
    DatasetInfo,
    DatasetItem,
    Detector,
    FileNames,
    Loss,
    Losses,
    Lost,
    count_lost,
    write_dataset,
    write_frames,
    writing,
)
from annotator.formats.frame_names import NO_VALUES, FrameOrigin, PictureLabels, Values
from annotator.formats.table import FORMATS, ExportFormat
from annotator.geometry.outline import clip_to_image
from annotator.image_bytes import encoded_image
from annotator.project import REVIEWED, Project, StoredLabel, ViewBoxes
from annotator.project.classes.attributes import AttributeOf
from annotator.recordings import Recording
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.look_around import LookAround, Scanned
from annotator.types import Box2D, BoxKind, Frame, Label
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.detectors import base_titles, lifted_from
from annotator.workflows.exporting.choose import (
    Chosen,
    ChosenPictures,
    ExportFilter,
    Pictures,
    Split,
    choose_frames,
    choose_pictures,
    loose_views,
    of_classes,
    waiting_note,
)
from annotator.workflows.frame_source import FrameSource, seen_labels
from annotator.workflows.recorded.reading import dont_care_rows
from annotator.workflows.views import ViewPlace, drawn_of, outlines, write_places

AnyChosen = TypeVar("AnyChosen", bound=Chosen)


@dataclass(frozen=True)
class ExportOptions:
    """How a dataset is written; formats ignore options that do not apply.

    Attributes:
        image_format: format of camera images; png is lossless.
        pictures: for formats of 2D boxes: export camera images, pseudo-views, or both.
        vertices: labelCloud: boxes as 8 corners instead of centre, size and angles.
    """

    image_format: Literal["png", "jpg"] = "png"
    pictures: Pictures = "images"
    vertices: bool = False


class ExportReport(Strict):
    """The result of an export.

    Attributes:
        format: the dataset's format.
        out: the dataset's folder or file.
        frames: number of frames (of images, in formats of 2D boxes).
        objects: number of boxes.
        objects_by_class: number of boxes by class, with all classes of the dataset.
        splits: number of frames by part; empty for a dataset without parts.
        losses: what the format could not store.
        unreadable: frames that were left out, as `RECORDING/KEY: reason`.
        notes: other remarks, one line each.
    """

    format: str
    out: Path
    frames: int
    objects: int
    objects_by_class: dict[str, int]
    splits: dict[str, int] = Field(default_factory=dict)
    losses: tuple[Loss, ...] = ()
    unreadable: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(eq=False)
class ExportJob:
    """One export.

    Attributes:
        split: how the dataset is divided into parts; None = one part.
        overwrite: replace an older export of the same format at `out`.
        progress: called with (frames done, frames to write).
        losses: counted by the writer.
        unreadable: `RECORDING/KEY: reason` of the frames that were left out so far.
    """

    project: Project
    format: ExportFormat
    out: Path
    choose: ExportFilter
    split: Split | None
    options: ExportOptions
    overwrite: bool
    progress: Callable[[int, int], None] | None
    losses: Losses = field(default_factory=Losses)
    unreadable: list[str] = field(default_factory=list)
    _fault: FrameError | None = None

    def __post_init__(self) -> None:
        self.source = FrameSource(self.project)
        self.states = self.choose.states or FORMATS[self.format].states
        of_frames = [each for each in self.project.config.attributes if each.of is AttributeOf.FRAME]
        self._defaults = {each.name: each.default for each in of_frames if each.default is not None}
        self._values = self.project.frames.attributes()

    def read(self, chosen: Chosen) -> Frame | None:
        """Reads a frame; None if it cannot be read and such frames are left out."""
        try:
            return self.source.read(chosen.stored)
        except FrameError as error:
            if not self.choose.skip_unreadable:
                raise
            self._fault = self._fault or error
            self.unreadable.append(f"{chosen.recording}/{chosen.stored.key}: {error}")
            self.losses.add(Lost.UNREADABLE)
            return None

    def require_some(self, written: int) -> None:
        """Raises the error of the first frame that cannot be read if nothing was written without these frames."""
        if self._fault is not None and not written:
            raise self._fault

    def each(self, frames: Sequence[AnyChosen]) -> Iterator[AnyChosen]:
        """Yields the frames, and tells the progress."""
        for number, chosen in enumerate(frames, 1):
            yield chosen
            if self.progress is not None:
                self.progress(number, len(frames))

    def items(self, frames: Sequence[Chosen]) -> Iterator[DatasetItem]:
        """Reads the frames one by one."""
        for chosen in self.each(frames):
            frame = self.read(chosen)
            if frame is not None:
                yield self._item(chosen, frame)
        self.require_some(len(frames) - len(self.unreadable))

    def _item(self, chosen: Chosen, frame: Frame) -> DatasetItem:
        recording = self.source.recording(chosen.stored.recording_id)
        labels = [
            replace(entry.label, said=tuple(each.said() for each in entry.said)) if entry.said else entry.label
            for entry in chosen.labels
        ]
        if _is_cut(recording):
            self.losses.add(Lost.CUT)
        rows = dont_care_rows(recording, chosen.stored.key) if FORMATS[self.format].areas else ()
        areas = [(row.left, row.top, row.right, row.bottom) for row in rows]
        values = self.frame_values(chosen.stored.id)
        return DatasetItem(chosen.recording, frame, labels, chosen.split, values, areas)

    def frame_values(self, frame_id: int) -> Values:
        """Returns the values of a frame's attributes, with the defaults of those that it lacks."""
        return self._defaults | self._values.get(frame_id, {})

    def report(
        self, objects_by_class: Mapping[str, int], parts: Sequence[str | None], notes: tuple[str, ...] = ()
    ) -> ExportReport:
        """Returns the report, with the losses counted so far.

        Args:
            parts: of each frame or image that was written.
        """
        return ExportReport(
            format=self.format,
            out=self.out,
            frames=len(parts),
            objects=sum(objects_by_class.values()),
            objects_by_class={name: objects_by_class.get(name, 0) for name in self.project.config.classes},
            splits=Counter(part for part in parts if part is not None),
            losses=self.losses.report(),
            unreadable=tuple(self.unreadable),
            notes=notes,
        )


def _is_cut(recording: Recording) -> bool:
    """True if the frames' clouds are the part of a scan that the camera sees."""
    whole = isinstance(recording, CloudFolder) and recording.images is None
    return isinstance(recording, LookAround) or (isinstance(recording, Scanned) and not whole)


# Thinner boxes are left out, pixels.
MIN_SIDE_PX = 1.0
# Boxes of a class that differ by less are equal, pixels.
SAME_PX = 0.01
UNDIVIDED = (
    "without parts: the same images are used for training and validation; split the dataset with "
    "--split train=0.8,val=0.2"
)


Picture = tuple[PictureLabels, bytes, str | None]
"""An image, the bytes of its file, and its part of the dataset."""


def write_pictures(job: ExportJob) -> ExportReport:
    """Writes the dataset atomically."""
    format, options = FORMATS[job.format], job.options
    assert format.pictures is not None
    frames = choose_pictures(job.project, job.choose, job.states, job.split, options.pictures, job.losses)
    parts = tuple(dict.fromkeys(chosen.split for chosen in frames if chosen.split is not None))
    by_class, written = Counter[str](), list[str | None]()
    with new_folder(job.out, lambda old: job.overwrite and format.may_replace(old)) as folder:
        with writing(job.out):
            writer = format.pictures(folder, job.project.config.classes, parts)
        tally = _Tally(job, parts, format.values is None)
        for picture, content, part in tally.pictures(frames):
            with writing(job.out):
                writer.add(picture, content, part)
            by_class.update(picture.labels)
            written.append(part)
        job.require_some(len(written))
        with writing(job.out):
            folders = writer.finish()
            write_frames(folder, tally.origins)
            for part, places in tally.places.items():
                write_places(folders[part or next(iter(folders))], places)
    is_whole = job.format is ExportFormat.YOLO and not parts
    report = job.report(by_class, written, (UNDIVIDED,) if is_whole else ())
    return report.model_copy(update={"splits": {part: written.count(part) for part in parts}})


@dataclass
class _Tally:
    """Yields the images one by one and collects the content of `frames.csv` and `views.json`."""

    job: ExportJob
    parts: tuple[str, ...]
    holds_values: bool
    names: FileNames = field(default_factory=FileNames)
    origins: list[FrameOrigin] = field(default_factory=list)
    places: dict[str | None, list[ViewPlace]] = field(default_factory=lambda: defaultdict(list))

    def pictures(self, frames: Sequence[ChosenPictures]) -> Iterator[Picture]:
        job = self.job
        for chosen in job.each(frames):
            frame = job.read(chosen) if chosen.image else None
            if frame is not None:
                yield self._image(chosen, frame, self._of_other_cameras(chosen))
            for view in chosen.views:
                yield self._view(view, chosen.split, (chosen.recording, chosen.stored.key))
        with_frame = {view.view_id for chosen in frames for view in chosen.views}
        for view in loose_views(job.project, job.choose, job.options.pictures):
            if view.view_id in with_frame:
                # the same image must not be in training and validation
                job.losses.add(Lost.SAME)
                continue
            # views without a frame are for training only
            part = "train" if "train" in self.parts else next(iter(self.parts), None)
            yield self._view(view, part, None)

    def _of_other_cameras(self, chosen: ChosenPictures) -> list[Label]:
        """Returns reviewed labels that were made in other cameras of the moment: objects on this image, too."""
        project, classes = self.job.project, self.job.choose.classes
        others = {each.label.uid for each in project.labels.of_moment(chosen.stored.id) if not each.is_own}
        seen = seen_labels(project, self.job.source, chosen.stored) if others else ()
        return [
            each
            for each in seen
            if each.uid in others and each.state in REVIEWED and (classes is None or each.label in classes)
        ]

    def _image(self, chosen: ChosenPictures, frame: Frame, others: Sequence[Label]) -> Picture:
        losses, image_format = self.job.losses, self.job.options.image_format
        labels = [*(entry.label for entry in chosen.labels), *others]
        drawn = () if chosen.drawn is None else of_classes(chosen.drawn.boxes, self.job.choose.classes)
        every = outlines(frame.camera, labels, MIN_SIDE_PX)
        drawn_places = drawn_of(every, drawn)
        seen = {uid: box for uid, box in every.items() if uid not in drawn_places}
        # a drawn box replaces its label; the other labels are exported as their outlines
        outlined = [label for label in labels if not drawn or label.uid in seen]
        count_lost(
            losses, DatasetItem(chosen.recording, frame, outlined), (Lost.SCORE, Lost.TRACK, Lost.STATE, Lost.TIME)
        )
        losses.add(Lost.SOLID, len(outlined))
        losses.add(Lost.SAID, sum(bool(entry.said) for entry in chosen.labels))
        losses.add(Lost.OUTSIDE, len(outlined) - len(seen))
        values = {label.uid: label.attributes for label in labels}
        of_drawn = {place: values[uid] for uid, place in drawn_places.items()}
        boxes = [(box, of_drawn.get(place, NO_VALUES)) for place, box in enumerate(drawn)]
        boxes += [(box, values[uid]) for uid, box in seen.items()]
        height_px, width_px = frame.rgb.shape[:2]
        kept = _fit(boxes, width_px, height_px, losses)
        of_frame = self.job.frame_values(chosen.stored.id)
        held = [*(each for _, each in kept), of_frame] if self.holds_values else []
        losses.add_values((_names([*values.values(), of_frame]) - _names(held)).elements())
        kind = BoxKind.BOX if chosen.drawn is None else chosen.drawn.box_kind
        losses.add(Lost.KIND, 0 if kind is BoxKind.BOX else len(seen))
        stem = self.names.add(chosen.recording, chosen.stored.key)
        self.origins.append(FrameOrigin(stem, chosen.recording, chosen.stored.key, chosen.split))
        with writing(self.job.out):
            content = encoded_image(frame.rgb, image_format)
        picture = PictureLabels(
            f"{stem}.{image_format}",
            tuple(box for box, _ in kept),
            (width_px, height_px),
            box_kind=kind,
            values=tuple(each for _, each in kept) if any(held[:-1]) else (),
            attributes=of_frame,
        )
        return picture, content, chosen.split

    def _view(self, view: ViewBoxes, part: str | None, origin: tuple[str, str] | None) -> Picture:
        """Returns a pseudo-view, always as PNG: an import recognises it by its bytes."""
        recording, key = origin or (None, None)
        parts = ("view", view.view_id[:12]) if recording is None or key is None else (recording, key, "view")
        name = f"{self.names.add(*parts)}.png"
        self.places[part].append(
            ViewPlace(
                file_name=name, recording=recording, frame=key, step=view.step, geometry=view.geometry, labelled=True
            )
        )
        views = self.job.project.views
        content, (width_px, height_px) = views.content(view.view_id), views.size(view.view_id)
        boxes = [(box, NO_VALUES) for box in of_classes(view.boxes, self.job.choose.classes)]
        kept = tuple(box for box, _ in _fit(boxes, width_px, height_px, self.job.losses))
        return PictureLabels(name, kept, (width_px, height_px), box_kind=view.box_kind), content, part


def _names(values: Iterable[Values]) -> Counter[str]:
    return Counter(name for each in values for name in each)


def _fit(
    boxes: Sequence[tuple[Box2D, Values]], width_px: int, height_px: int, losses: Losses
) -> list[tuple[Box2D, Values]]:
    """Returns the boxes clipped to their image, with their values; counts boxes outside it and duplicates."""
    clipped: list[tuple[Box2D, Values]] = []
    for box, values in boxes:
        cut = clip_to_image(box, width_px, height_px, MIN_SIDE_PX)
        if cut is None:
            losses.add(Lost.OUTSIDE)
        elif any(_is_same(cut, other) for other, _ in clipped):
            losses.add(Lost.SAME)
        else:
            clipped.append((cut, values))
    return clipped


def _is_same(box: Box2D, other: Box2D) -> bool:
    return box.label == other.label and bool(np.allclose(box.xyxy, other.xyxy, rtol=0, atol=SAME_PX))


UNREGISTERED = "unregistered"


def write_boxes(job: ExportJob) -> ExportReport:
    """Writes a dataset of 3D boxes."""
    project, options = job.project, job.options
    frames = choose_frames(project, job.choose, job.states, job.split)
    recordings = {chosen.recording: chosen.stored.recording_id for chosen in frames}
    is_tracking = job.format is ExportFormat.KITTI_TRACKING
    if is_tracking:
        _require_sequences(project, frames)
    info = DatasetInfo(
        classes=project.config.classes,
        generator=f"annotator {__version__}",
        image_format=options.image_format,
        vertices=options.vertices,
        detectors=_detectors(project, [entry for chosen in frames for entry in chosen.labels]),
        places=[(each.recording, each.stored.key, each.stored.index or 0) for each in frames],
        free_tracks={name: project.labels.next_track_id(id) for name, id in recordings.items()} if is_tracking else {},
    )
    written = write_dataset(FORMATS[job.format], job.out, job.items(frames), info, job.losses, overwrite=job.overwrite)
    note = waiting_note(project, job.choose, job.states, frames)
    notes = (*written.notes, *([] if note is None else [note]))
    return job.report(written.counts, [origin.split for origin in written.origins], notes)


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
    job = ExportJob(
        project, format, out, choose or ExportFilter(), split, options or ExportOptions(), overwrite, progress
    )
    return write_pictures(job) if FORMATS[format].flat else write_boxes(job)
