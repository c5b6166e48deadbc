"""Frames that would fill the memory are refused before they are decoded, with the setting that allows them."""

from __future__ import annotations

import json
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from cloud_samples import camera_file
from scipy.io import savemat

from annotator.frame_limits import VARIABLE, frame_memory, memory_problem, require_pixels
from annotator.recordings import open_recording
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.sunrgbd import _read_mat
from annotator.types.errors import ConfigError, FrameError

TOO_LARGE = rf"too large: .* MiB of memory; the limit is 2048 MiB \(.*{VARIABLE}"
MANY = 18_000_000


def grown_mib(read: Callable[[], object]) -> float:
    """How far a read, which must fail, raises the peak of this process."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises((FrameError, ValueError), match=TOO_LARGE):
        read()
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024


def npz(path: Path) -> Path:
    """Points that compress a thousandfold: written in parts, since the array itself would take a gigabyte."""
    header = {"descr": "|u1", "fortran_order": False, "shape": (MANY, 3)}
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("points.npy", "w") as member,
    ):
        np.lib.format.write_array_header_1_0(member, header)
        for _ in range(MANY * 3 // 3_000_000):
            member.write(bytes(3_000_000))
    return path


def test_an_archive_of_zeros_is_refused_before_it_is_unpacked(tmp_path: Path):
    path = npz(tmp_path / "0.npz")
    assert path.stat().st_size < 1_000_000
    assert grown_mib(lambda: open_recording(tmp_path).frame(0)) < 50


def test_a_depth_image_counts_as_points(tmp_path: Path):
    """Each pixel gives a point; as an image, it would be small enough."""
    side = 5000
    require_pixels(side, side)
    (tmp_path / "color").mkdir()
    (tmp_path / "depth").mkdir()
    cv2.imwrite(str(tmp_path / "color/0.png"), np.zeros((20, 20, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "depth/0.png"), np.ones((side, side), np.uint16))
    camera = json.loads(camera_file()) | {"width": 20, "height": 20}
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps(camera))
    assert grown_mib(lambda: open_recording(tmp_path).frame(0)) < 50


def test_the_setting_raises_and_lowers_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    np.save(tmp_path / "a.npy", np.ones((100_000, 3), np.float32))
    savemat(tmp_path / "a.mat", {"instance": np.ones((100_000, 6))})
    assert len(read_cloud(tmp_path / "a.npy").xyz_m) == 100_000
    monkeypatch.setenv(VARIABLE, "1")
    with pytest.raises(FrameError, match=rf"limit is 1 MiB \(.*{VARIABLE} sets another, such as 2\)"):
        read_cloud(tmp_path / "a.npy")
    with pytest.raises(FrameError, match=f"is larger than 0 MiB; raise {VARIABLE}"):
        _read_mat(tmp_path / "a.mat")
    monkeypatch.setenv(VARIABLE, "16")
    assert len(read_cloud(tmp_path / "a.npy").xyz_m) == 100_000
    monkeypatch.setenv(VARIABLE, "8 GB")
    with pytest.raises(ConfigError, match=f"{VARIABLE}='8 GB': must be a number of MiB"):
        frame_memory()


def test_real_frames_are_within_the_default():
    assert memory_problem(points=10_000_000, pixels=12_000_000) == ""
    require_pixels(4032, 3024, give_points=True)
