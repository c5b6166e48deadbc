"""Exports a project: chooses the frames, leaves out unreadable ones if requested, and writes the dataset.

A dataset of 2D boxes has camera images, pseudo-views, or both, written one image in memory at a time. Beside the
format's files it has `frames.csv` (the frame of each camera image) and, in each image folder with pseudo-views,
`views.json` (their geometry), so that an import can match both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

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
from annotator.project import REVIEWED, ImageBoxes, Project, StoredFrame, StoredLabel, ViewBoxes
from annotator.project.classes.attributes import AttributeOf
from annotator.recordings import Recording
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.look_around import LookAround, Scanned
from annotator.types import Box2D, BoxKind, Frame, Label, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, FrameError
from annotator.types.messages import alternatives, amount
from annotator.workflows.detectors import base_titles, lifted_from
from annotator.workflows.exporting.choose import ExportFilter, Pictures, Split, assign
from annotator.workflows.frame_source import FrameSource, seen_labels
from annotator.workflows.recorded.reading import dont_care_rows
from annotator.workflows.views import ViewPlace, drawn_of, outlines, write_places


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


@dataclass(frozen=True, eq=False)
class Chosen:
    """One frame to export.

    Attributes:
        labels: its labels to export.
        split: its part of the dataset; None for a dataset without parts.
        image: in datasets of 2D boxes: True to export the camera image.
        drawn: the boxes drawn on it; the frame's other labels are projected onto it.
        views: labelled pseudo-views of the frame to export.
    """

    stored: StoredFrame
    recording: str
    labels: Sequence[StoredLabel]
    split: str | None
    image: bool = False
    drawn: ImageBoxes | None = None
    views: Sequence[ViewBoxes] = ()


NOT_REJECTED = (ReviewState.PROPOSED, *REVIEWED)


@dataclass(eq=False)
class ExportJob(ABC):
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
        config = self.project.config
        if unknown := sorted(set(self.choose.classes or ()) - set(config.classes)):
            raise ConfigError(
                f"project {config.name} has no class {unknown[0]!r}; {alternatives(unknown[0], config.classes)}"
            )
        self.labels = defaultdict[int, list[StoredLabel]](list)
        for entry in self._selected(self.states):
            self.labels[entry.frame_id].append(entry)

    @abstractmethod
    def write(self) -> ExportReport:
        """Writes the dataset atomically."""

    def _selected(self, states: Sequence[ReviewState]) -> Sequence[StoredLabel]:
        chosen = self.choose
        return self.project.labels.select(states=states, recordings=chosen.recordings, classes=chosen.classes)

    def _divided(self, frames: Sequence[StoredFrame]) -> list[Chosen]:
        """Returns the frames with their labels and parts."""
        names = {recording.id: recording.name for recording in self.project.recordings.all()}
        places = [(names[f.recording_id], f.key) for f in frames]
        parts = [None] * len(frames) if self.split is None else assign(self.split, places)
        return [
            Chosen(frame, place[0], self.labels.get(frame.id, ()), part)
            for frame, place, part in zip(frames, places, parts, strict=True)
        ]

    def _read(self, chosen: Chosen) -> Frame | None:
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

    def _require_some(self, written: int) -> None:
        """Raises the error of the first frame that cannot be read if nothing was written without these frames."""
        if self._fault is not None and not written:
            raise self._fault

    def _each(self, frames: Sequence[Chosen]) -> Iterator[Chosen]:
        """Yields the frames, and tells the progress."""
        for number, chosen in enumerate(frames, 1):
            yield chosen
            if self.progress is not None:
                self.progress(number, len(frames))

    def _frame_values(self, frame_id: int) -> Values:
        """Returns the values of a frame's attributes, with the defaults of those that it lacks."""
        return self._defaults | self._values.get(frame_id, {})

    def _report(
        self, objects_by_class: Mapping[str, int], splits: Mapping[str, int], frames: int, notes: Sequence[str]
    ) -> ExportReport:
        """Returns the report, with the losses counted so far."""
        return ExportReport(
            format=self.format,
            out=self.out,
            frames=frames,
            objects=sum(objects_by_class.values()),
            objects_by_class={name: objects_by_class.get(name, 0) for name in self.project.config.classes},
            splits=dict(splits),
            losses=self.losses.report(),
            unreadable=tuple(self.unreadable),
            notes=tuple(notes),
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


class PictureExport(ExportJob):
    """Writes images one by one, and collects the content of `frames.csv` and `views.json`."""

    def write(self) -> ExportReport:
        format = FORMATS[self.format]
        assert format.pictures is not None
        self._names, self._origins = FileNames(), list[FrameOrigin]()
        self._places = defaultdict[str | None, list[ViewPlace]](list)
        frames, loose = self._chosen()
        parts = tuple(dict.fromkeys(chosen.split for chosen in frames if chosen.split is not None))
        by_class, written = Counter[str](), list[str | None]()
        with new_folder(self.out, lambda old: self.overwrite and format.may_replace(old)) as folder:
            with writing(self.out):
                writer = format.pictures(folder, self.project.config.classes, parts)
            for picture, content, part in self._pictures(frames, loose, parts):
                with writing(self.out):
                    writer.add(picture, content, part)
                by_class.update(picture.labels)
                written.append(part)
            self._require_some(len(written))
            with writing(self.out):
                folders = writer.finish()
                write_frames(folder, self._origins)
                for part, places in self._places.items():
                    write_places(folders[part or next(iter(folders))], places)
        is_whole = self.format is ExportFormat.YOLO and not parts
        splits = {part: written.count(part) for part in parts}
        return self._report(by_class, splits, len(written), [UNDIVIDED] if is_whole else [])

    def _chosen(self) -> tuple[list[Chosen], list[ViewBoxes]]:
        """Returns the frames whose images are exported, in the project's order, and the views without a frame.

        A camera image is exported with the boxes drawn on it, and with the outlines of the frame's other labels. An
        image without boxes is exported as background if an operator confirmed it: its drawn boxes were saved as empty,
        or the frame is finalised and has only rejected labels. An image with unreviewed proposals and without drawn
        boxes is not exported, because a detector would learn to treat these objects as background. Views without a
        frame were imported, for training only.
        """
        project, recordings, pictures = self.project, self.choose.recordings, self.options.pictures
        images: dict[int, ImageBoxes] = {}
        with_image: set[int] = set()
        if pictures != "views":
            images = {boxes.frame_id: boxes for boxes in project.boxes.on_images(recordings)}
            with_image = self._with_image(images)
        views = defaultdict[int | None, list[ViewBoxes]](list)
        for view in project.boxes.on_views() if pictures != "images" else ():
            if self._is_drawn(view.boxes):
                views[view.frame_id].append(view)
        loose = views.pop(None, []) if recordings is None else []
        frames = [frame for frame in project.frames.of(recordings) if frame.id in with_image or frame.id in views]
        if not frames and not loose:
            raise ConfigError(
                f"project {project.config.name} has no labelled {'images or views' if pictures == 'both' else pictures}"
                " to export; draw boxes, or review proposals (`annotator serve`)"
            )
        chosen = [
            replace(c, image=c.stored.id in with_image, drawn=images.get(c.stored.id), views=views[c.stored.id])
            for c in self._divided(frames)
        ]
        return chosen, loose

    def _with_image(self, images: Mapping[int, ImageBoxes]) -> set[int]:
        """Returns the frames whose camera images are exported; counts those that only unreviewed proposals prevent."""
        # all states except rejected: an object is not background, even if its state was not chosen
        existing = self._selected(NOT_REJECTED)
        with_object = {entry.frame_id for entry in existing}
        waiting = {entry.frame_id for entry in existing if entry.label.state is ReviewState.PROPOSED}
        chosen = set()
        for frame in self.project.frames.of(self.choose.recordings):
            drawn = images.get(frame.id)
            if drawn is not None:
                is_exported = self._is_drawn(drawn.boxes)
            elif frame.id in waiting and ReviewState.PROPOSED not in self.states:
                self.losses.add(Lost.OPEN, int(frame.id in self.labels))
                is_exported = False
            elif frame.id in self.labels or frame.id in with_object:
                is_exported = frame.id in self.labels
            else:
                is_exported = frame.index is not None and (frame.finalised or self.choose.empty_frames)
            chosen |= {frame.id} if is_exported else set()
        return chosen

    def _of_classes(self, boxes: Sequence[Box2D]) -> list[Box2D]:
        return [box for box in boxes if self.choose.classes is None or box.label in self.choose.classes]

    def _is_drawn(self, boxes: Sequence[Box2D]) -> bool:
        """True for an image with a box of the chosen classes, or one confirmed as empty."""
        return not boxes or self.choose.empty_frames or bool(self._of_classes(boxes))

    def _pictures(
        self, frames: Sequence[Chosen], loose: Sequence[ViewBoxes], parts: Sequence[str]
    ) -> Iterator[Picture]:
        for chosen in self._each(frames):
            frame = self._read(chosen) if chosen.image else None
            if frame is not None:
                yield self._image(chosen, frame, self._of_other_cameras(chosen))
            for view in chosen.views:
                yield self._view(view, chosen.split, (chosen.recording, chosen.stored.key))
        with_frame = {view.view_id for chosen in frames for view in chosen.views}
        for view in loose:
            if view.view_id in with_frame:
                # the same image must not be in training and validation
                self.losses.add(Lost.SAME)
                continue
            # views without a frame are for training only
            part = "train" if "train" in parts else next(iter(parts), None)
            yield self._view(view, part, None)

    def _of_other_cameras(self, chosen: Chosen) -> list[Label]:
        """Returns reviewed labels that were made in other cameras of the moment: objects on this image, too."""
        project, classes = self.project, self.choose.classes
        others = {each.label.uid for each in project.labels.of_moment(chosen.stored.id) if not each.is_own}
        seen = seen_labels(project, self.source, chosen.stored) if others else ()
        return [
            each
            for each in seen
            if each.uid in others and each.state in REVIEWED and (classes is None or each.label in classes)
        ]

    def _image(self, chosen: Chosen, frame: Frame, others: Sequence[Label]) -> Picture:
        losses, image_format = self.losses, self.options.image_format
        labels = [*(entry.label for entry in chosen.labels), *others]
        drawn = () if chosen.drawn is None else self._of_classes(chosen.drawn.boxes)
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
        of_frame = self._frame_values(chosen.stored.id)
        held = [*(each for _, each in kept), of_frame] if FORMATS[self.format].values is None else []
        losses.add_values((_names_of([*values.values(), of_frame]) - _names_of(held)).elements())
        kind = BoxKind.BOX if chosen.drawn is None else chosen.drawn.box_kind
        losses.add(Lost.KIND, 0 if kind is BoxKind.BOX else len(seen))
        stem = self._names.add(chosen.recording, chosen.stored.key)
        self._origins.append(FrameOrigin(stem, chosen.recording, chosen.stored.key, chosen.split))
        with writing(self.out):
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
        name = f"{self._names.add(*parts)}.png"
        self._places[part].append(
            ViewPlace(
                file_name=name, recording=recording, frame=key, step=view.step, geometry=view.geometry, labelled=True
            )
        )
        views = self.project.views
        content, (width_px, height_px) = views.content(view.view_id), views.size(view.view_id)
        boxes = [(box, NO_VALUES) for box in self._of_classes(view.boxes)]
        kept = tuple(box for box, _ in _fit(boxes, width_px, height_px, self.losses))
        return PictureLabels(name, kept, (width_px, height_px), box_kind=view.box_kind), content, part


def _names_of(values: Iterable[Values]) -> Counter[str]:
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


class BoxExport(ExportJob):
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
            labels = [replace(entry.label, said=tuple(each.said() for each in entry.said)) for entry in chosen.labels]
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
