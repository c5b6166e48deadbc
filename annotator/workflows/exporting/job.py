"""The options, the input and the report of an export."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

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
from annotator.workflows.exporting.choose import Chosen, ExportFilter, Pictures, Split
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.reading import dont_care_rows

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
