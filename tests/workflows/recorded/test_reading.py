"""True boxes and masks: each format's labels contain their objects' points, and broken labels are errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rgbd_samples
from rgbd_samples import write_rgbd
from scipy.spatial.transform import RigidTransform

from annotator.geometry.oriented_box import contains
from annotator.recordings import open_recording
from annotator.recordings.kitti import KittiTracking
from annotator.types.errors import FormatError, RecordingError, UnitError
from annotator.workflows.recorded.reading import dont_care_rows, has_truth, load_mask, load_truth

WIDTH, HEIGHT = 8, 6
BOX = {"label": "wall", "center": [0, 0, 1], "size": [2, 2, 0.1], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    """An RGB-D folder of the frames a and b without labels: a wall at 1 m."""
    return write_rgbd(tmp_path, dict(zip("ab", rgbd_samples.wall(2).values(), strict=True)))


def put(path: Path, content: Any) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(content))


@pytest.mark.shared
@pytest.mark.parametrize("folder", ["kitti", "kitti_drive_0005", "human_turn", "hand_gesture"])
def test_true_boxes_contain_points(shared: Path, folder: str) -> None:
    """A wrong coordinate frame, size order or frame number would give boxes in empty space."""
    recording = open_recording(shared / "data" / folder)
    found = held = 0
    for index in range(0, len(recording), 5):
        frame = recording.frame(index)
        for truth in load_truth(recording, index, frame):
            found += 1
            held += int(contains(truth.box, frame.cloud.xyz_m).sum()) >= 5
    assert found >= 4
    assert held >= 0.8 * found


def test_missing_labels_are_an_error_but_a_frame_without_objects_is_not(wall: Path) -> None:
    recording = open_recording(wall)
    frame = recording.frame(0)
    assert not has_truth(recording)
    with pytest.raises(RecordingError, match=r"no true boxes; looked for truth/boxes\.json or boxes\.json"):
        load_truth(recording, 0, frame)
    put(wall / "boxes.json", {"a": [BOX, {**BOX, "label": "shelf"}]})
    assert has_truth(recording)
    assert [truth.label for truth in load_truth(recording, 0, frame)] == ["wall", "shelf"]
    assert load_truth(recording, 1, recording.frame(1)) == []
    # the folder `truth` has precedence, and a changed file is read again
    for boxes in (BOX, [BOX, BOX]):
        put(wall / "truth/boxes.json", {"a": boxes})
        assert [truth.label for truth in load_truth(recording, 0, frame)] == ["wall"] * (1 + (boxes is not BOX))


def test_tracking_labels_have_the_transform_of_each_frame(wall: Path) -> None:
    row = "{} {} Car 0 0 0 0 0 9 9 1.5 1.6 4.0 1.0 1.5 10.0 0.3\n"
    (wall / "label_02.txt").write_text("".join(row.format(n, n) for n in range(3)))
    frame = open_recording(wall).frame(0)
    drive = KittiTracking(wall, ("0", "1", "2", "3"), wall, "image_02", "velodyne")
    for index in range(3):
        T = RigidTransform.from_translation([index, 0.0, 0.0])
        (truth,) = load_truth(drive, index, replace(frame, T_camera_label=T))
        assert truth.track_id == index
        np.testing.assert_allclose(truth.box.center_m, [1 + index, 0.75, 10])
    assert load_truth(drive, 3, frame) == []
    far = RigidTransform.from_translation([1e9, 0.0, 0.0])
    with pytest.raises(FormatError, match=r"label_02\.txt: frame 1: a box must be within .*; correct its boxes or its"):
        load_truth(drive, 1, replace(frame, T_camera_label=far))
    (wall / "label_02.txt").write_text(row.format(0, 7) * 2)
    assert len(load_truth(drive, 0, frame)) == 2
    in_degrees = row.format(0, 7).replace("0.3", "170")
    (wall / "label_02.txt").write_text(in_degrees + "0 -1 DontCare -1 -1 -10 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10\n")
    with pytest.raises(UnitError, match="is no angle in radians"):
        load_truth(drive, 0, frame)
    assert [area.right for area in dont_care_rows(drive, "0")] == [9]


@pytest.mark.parametrize("folder", ["mask", "truth/mask"])
def test_masks_are_read_and_their_size_is_checked(wall: Path, folder: str) -> None:
    recording = open_recording(wall)
    frame = recording.frame(0)
    assert load_mask(recording, frame) is None
    (wall / folder).mkdir(parents=True)
    path = wall / folder / "a.png"
    with pytest.raises(FormatError, match="cannot be read"):
        load_mask(recording, frame)
    cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH + 1), np.uint8))
    with pytest.raises(FormatError, match=r"the mask is \(9, 6\) pixels, the image \(8, 6\)"):
        load_mask(recording, frame)
    numbers = np.arange(WIDTH * HEIGHT, dtype=np.uint8).reshape(HEIGHT, WIDTH) % 3
    cv2.imwrite(str(path), numbers)
    np.testing.assert_array_equal(load_mask(recording, frame), numbers)
