"""Attributes, boxes and classes of real labels after trips through every export format that holds attributes.

python -m benchmarks.trips RECORDING ... [--frames 1] [--trips 10] [--json]

The labels of a recording's first labelled frames get values of attributes of each kind: of boxes, tracks and frames;
those of its own files stay. A trip exports the project, removes what the format holds, and imports it again.
Of each format, the table says how many values there were, how many the export reported as lost, how many are equal
after the last trip, how many differ or were lost without a report, and how far corners moved on the first trip and
after it. KITTI's rows always have a truncation and an occlusion: boxes without a value get the measured one (`new`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tyro

from annotator.formats.dataset_writing import Lost
from annotator.geometry.oriented_box import box_corners
from annotator.project import NewLabel, Project, WriteContext, create_project
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.recordings import Recording, open_recording
from annotator.types import Label
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.exporting import ExportFilter, ExportFormat, ExportOptions, ExportReport, export_project
from annotator.workflows.importing import BoxFormat, Note, import_image_boxes, import_labels, read_labels
from annotator.workflows.recorded.reading import has_truth, is_labelled, load_truth
from benchmarks.report import Options, Table, guarded, program

LEVELS = ["v0-40", "v40-60", "v60-80", "v80-100"]
NUSCENES = ["moving", "stopped", "with_rider"]
SCHEMA: list[dict[str, Any]] = [
    {"name": "truncation", "kind": "number", "minimum": 0, "maximum": 1},
    {"name": "occlusion", "kind": "integer", "minimum": 0, "maximum": 3},
    {"name": "visibility", "kind": "choice", "choices": LEVELS},
    {"name": "vehicle", "kind": "choice", "choices": NUSCENES},
    {"name": "helmet", "kind": "boolean"},
    {"name": "mass", "kind": "number"},
    {"name": "remark", "kind": "text"},
    {"name": "colour", "kind": "text", "of": "track"},
    {"name": "night", "kind": "boolean", "of": "frame"},
    {"name": "weather", "kind": "text", "of": "frame"},
]
OF_FRAME: dict[str, Any] = {"night": True, "weather": "light rain, 3 °C"}
FORMATS = (
    ExportFormat.RCV,
    ExportFormat.OPENLABEL,
    ExportFormat.NUSCENES,
    ExportFormat.SUSTECHPOINTS,
    ExportFormat.COCO,
    ExportFormat.KITTI,
    ExportFormat.KITTI_TRACKING,
)


@dataclass
class Arguments(Options):
    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings with labels."""
    frames: int = 1
    """Labelled frames of each recording."""
    trips: int = 10
    """Exports and imports in each format."""


@dataclass(frozen=True)
class Outcome:
    """What trips through a format did to labels and values.

    `reported` values are those that the first export reported as lost, `silently_lost` those that differ or are missing
    and were not reported; `new` ones labels did not have before. A corner moved by at most `moved_m` on the first trip,
    and by `drifted_m` on all others together.
    """

    boxes: int
    classes_equal: bool
    values: int
    reported: int
    equal: int
    silently_lost: int
    new: int
    moved_m: float
    drifted_m: float

    @property
    def is_equal(self) -> bool:
        """Whether classes, and all values that were not reported as lost, are equal."""
        return self.classes_equal and self.silently_lost == 0 and self.equal == self.values - self.reported


def values_of_box(number: int) -> dict[str, Any]:
    """Values of the box `number` of a frame: each box lacks one or two of them."""
    every = {
        "truncation": number / 100,
        "occlusion": number % 4,
        "visibility": LEVELS[number % 4],
        "vehicle": NUSCENES[number % 3],
        "helmet": number % 2 == 0,
        "mass": number / 7,
        "remark": f'no. {number}: "a, b" 100 %\n',
        "colour": f"colour {number}",
    }
    return {name: value for place, (name, value) in enumerate(every.items()) if (number + place) % 5}


def fill(project: Project, recording: Recording, frames: int) -> None:
    """Gives the first labelled frames of a recording their labels, with values of all attributes."""
    stored = register_recording(project, recording)
    ids = {frame.key: frame.id for frame in project.frames.of([stored.id])}
    for fields in SCHEMA:
        project.change_classes(edit.PutAttribute(attribute=Attribute.model_validate(fields)), "ann")
    for index in islice(_labelled(recording), frames):
        truths = load_truth(recording, index, recording.frame(index))
        if classes := {each.label for each in truths} - set(project.config.classes):
            project.configure(classes=[*project.config.classes, *sorted(classes)])
        new = [
            NewLabel(
                each.label,
                each.box,
                track_id=number if each.track_id is None else each.track_id,
                attributes=values_of_box(number) | dict(each.attributes),
            )
            for number, each in enumerate(truths)
        ]
        frame = ids[recording.keys[index]]
        receipt = project.labels.create(frame, new, WriteContext(0, "ann")).receipt
        project.frames.set_attributes(frame, OF_FRAME, WriteContext(receipt.revision, "ann"))


def _labelled(recording: Recording) -> Iterator[int]:
    if not has_truth(recording):
        raise ConfigError(f"{recording.path}: has no labels; give a recording with 3D boxes")
    for index, key in enumerate(recording.keys):
        if is_labelled(recording, key) and load_truth(recording, index, recording.frame(index)):
            yield index


def trip(project: Project, out: Path, format: ExportFormat) -> ExportReport:
    """Exports the project, removes what the format holds, and imports it.

    COCO holds the values of 2D boxes, which go to the 3D labels that they show: only the values are removed.
    """
    report = export_project(project, out, format, choose=ExportFilter(), options=ExportOptions(image_format="jpg"))
    is_flat = format is ExportFormat.COCO
    with project.store.write() as connection:
        connection.exec_driver_sql("UPDATE labels SET attributes = '{}'" if is_flat else "DELETE FROM labels")
        connection.exec_driver_sql("UPDATE frames SET attributes = NULL")
    if is_flat:
        left_out = import_image_boxes(project, out, None).of(Note.VALUE)
    else:
        left_out = import_labels(project, read_labels(BoxFormat(format), out)).of(Note.VALUE)
    assert not left_out, left_out
    return report


def measure(recording: Recording, folder: Path, format: ExportFormat, *, frames: int = 1, trips: int = 10) -> Outcome:
    """Makes trips with a new project in `folder`."""
    with create_project(folder, "project", ["object"]) as project:
        fill(project, recording, frames)
        before, of_frames = _labels(project), list(project.frames.attributes().values())
        report = trip(project, folder / "0", format)
        first = _labels(project)
        for number in range(1, trips):
            trip(project, folder / f"{number}", format)
        now, of_frames_now = _labels(project), list(project.frames.attributes().values())
    reported = sum(loss.count for loss in report.losses if loss.kind is Lost.ATTRIBUTE)
    had = [dict(label.attributes) for label in before] + of_frames
    have = [dict(label.attributes) for label in now] + (of_frames_now or [{} for _ in of_frames])
    number = sum(map(len, had))
    pairs = list(zip(had, have, strict=False))
    equal = sum(name in b and b[name] == value for a, b in pairs for name, value in a.items())
    return Outcome(
        boxes=len(before),
        classes_equal=[label.label for label in before] == [label.label for label in now],
        values=number,
        reported=reported,
        equal=equal,
        silently_lost=max(0, number - reported - equal),
        new=sum(len(b.keys() - a.keys()) for a, b in pairs),
        moved_m=_moved_m(before, first),
        drifted_m=_moved_m(first, now),
    )


def _labels(project: Project) -> list[Label]:
    return [entry.label for entry in project.labels.select()]


def _moved_m(before: Collection[Label], after: Collection[Label]) -> float:
    moves = [
        float(np.linalg.norm(box_corners(a.box) - box_corners(b.box), axis=1).max())
        for a, b in zip(before, after, strict=False)
    ]
    return max(moves, default=0.0)


def run(args: Arguments) -> dict[str, dict[str, Any]]:
    """The outcomes by recording and format."""
    result: dict[str, dict[str, Any]] = {}
    for path in args.recordings:
        recording = open_recording(path)
        for format in FORMATS:
            if format is ExportFormat.KITTI_TRACKING and not recording.is_sequence:
                continue
            with TemporaryDirectory() as folder:
                done = measure(recording, Path(folder), format, frames=args.frames, trips=args.trips)
            result.setdefault(recording.name, {})[format.value] = asdict(done) | {"is_equal": done.is_equal}
    return result


def tables(_: Arguments, result: dict[str, dict[str, Any]]) -> list[Table]:
    names = ("boxes", "values", "reported", "equal", "silently_lost", "new")
    table = Table("recording", "format", *(name.replace("_", " ") for name in names), "mm", "drift mm")
    for recording, outcomes in result.items():
        for format, done in outcomes.items():
            moved = (done["moved_m"] * 1000, done["drifted_m"] * 1000)
            table.add(recording, format, *(done[name] for name in names), *moved)
    return [table]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
