"""Exports datasets of 2D boxes: camera images, pseudo-views, or both, written one image in memory at a time.

Beside the format's files, such a dataset has `frames.csv` (the frame of each camera image) and, in each image folder
with pseudo-views, `views.json` (their geometry), so that an import can match both.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from annotator.files import new_folder
from annotator.formats.dataset_writing import (
    DatasetItem,
    FileNames,
    Losses,
    Lost,
    count_lost,
    write_frames,
    writing,
)
from annotator.formats.frame_names import NO_VALUES, FrameOrigin, PictureLabels, Values
from annotator.formats.table import FORMATS, ExportFormat
from annotator.geometry.outline import clip_to_image
from annotator.image_bytes import encoded_image
from annotator.project import REVIEWED, ImageBoxes, ViewBoxes
from annotator.types import Box2D, BoxKind, Frame, Label, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.exporting.job import NOT_REJECTED, Chosen, ExportJob, ExportReport
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
