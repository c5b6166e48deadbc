"""The options, the input and the report of an export."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from pydantic import Field

from annotator.formats.attributes import Values
from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.losses import Loss, Losses, Lost
from annotator.formats.table import FORMATS, ExportFormat
from annotator.project import Project
from annotator.project.classes.attributes import AttributeOf
from annotator.recordings import Recording
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.look_around import LookAround, Scanned
from annotator.types import Frame
from annotator.types.bases import Strict
from annotator.types.errors import FrameError
from annotator.types.label import AttributeValue
from annotator.workflows.exporting.choose import Chosen, ExportFilter
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.reading import dont_care_rows

ImageFormat = Literal["png", "jpg"]


@dataclass(frozen=True)
class ExportOptions:
    """How a dataset is written; formats ignore options that do not apply.

    Attributes:
        image_format: format of camera images; png is lossless.
        pictures: for formats of 2D boxes: export camera images, pseudo-views, or both.
        vertices: labelCloud: boxes as 8 corners instead of centre, size and angles.
    """

    image_format: ImageFormat = "png"
    pictures: Literal["images", "views", "both"] = "images"
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
        chosen: the frames to export with their labels, in order.
        overwrite: replace an older export of the same format at `out`.
        progress: called with (frames written, frames to write).
        losses: counted by the writer.
        unreadable: `RECORDING/KEY: reason` of the frames that were left out so far.
        fault: the error of the first of these.
        choose: the filter that selected `chosen`.
    """

    project: Project
    format: ExportFormat
    out: Path
    chosen: tuple[Chosen, ...]
    options: ExportOptions = field(default_factory=ExportOptions)
    overwrite: bool = False
    progress: Callable[[int, int], None] | None = None
    losses: Losses = field(default_factory=Losses)
    choose: ExportFilter = field(default_factory=ExportFilter)
    unreadable: list[str] = field(default_factory=list)
    fault: FrameError | None = None

    @cached_property
    def source(self) -> FrameSource:
        return FrameSource(self.project)

    def read(self, chosen: Chosen) -> Frame | None:
        """Reads a frame; None if it cannot be read and such frames are left out."""
        try:
            return self.source.read(chosen.stored)
        except FrameError as error:
            if not self.choose.skip_unreadable:
                raise
            self.fault = self.fault or error
            self.unreadable.append(f"{chosen.recording}/{chosen.stored.key}: {error}")
            self.losses.add(Lost.UNREADABLE)
            return None

    def require_some(self, written: int) -> None:
        """Raises the error of the first frame that cannot be read if nothing was written without these frames."""
        if self.fault is not None and not written:
            raise self.fault

    @property
    def classes(self) -> tuple[str, ...]:
        """All class names of the project, in its order, so that class numbers are those of the project."""
        return self.project.config.classes

    def items(self) -> Iterator[DatasetItem]:
        """Reads the frames one by one."""
        for number, chosen in enumerate(self.chosen, 1):
            frame = self.read(chosen)
            if frame is not None:
                yield self._item(chosen, frame)
            if self.progress is not None:
                self.progress(number, len(self.chosen))
        self.require_some(len(self.chosen) - len(self.unreadable))

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
        given, defaults = self._frame_values
        return defaults | given.get(frame_id, {})

    @cached_property
    def _frame_values(self) -> tuple[dict[int, dict[str, AttributeValue]], dict[str, AttributeValue]]:
        of_frames = [each for each in self.project.config.attributes if each.of is AttributeOf.FRAME]
        defaults = {each.name: each.default for each in of_frames if each.default is not None}
        return self.project.frames.attributes(), defaults

    def report(
        self, objects_by_class: dict[str, int], parts: Sequence[str | None], notes: tuple[str, ...] = ()
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
            objects_by_class={name: objects_by_class.get(name, 0) for name in self.classes},
            splits=dict(Counter(part for part in parts if part is not None)),
            losses=self.losses.report(),
            unreadable=tuple(self.unreadable),
            notes=notes,
        )


def _is_cut(recording: Recording) -> bool:
    """True if the frames' clouds are the part of a scan that the camera sees."""
    whole = isinstance(recording, CloudFolder) and recording.images is None
    return isinstance(recording, LookAround) or (isinstance(recording, Scanned) and not whole)
