"""What every writer of a format is given by the project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from annotator.formats.dataset import DatasetItem
from annotator.formats.losses import Losses
from annotator.project import Project
from annotator.workflows.exporting.choose import Chosen, ExportFilter
from annotator.workflows.exporting.report import ExportReport
from annotator.workflows.frames import FrameSource

ImageFormat = Literal["png", "jpg"]


@dataclass(frozen=True)
class ExportOptions:
    """How a dataset is written; a format that has no use for one of them passes it over.

    Attributes:
        image_format: of camera images; png is lossless.
        pictures: what formats of 2D boxes hold: camera images, pseudo-views, or both.
        vertices: labelCloud: boxes as 8 corners instead of centre, size and angles.
    """

    image_format: ImageFormat = "png"
    pictures: Literal["images", "views", "both"] = "images"
    vertices: bool = False


@dataclass(frozen=True, eq=False)
class ExportJob:
    """One export: what leaves, where to, and how.

    Attributes:
        chosen: the frames that leave with their labels, in order.
        overwrite: an older dataset of the same format at `out` may be replaced.
        progress: called with (frames written, frames to write).
        losses: counted by the writer.
        choose: what `chosen` was chosen by.
    """

    project: Project
    out: Path
    chosen: tuple[Chosen, ...]
    options: ExportOptions = field(default_factory=ExportOptions)
    overwrite: bool = False
    progress: Callable[[int, int], None] | None = None
    losses: Losses = field(default_factory=Losses)
    choose: ExportFilter = field(default_factory=ExportFilter)

    @property
    def classes(self) -> tuple[str, ...]:
        """All class names of the project, in its order: class numbers stay those of the project."""
        return self.project.config.classes

    def items(self) -> Iterator[DatasetItem]:
        """The frames, read one by one.

        Raises:
            RecordingError, FrameError: one that can no longer be read.
        """
        source = FrameSource(self.project)
        for number, chosen in enumerate(self.chosen, 1):
            labels = [entry.label for entry in chosen.labels]
            yield DatasetItem(chosen.recording, source.read(chosen.stored), labels, chosen.split)
            if self.progress is not None:
                self.progress(number, len(self.chosen))

    def report(self, format: str, objects_by_class: dict[str, int], frames: int | None = None) -> ExportReport:
        """The result, with the losses counted so far; `frames`: if it is not that of the chosen ones."""
        return ExportReport(
            format=format,
            out=self.out,
            frames=len(self.chosen) if frames is None else frames,
            objects=sum(objects_by_class.values()),
            objects_by_class={name: objects_by_class.get(name, 0) for name in self.classes},
            splits=dict(Counter(c.split for c in self.chosen if c.split is not None)),
            losses=self.losses.report(),
        )
