"""Writes a dataset of 2D boxes: camera images, pseudo-views, or both, one image in memory at a time.

In addition to the format's files it writes `frames.csv` (the frame of each camera image) and, in each image folder with
pseudo-views, `views.json` (their geometry), so that an import can match both.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from annotator.files import new_folder
from annotator.formats.attributes import NO_VALUES, Values
from annotator.formats.dataset_writing import DatasetItem, FileNames, count_lost, write_frames, writing
from annotator.formats.frame_names import FrameOrigin, PictureLabels
from annotator.formats.losses import Losses, Lost
from annotator.formats.table import FORMATS, ExportFormat
from annotator.geometry.outline import clip_to_image
from annotator.image_bytes import encoded_image
from annotator.project import REVIEWED, ViewBoxes
from annotator.types import Box2D, BoxKind, Frame, Label
from annotator.workflows.exporting.choose import ChosenPictures, choose_pictures, loose_views, of_classes
from annotator.workflows.exporting.job import ExportJob, ExportReport
from annotator.workflows.frame_source import seen_labels
from annotator.workflows.views import ViewPlace, drawn_of, outlines, write_places

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
