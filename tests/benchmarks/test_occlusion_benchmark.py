"""The benchmark of occlusion counts every labelled object once, by KITTI's level and ours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from annotator.types.errors import ConfigError
from benchmarks.occlusion import cross_table


@pytest.mark.shared
def test_the_objects_of_a_frame_and_of_a_drive(shared: Path, tmp_path: Path) -> None:
    frame, drive = tmp_path / "frame", tmp_path / "drive"
    for name in ("image_2/000008.png", "velodyne/000008.bin", "calib/000008.txt", "label_2/000008.txt"):
        (frame / name).parent.mkdir(parents=True)
        (frame / name).symlink_to(shared / "data" / "kitti" / "training" / name)
    for name in ("image_02/000000.png", "velodyne/000000.bin", "calib.txt", "label_02.txt"):
        (drive / name).parent.mkdir(parents=True, exist_ok=True)
        (drive / name).symlink_to(shared / "data" / "kitti_drive_0005" / name)
    rows = (frame / "label_2" / "000008.txt").read_text().splitlines()
    rows += [row[2:].split(" ", 1)[1] for row in (drive / "label_02.txt").read_text().splitlines() if row[:2] == "0 "]
    kitti_levels = [int(row.split()[2]) for row in rows if not row.startswith("DontCare")]
    counts = cross_table((frame, drive))
    assert counts.sum(axis=1).tolist() == np.bincount(kitti_levels, minlength=4).tolist()
    # all 30 frames agree on 118 of 130 (docs/formats.md)
    assert np.trace(counts[:3]) >= 5
    with pytest.raises(ConfigError, match="not a kitti_object or kitti_tracking recording with labels"):
        cross_table((shared / "data" / "hand_gesture",))
