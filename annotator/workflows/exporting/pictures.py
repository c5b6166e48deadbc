"""Writes a dataset of 2D boxes: camera images, pseudo-views, or both, one picture in memory at a time.

Beside what the format asks for there are `frames.csv` (which frame each camera image is) and, in each folder of
pictures that has pseudo-views, `views.json` (where they lie in space), so that an import knows both again.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from annotator.files import new_folder
from annotator.formats.dataset import DatasetItem, FileNames
from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, dump_frames
from annotator.formats.labelled_picture import LabelledPicture, PictureWriter
from annotator.formats.losses import Losses, Lost, count_lost
from annotator.formats.writing import encoded_image, writing
from annotator.geometry.image_shares import cut_to_picture
from annotator.project import ViewBoxes
from annotator.types import Box2D, BoxKind, Frame
from annotator.workflows.exporting.choose_pictures import ChosenPictures, loose_views, wanted
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport
from annotator.workflows.frames import FrameSource
from annotator.workflows.outlines import undrawn
from annotator.workflows.views_out import ViewPlace, write_places

# What is thinner is no box to learn from, pixels.
MIN_SIDE_PX = 1.0
# Two boxes of a class that differ by less are the same to a file, pixels.
SAME_PX = 0.01

Make = Callable[[Path, Sequence[str], Sequence[str]], PictureWriter]


def write_pictures(job: ExportJob, format: str, make: Make, is_dataset: Callable[[Path], bool]) -> ExportReport:
    """Writes the dataset; complete, or not at all.

    Args:
        make: makes the format's writer of a folder, the classes and the names of the parts.
        is_dataset: whether a folder is a dataset of this format, which may be replaced.

    Raises:
        FormatError: `job.out` is taken, or the disk refuses.
        ConfigError: parts that the format does not have.
        RecordingError: a frame that can no longer be read.
        ProjectError: a picture of a pseudo-view is damaged.
    """
    parts = tuple(dict.fromkeys(c.split for c in job.chosen if c.split is not None))
    with new_folder(job.out, lambda old: job.overwrite and is_dataset(old) and (old / FRAMES_CSV).is_file()) as folder:
        with writing(job.out):
            writer = make(folder, job.classes, parts)
        tally = _Tally(job, parts)
        for picture in tally.pictures():
            with writing(job.out):
                writer.add(picture)
            tally.add(picture)
        with writing(job.out):
            folders = writer.finish()
            (folder / FRAMES_CSV).write_text(dump_frames(tally.origins), encoding="utf-8", newline="")
            tally.write_places(folders)
    report = job.report(format, dict(tally.by_class), tally.written)
    return report.model_copy(update={"splits": {part: tally.by_part[part] for part in parts}})


@dataclass
class _Tally:
    """Gives the pictures one by one and keeps what is written beside them."""

    job: ExportJob
    parts: tuple[str, ...]
    names: FileNames = field(default_factory=FileNames)
    origins: list[FrameOrigin] = field(default_factory=list)
    places: dict[str | None, list[ViewPlace]] = field(default_factory=lambda: defaultdict(list))
    by_class: Counter[str] = field(default_factory=Counter)
    by_part: Counter[str | None] = field(default_factory=Counter)
    written: int = 0

    def add(self, picture: LabelledPicture) -> None:
        self.by_class.update(box.label for box in picture.boxes)
        self.by_part[picture.part] += 1
        self.written += 1

    def pictures(self) -> Iterator[LabelledPicture]:
        job, source = self.job, FrameSource(self.job.project)
        for number, chosen in enumerate(job.chosen, 1):
            assert isinstance(chosen, ChosenPictures)  # the table says that these formats are chosen so
            if chosen.image:
                yield self._image(chosen, source.read(chosen.stored))
            for view in chosen.views:
                yield self._view(view, chosen.split, (chosen.recording, chosen.stored.key))
            if job.progress is not None:
                job.progress(number, len(job.chosen))
        with_frame = {v.view_id for c in job.chosen if isinstance(c, ChosenPictures) for v in c.views}
        for view in loose_views(job.project, job.choose, job.options.pictures):
            if view.view_id in with_frame:
                # one picture in two parts: what is measured would have been learned
                job.losses.add(Lost.SAME)
                continue
            # a view of no frame is there to learn from, nothing is measured on it
            part = "train" if "train" in self.parts else next(iter(self.parts), None)
            yield self._view(view, part, None)

    def _image(self, chosen: ChosenPictures, frame: Frame) -> LabelledPicture:
        losses, image_format = self.job.losses, self.job.options.image_format
        labels = [entry.label for entry in chosen.labels]
        drawn = () if chosen.drawn is None else chosen.drawn.boxes
        seen = undrawn(frame.camera, labels, drawn, MIN_SIDE_PX)
        # what is drawn stands for its label; the others leave as their outlines
        outlined = [label for label in labels if not drawn or label.uid in seen]
        count_lost(
            losses, DatasetItem(chosen.recording, frame, outlined), (Lost.SCORE, Lost.TRACK, Lost.STATE, Lost.TIME)
        )
        losses.add(Lost.SOLID, len(outlined))
        losses.add(Lost.OUTSIDE, len(outlined) - len(seen))
        boxes = [*wanted(drawn, self.job.choose.classes), *seen.values()]
        kind = BoxKind.BOX if chosen.drawn is None else chosen.drawn.box_kind
        stem = self.names.add(chosen.recording, chosen.stored.key)
        self.origins.append(FrameOrigin(stem, chosen.recording, chosen.stored.key, chosen.split))
        height_px, width_px = frame.rgb.shape[:2]
        kept = _fit(boxes, width_px, height_px, kind, losses)
        with writing(self.job.out):
            content = encoded_image(frame.rgb, image_format)
        return LabelledPicture(f"{stem}.{image_format}", content, width_px, height_px, kept, chosen.split)

    def _view(self, view: ViewBoxes, part: str | None, origin: tuple[str, str] | None) -> LabelledPicture:
        """As PNG, whatever images are: the picture is known by its bytes."""
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
        boxes = wanted(view.boxes, self.job.choose.classes)
        kept = _fit(boxes, width_px, height_px, view.box_kind, self.job.losses)
        return LabelledPicture(name, content, width_px, height_px, kept, part)

    def write_places(self, folders: Mapping[str, Path]) -> None:
        whole = next(iter(folders))
        for part, places in self.places.items():
            write_places(folders[part or whole], places)


def _fit(boxes: Sequence[Box2D], width_px: int, height_px: int, kind: BoxKind, losses: Losses) -> tuple[Box2D, ...]:
    """The boxes cut to their picture; counts those of which nothing is left, and those that are there already."""
    kept: list[Box2D] = []
    for box in boxes:
        cut = cut_to_picture(box, width_px, height_px, MIN_SIDE_PX)
        if cut is None:
            losses.add(Lost.OUTSIDE)
        elif any(_is_same(cut, other) for other in kept):
            losses.add(Lost.SAME)
        else:
            kept.append(cut)
    if kind is BoxKind.BOX:
        losses.add(Lost.KIND, len(kept))
    return tuple(kept)


def _is_same(box: Box2D, other: Box2D) -> bool:
    return box.label == other.label and bool(np.allclose(box.xyxy, other.xyxy, rtol=0, atol=SAME_PX))
