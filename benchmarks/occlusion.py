"""Agreement of measured occlusion with the levels that KITTI's annotators assigned.

python -m benchmarks.occlusion RECORDING ... [--json]

For each labelled object of KITTI recordings (object or tracking), the level is measured as in our exports and
evaluations. Objects that KITTI labels as "unknown" are in the table, but not in the agreement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from annotator.formats.kitti_objects import read_kitti_file
from annotator.formats.kitti_rows import (
    DONT_CARE,
    UNKNOWN,
    KittiLabel,
    label_box,
    label_frame,
    occlusion,
    parse_tracking_fields,
)
from annotator.formats.reading import text_rows
from annotator.geometry.occlusion import Sight
from annotator.recordings import Recording, open_recording
from annotator.types import Frame
from annotator.types.errors import ConfigError
from annotator.workflows.recorded.reading import label_file
from benchmarks.report import Table, finish, guarded

LEVELS = ("0 visible", "1 partly hidden", "2 largely hidden", "3 unknown")
FORMATS = ("kitti_object", "kitti_tracking")


@dataclass
class Arguments:
    """Compare measured occlusion with KITTI's labels."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """KITTI object or tracking folders with labels."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def labelled_frames(recording: Recording) -> Iterator[tuple[Frame, list[KittiLabel]]]:
    """The frames with their label rows, without DontCare.

    Raises:
        ConfigError: not a KITTI recording, or one without labels.
    """
    file = label_file(recording, recording.keys[0])
    if recording.format not in FORMATS or file is None:
        raise ConfigError(f"{recording.path}: not a {' or '.join(FORMATS)} recording with labels")
    tracked: dict[int, list[KittiLabel]] = {}
    if recording.format == "kitti_tracking":
        for line, fields in text_rows(file):
            number, _, row = parse_tracking_fields(fields, file, line)
            tracked.setdefault(number, []).append(row)
    for index, key in enumerate(recording.keys):
        frame_file = label_file(recording, key)
        is_tracked = frame_file is None or recording.format == "kitti_tracking"
        rows = tracked.get(int(key), []) if is_tracked else list(read_kitti_file(frame_file or file, scored=False))
        yield recording.frame(index), [row for row in rows if row.label != DONT_CARE]


def cross_table(paths: tuple[Path, ...]) -> np.ndarray:
    """(4, 4) counts of objects: row = KITTI's level, column = ours."""
    counts = np.zeros((4, 4), np.int64)
    for path in paths:
        for frame, rows in labelled_frames(open_recording(path)):
            sight, T = Sight(frame.cloud.xyz_m), label_frame(frame)
            for row in rows:
                box = label_box(row)
                counts[row.occluded, occlusion(box if T is None else box.transformed(T), sight)] += 1
    return counts


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    counts = cross_table(arguments.recordings)
    table = Table("KITTI", *(f"ours: {level}" for level in LEVELS))
    for level, row in zip(LEVELS, counts.tolist(), strict=True):
        table.add(level, *row)
    known = counts[:UNKNOWN]
    result = {"objects": int(known.sum()), "agree": int(np.trace(known)), "table": counts.tolist()}
    finish(result, arguments.json, table)


if __name__ == "__main__":
    guarded(main)
