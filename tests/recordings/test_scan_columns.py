"""`.bin` scans are read with the right number of values per point, or refused with what to do."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from cloud_samples import SCAN
from column_scans import OTHERS, make_set
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.scan_file import Scans, weigh_columns
from annotator.types.errors import FrameError, UnclearError

RANDOM = np.random.default_rng(3)
COUNT = len(SCAN)
# Like SCAN: x y z, then intensity, ring, time, and more.
WIDE = np.column_stack(
    [SCAN, RANDOM.integers(0, 64, COUNT), np.linspace(0, 0.1, COUNT), RANDOM.normal(0, 3, COUNT), np.ones(COUNT)]
).astype(np.float32)


def put(folder: Path, name: str, columns: int, count: int = COUNT) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(WIDE[:count, :columns].tobytes())
    return path


@given(st.integers(100_000, 200_000))
@settings(max_examples=20, deadline=None)
def test_made_up_scans_are_never_taken_for_others(seed: int):
    scans, columns = make_set(seed)
    for scan in scans:
        assert weigh_columns(scan) in (columns, None)


def test_most_made_up_scans_are_recognised():
    sets = [make_set(seed) for seed in range(300, 320)]
    assert {columns for _, columns in sets} == set(range(3, 9))
    assert sum(weigh_columns(scans[0]) == columns for scans, columns in sets) >= 18


@pytest.mark.parametrize("name", OTHERS)
def test_other_files_are_refused(tmp_path: Path, name: str):
    for seed in range(3):
        path = tmp_path / f"{seed}.bin"
        path.write_bytes(OTHERS[name](np.random.default_rng(seed)))
        with pytest.raises(FrameError):
            Scans().read(path)


@pytest.mark.parametrize("columns", [3, 4, 7])
def test_a_folder_of_scans_is_read_by_its_values(tmp_path: Path, columns: int):
    for number in range(3):
        put(tmp_path, f"{number}.bin", columns, COUNT - number)
    recording = open_recording(tmp_path)
    cloud = recording.frame(1).cloud
    assert f"have {columns} values each, which only their values say" in recording.notes[0]
    assert len(cloud) == COUNT - 1
    np.testing.assert_allclose(cloud.xyz_m[:, 2], SCAN[: COUNT - 1, 0], atol=1e-6)
    assert (cloud.reflectance is None) == (columns == 3)


def test_values_that_contradict_name_or_place_are_refused(tmp_path: Path):
    for columns, place in ((6, "velodyne/1.bin"), (8, "velodyne/2.bin"), (4, "points/1.pcd.bin")):
        with pytest.raises(UnclearError, match=f"its (place|name) .* but its values look like rows of {columns}; give"):
            Scans().read(put(tmp_path, place, columns))
        assert len(Scans(columns).read(tmp_path / place).xyz_m) == COUNT


@pytest.mark.parametrize(("columns", "reason"), [(3, ""), (8, ": rows of 8 fit")])
def test_in_doubt_the_option_is_asked_for(tmp_path: Path, columns: int, reason: str):
    """Values without a pattern; and rows that could be two points of half as many values."""
    rows = np.random.default_rng(0).uniform(-1, 1, (600, 3)).astype(np.float32) if columns == 3 else WIDE[:, :8]
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    with pytest.raises(UnclearError, match=f"is not certain{reason}; give --columns N"):
        open_recording(tmp_path).frame(0)
    frame = open_recording(tmp_path, ReaderOptions(columns=columns)).frame(0)
    np.testing.assert_allclose(frame.cloud.xyz_m[:, 2], rows[:, 0], atol=1e-6)


def test_only_reflectances_are_read_as_reflectance(tmp_path: Path):
    for name, fourth, expected in (
        ("a", SCAN[:, 3] * 255, SCAN[:, 3]),
        ("b", SCAN[:, 3] - 0.5, None),
        ("c", np.full(COUNT, 1.5e9), None),
    ):
        path = tmp_path / f"{name}.bin"
        path.write_bytes(np.column_stack([SCAN[:, :3], fourth]).astype(np.float32).tobytes())
        scan = Scans(4).read(path)
        assert len(scan.xyz_m) == COUNT
        assert (scan.reflectance is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(scan.reflectance, expected, atol=1e-6)


def test_a_dark_scan_has_the_reflectance_scale_of_the_first_ones(tmp_path: Path):
    """Alone, its values up to 1 would be read as fractions."""
    for number, most in enumerate((200, 1, 255, 1, 60_000)):
        points = np.column_stack([SCAN[:, :3], np.linspace(0, most, COUNT)]).astype(np.float32)
        (tmp_path / f"{number}.bin").write_bytes(points.tobytes())
    options = ReaderOptions(columns=4)
    for order in ((1, 3, 0, 4), (4, 3, 1, 0)):
        recording = open_recording(tmp_path, options)
        assert isinstance(recording, CloudFolder)
        for number in order:
            reflectance = recording.scan(number).raw.reflectance
            assert reflectance is not None
            # the last one is beyond the scale of the others
            expected = {0: 200 / 255, 1: 1 / 255, 3: 1 / 255, 4: 60_000 / 65_535}[number]
            assert reflectance.max() == pytest.approx(expected, rel=1e-5)


@pytest.mark.shared
def test_real_scans_are_read_by_name_and_by_their_values(shared: Path, tmp_path: Path):
    files = [*sorted((shared / "data").glob("kitti*/**/*.bin")), *(shared / "data").glob("nuscenes*/*.bin")]
    assert len(files) == 31
    for file in files[::3]:
        columns = 5 if "nuscenes" in str(file) else 4
        expected = np.fromfile(file, "<f4").reshape(-1, columns)[:, :3]
        np.testing.assert_array_equal(Scans().read(file).xyz_m, expected)
        alone = shutil.copy(file, tmp_path / "scan.bin")
        np.testing.assert_array_equal(Scans().read(alone).xyz_m, expected)
