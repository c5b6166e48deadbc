"""The conversions in docs/recordings.md run, and what they write opens as a recording."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from annotator.recordings import open_recording

PAGE = Path(__file__).resolve().parents[2] / "docs" / "recordings.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
WIDTH, HEIGHT = 40, 30
K = np.array([[50.0, 0, 19.5], [0, 52.0, 14.5], [0, 0, 1]])
RANDOM = np.random.default_rng(0)
RGB = RANDOM.integers(0, 255, (2, HEIGHT, WIDTH, 3)).astype(np.uint8)


@pytest.fixture
def my_loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module that the examples import."""
    module = ModuleType("my_loader")
    monkeypatch.setitem(sys.modules, "my_loader", module)
    monkeypatch.chdir(tmp_path)
    yield module


def run(number: int) -> None:
    assert len([line for line in BLOCKS[number].splitlines() if line and "import" not in line]) <= 12
    exec(compile(BLOCKS[number], f"docs/recordings.md, block {number}", "exec"), {})


def test_images_and_depth_become_an_rgbd_folder(my_loader: ModuleType, tmp_path: Path):
    depth_m = RANDOM.uniform(0.5, 4, (2, HEIGHT, WIDTH))
    my_loader.__dict__.update(K=K, frames=list(zip(RGB, depth_m, (10.0, 10.1), strict=True)))
    run(0)
    recording = open_recording(tmp_path / "recordings/converted")
    frame = recording.frame(1)
    assert (recording.format, len(recording), frame.timestamp_ns) == ("rgbd_folder", 2, 10_100_000_000)
    np.testing.assert_array_equal(frame.rgb, RGB[1])
    np.testing.assert_allclose(frame.depth_m, depth_m[1], atol=6e-4)
    np.testing.assert_array_equal(frame.camera.matrix, K)


def test_scans_with_a_camera_become_a_folder_of_clouds(my_loader: ModuleType, tmp_path: Path):
    xyz, reflectance = RANDOM.uniform((2, -1, -1), (9, 1, 1), (500, 3)), RANDOM.random(500)
    T = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    my_loader.__dict__.update(K=K, T=T, scans=[(rgb, xyz, reflectance) for rgb in RGB])
    run(1)
    recording = open_recording(tmp_path / "recordings/scans")
    cloud = recording.frame(0).cloud
    in_camera = np.c_[xyz, np.ones(500)] @ T[:3].T
    px = in_camera @ K.T
    px = px[:, :2] / px[:, 2:]
    seen = (px >= -0.5).all(axis=1) & (px < [WIDTH - 0.5, HEIGHT - 0.5]).all(axis=1)
    assert (recording.format, len(cloud)) == ("cloud_folder", seen.sum())
    np.testing.assert_allclose(cloud.xyz_m, in_camera[seen], atol=1e-5)
    np.testing.assert_allclose(cloud.reflectance, reflectance[seen], atol=1e-6)
