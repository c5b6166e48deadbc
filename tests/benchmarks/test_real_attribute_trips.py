"""Real labels of KITTI, nuScenes and SUN RGB-D with attributes of each kind, through the formats that hold them.

`python -m benchmarks.trips` makes ten trips through each format; here are two each, and ten through some.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from nuscenes_samples import real

from annotator.recordings import Recording, open_recording
from annotator.recordings.recording import ReaderOptions
from annotator.workflows.exporting import ExportFormat
from annotator.workflows.recorded.reading import load_truth
from benchmarks.trips import FORMATS, LEVELS, NUSCENES, measure

# All boxes and values return but those of frames, or all but KITTI's two numbers.
HOLD_FRAMES = {ExportFormat.RCV, ExportFormat.OPENLABEL, ExportFormat.COCO}
KITTI = {ExportFormat.KITTI, ExportFormat.KITTI_TRACKING}


def recording_of(name: str, shared: Path, folder: Path) -> Recording:
    source = shared / "data" / name
    return nuscenes(source, folder) if name == "nuscenes_frame" else open_recording(source)


def nuscenes(source: Path, folder: Path) -> Recording:
    """The real frame with tables of attributes and levels of visibility, as nuScenes has them."""
    real(source, folder)
    tables = folder / "v1.0-mini"
    names = [f"vehicle.{name}" for name in NUSCENES]
    (tables / "attribute.json").write_text(json.dumps([{"token": name, "name": name} for name in names]))
    levels = [{"token": f"{number}", "level": level} for number, level in enumerate(LEVELS, 1)]
    (tables / "visibility.json").write_text(json.dumps(levels))
    rows = json.loads((tables / "sample_annotation.json").read_text())
    for number, row in enumerate(rows):
        row |= {"attribute_tokens": [names[number % 3]], "visibility_token": f"{number % 4 + 1}"}
    (tables / "sample_annotation.json").write_text(json.dumps(rows))
    recording = open_recording(folder, ReaderOptions(camera="CAM_FRONT"))
    read = load_truth(recording, 0, recording.frame(0))
    assert {(each.attributes["vehicle"], each.attributes["visibility"]) for each in read} >= {
        (NUSCENES[number % 3], LEVELS[number % 4]) for number in range(12)
    }
    return recording


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "format", "trips"),
    [
        *[("kitti", format, 2) for format in FORMATS if format is not ExportFormat.KITTI_TRACKING],
        ("kitti", ExportFormat.KITTI, 10),
        ("kitti_drive_0005", ExportFormat.KITTI_TRACKING, 2),
        ("kitti_drive_0005", ExportFormat.OPENLABEL, 10),
        ("nuscenes_frame", ExportFormat.NUSCENES, 2),
        ("nuscenes_frame", ExportFormat.COCO, 2),
        ("sunrgbd/sunrgbd_trainval", ExportFormat.SUSTECHPOINTS, 2),
        ("sunrgbd/sunrgbd_trainval", ExportFormat.COCO, 2),
    ],
)
def test_values_boxes_and_classes_are_equal_after_trips(
    shared: Path, tmp_path: Path, name: str, format: ExportFormat, trips: int
) -> None:
    done = measure(recording_of(name, shared, tmp_path / "set"), tmp_path / "trips", format, trips=trips)
    assert done.is_equal, done
    assert done.values >= 6 * done.boxes > 0
    assert (done.reported > 0) == (format not in HOLD_FRAMES)
    assert done.new == 0 or format in KITTI
    assert done.moved_m < (0.05 if format in KITTI else 1e-9)
    assert done.drifted_m < 1e-9
