"""What all exports share: the choice of labels and frames, frames that cannot be read, and the report."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import Field

from annotator.formats.dataset_writing import (
    Loss,
    Losses,
    Lost,
)
from annotator.formats.frame_names import Values
from annotator.formats.table import FORMATS, ExportFormat
from annotator.project import REVIEWED, ImageBoxes, Project, StoredFrame, StoredLabel, ViewBoxes
from annotator.project.classes.attributes import AttributeOf
from annotator.types import Frame, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, FrameError
from annotator.types.messages import alternatives
from annotator.workflows.exporting.choose import ExportFilter, Pictures, Split, assign
from annotator.workflows.frame_source import FrameSource


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
