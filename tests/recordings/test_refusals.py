"""Paths that are no recordings: the error names the nearest format, what is missing, and recordings near by."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator.recordings import detect_format, open, open_recording
from annotator.recordings.open import PARTS, nearest_formats, recordings_below
from annotator.types.errors import RecordingError, UnknownFormatError

CASES = [
    (("color/",), "it looks like an RGB-D folder: depth/ and camera_*.json are missing"),
    (("rgb/", "camera_x.json"), "it looks like an RGB-D folder: depth/ is missing"),
    (("image_2/", "calib/"), "it looks like a KITTI object folder: velodyne/ is missing"),
    (("training/image_2/", "training/calib/"), "training/ looks like a KITTI object folder: velodyne/ is missing"),
    (("image_02/", "calib.txt"), "it looks like a KITTI tracking folder of one sequence: velodyne/ is missing"),
    (("image_02/data/",), "it looks like a KITTI raw drive: velodyne_points/data/ is missing"),
    (("image/", "calib/"), "VoteNet extracts it: depth/*.mat or points/*.npz is missing"),
    (("image/", "depth/", "extrinsics/"), "it looks like a scene of SUN RGB-D: intrinsics.txt is missing"),
    (("images/", "clouds/", "labels/"), "it looks like an export in the format rcv: dataset.json is missing"),
]


def make(folder: Path, *names: str) -> None:
    for name in names:
        place = folder / name
        if name.endswith("/"):
            place.mkdir(parents=True, exist_ok=True)
        else:
            place.parent.mkdir(parents=True, exist_ok=True)
            place.touch()


def refusal(path: Path) -> str:
    with pytest.raises(UnknownFormatError) as caught:
        open_recording(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("names", "said"), CASES)
def test_the_nearest_format_is_named_with_what_is_missing(tmp_path: Path, names: tuple[str, ...], said: str):
    make(tmp_path, *names)
    message = refusal(tmp_path)
    assert message.startswith(f"{tmp_path}: no known recording format in this folder; ")
    assert said in message


def test_every_format_of_the_table_looks_like_itself(tmp_path: Path):
    for number, (name, parts) in enumerate(PARTS.items()):
        folder = tmp_path / str(number)
        make(folder, *(part.split("|")[0].replace("*", "x") for part in parts[:-1]))
        assert any(f"looks like {name}: " in text for text in nearest_formats(folder)), name


def test_a_frames_csv_alone_looks_like_no_format(tmp_path: Path):
    """An export in the format sustechpoints, for one, has such a file beside its scenes."""
    make(tmp_path, "frames.csv", "scene/label/000000.json", "scene/calib/camera/front.json")
    assert nearest_formats(tmp_path) == []


def test_a_folder_that_lacks_nothing_has_other_files(tmp_path: Path):
    make(tmp_path, "color/", "depth/", "camera_x.json")
    assert "it looks like an RGB-D folder, but its files are not as in that format" in nearest_formats(tmp_path)


def test_a_kitti_folder_without_calibration_says_so(tmp_path: Path):
    make(tmp_path, "image_2/1.png", "velodyne/1.bin")
    with pytest.raises(RecordingError, match="looks like a KITTI object folder: calib/ is missing; copy it"):
        open_recording(tmp_path)


def test_recordings_are_searched_three_levels_down(tmp_path: Path):
    make(tmp_path, "b/c/take/color/1.png", "b/c/take/depth/1.png", "a/color/1.png", "a/depth/1.png")
    make(tmp_path, "d/e/f/deep/color/1.png", "d/e/f/deep/depth/1.png", ".hidden/color/1.png", ".hidden/depth/1.png")
    assert refusal(tmp_path).endswith("; it contains recordings; give the path of one of them: a, b/c/take")


def test_recordings_below_that_cannot_be_opened_are_shown_with_their_problem(tmp_path: Path):
    make(tmp_path, "drive/image_2/1.png", "drive/velodyne/1.bin")
    assert "it contains recordings that cannot be opened: " in refusal(tmp_path)
    assert f"{tmp_path}/drive: looks like a KITTI object folder: calib/ is missing" in refusal(tmp_path)


def test_the_search_is_bounded_in_number_and_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make(tmp_path, *(f"{number:03d}/" for number in range(60)), "999/color/1.png", "999/depth/1.png")
    assert recordings_below(tmp_path, detect_format, ()).recordings == ["999"]
    monkeypatch.setattr(open, "MOST_FOLDERS", 50)
    below = recordings_below(tmp_path, detect_format, ())
    assert (below.recordings, below.is_partial) == ([], True)
    assert "not all were searched" in refusal(tmp_path)
    monkeypatch.setattr(open, "MOST_FOLDERS", 500)
    monkeypatch.setattr(open, "MOST_SECONDS", 0.0)
    assert recordings_below(tmp_path, detect_format, ()).is_partial


def test_a_part_of_a_recording_names_the_recording(tmp_path: Path):
    make(tmp_path, "kitti/image_2/1.png", "kitti/velodyne/1.bin", "kitti/calib/1.txt", "clouds/1.bin", "clouds/other/x")
    for part in ("kitti/velodyne/1.bin", "kitti/image_2", "kitti/calib/1.txt"):
        assert refusal(tmp_path / part).endswith(f"it is a part of the recording {tmp_path / 'kitti'}; give that path")
    assert refusal(tmp_path / "clouds" / "1.bin").endswith(f"recording {tmp_path / 'clouds'}; give that path")
    assert "it is a part" not in refusal(tmp_path / "clouds" / "other")
    scene = ("intrinsics.txt", "image/1.jpg", "depth/1.png", "extrinsics/1.txt")
    make(tmp_path, *(f"scene/{name}" for name in scene))
    assert refusal(tmp_path / "clouds" / "1.bin").endswith(f"recording {tmp_path / 'clouds'}; give that path")
    assert refusal(tmp_path / "scene" / "depth" / "1.png").endswith(f"recording {tmp_path / 'scene'}; give that path")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("take.ZIP", "unpack it"),
        ("take.mp4", "a video, which has no depth"),
        ("boxes.json", "it holds boxes; give the recording's folder"),
        ("notes.txt", "notes.txt` lists what each format needs"),
    ],
)
def test_single_files_are_told_what_to_do(tmp_path: Path, name: str, said: str):
    (tmp_path / name).touch()
    assert said in refusal(tmp_path / name)


def test_a_missing_path_is_told_which_part_is_missing(tmp_path: Path):
    make(tmp_path, "kitti/")
    assert f"no such file or folder ({tmp_path} has no kiti; did you mean kitti?)" in refusal(tmp_path / "kiti" / "a")
