"""KITTI rows, folders and archives: numbers by the devkit's conventions, and errors of damaged ones."""

from __future__ import annotations

import unicodedata
import zipfile
from pathlib import Path

import numpy as np
import pytest

from annotator.formats.kitti_objects import (
    KittiRows,
    each_kitti_frame,
    read_kitti_file,
    read_kitti_folder,
    read_kitti_shifts,
)
from annotator.formats.kitti_rows import parse_label_line, read_object_labels, read_tracking_areas, read_tracking_labels
from annotator.formats.kitti_tracking import read_kitti_tracks
from annotator.types.errors import FormatError

CAR = "Car 0.25 2 -1.55 548.00 171.33 572.40 194.42 1.48 1.56 3.62 -2.72 0.82 48.22 -1.62"
DONT_CARE = "DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10"


def test_every_field_of_a_row_is_read():
    row = parse_label_line(CAR)
    assert (row.label, row.truncated, row.occluded, row.alpha) == ("Car", 0.25, 2, -1.55)
    assert row.image_box.xyxy == (548.00, 171.33, 572.40, 194.42)
    assert (row.height, row.width, row.length) == (1.48, 1.56, 3.62)
    assert (row.x, row.y, row.z, row.rotation_y, row.score) == (-2.72, 0.82, 48.22, -1.62, None)


@pytest.mark.parametrize(("word", "sizes"), [("DontCare", "-1 -1 -1"), ("dontcare", "1.5 1.6 3.9")])
def test_dontcare_rows_and_blank_lines_are_skipped(tmp_path: Path, word: str, sizes: str):
    """In any case, as in the devkit, and whatever stands in the fields of a 3D box."""
    path = tmp_path / "a.txt"
    area = DONT_CARE.replace("DontCare", word).replace("-1 -1 -1 -1000", f"{sizes} -1000")
    path.write_text(f"{area}\n\n{CAR}\n")
    assert [truth.label for truth in read_object_labels(path, None)] == ["Car"]
    found = KittiRows()
    ((name, truths),) = each_kitti_frame(tmp_path, found)
    assert (name, [truth.label for truth in truths], found.flat[name]) == ("a", ["Car"], 0)
    assert [row.label for row in read_kitti_file(path, scored=False)] == ["DontCare", "Car"]
    (tmp_path / "label_02.txt").write_text(f"0 -1 {area}\n0 7 {CAR}\n")
    assert {k: len(rows) for k, rows in read_tracking_areas(tmp_path / "label_02.txt").items()} == {0: 1}
    assert {k: len(rows) for k, rows in read_tracking_labels(tmp_path / "label_02.txt", None).items()} == {0: 1}
    path.write_text("")
    assert read_object_labels(path, None) == []


@pytest.mark.parametrize(("written", "read"), [("0", 0.0), ("2", None), ("1.00", 1.0)])
def test_levels_of_truncation_in_tracking_files_are_no_fractions(tmp_path: Path, written: str, read: float | None):
    path = tmp_path / "label_02.txt"
    path.write_text(f"0 7 {CAR.replace('0.25', written, 1)}\n")
    ((truth,),) = read_tracking_labels(path, None).values()
    assert truth.attributes.get("truncation") == read


@pytest.mark.parametrize("row", [f"0 {CAR}", f"0.5 1 {CAR}", f"0 {10**30} {CAR}"])
def test_a_bad_tracking_row_is_named_by_file_and_line(tmp_path: Path, row: str):
    path = tmp_path / "label_02.txt"
    path.write_text(f"0 1 {CAR}\n{row}\n")
    with pytest.raises(FormatError) as caught:
        read_tracking_labels(path, None)
    assert str(caught.value).startswith(f"{path}:2: ")


@pytest.mark.parametrize(("label", "calibration"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_accented_names_keep_the_shift_to_the_colour_camera(tmp_path: Path, label: str, calibration: str):
    def name(form: str) -> str:
        return unicodedata.normalize(form, "Bü")

    for folder in ("label_2", "label_02", "calib"):
        (tmp_path / folder).mkdir()
    (tmp_path / f"label_2/{name(label)}.txt").write_text(CAR)
    (tmp_path / f"label_02/{name(label)}.txt").write_text(f"3 1 {CAR}")
    (tmp_path / f"calib/{name(calibration)}.txt").write_text("P2: 100 0 50 6 0 100 40 0 0 0 1 0\n")
    (key,) = (frame for frame, _ in each_kitti_frame(tmp_path, KittiRows()))
    shifts = read_kitti_shifts(tmp_path)
    assert key == name("NFC") and list(shifts) == [key]
    np.testing.assert_allclose(shifts[key], [0.06, 0, 0])
    frames, shifts = read_kitti_tracks(tmp_path, KittiRows())
    assert list(frames) == list(shifts) == [f"{key}/000003"]
    np.testing.assert_allclose(shifts[f"{key}/000003"], [0.06, 0, 0])
    (tmp_path / "label_02").rename(tmp_path / "other")
    (tmp_path / "frames.csv").write_text(f"id,recording,key,split\n{name(calibration)},take,7,\n")
    assert [frame for frame, _ in each_kitti_frame(tmp_path, KittiRows())] == ["take/7"]
    np.testing.assert_allclose(read_kitti_shifts(tmp_path)["take/7"], [0.06, 0, 0])


def test_a_name_in_both_unicode_forms_is_refused(tmp_path: Path):
    for form in ("NFC", "NFD"):
        (tmp_path / f"{unicodedata.normalize(form, 'Bü')}.txt").write_text(CAR)
    with pytest.raises(FormatError, match=r"has two files called Bü\.txt; keep one"):
        list(each_kitti_frame(tmp_path, KittiRows()))


LABEL = "Car 0.00 0 -1.57 100.00 120.00 200.00 180.00 1.50 1.60 4.00 0.50 1.60 20.00 -1.55"
RESULT = LABEL + " 0.875"


def folder_of(path: Path, files: dict[str, str]) -> Path:
    path.mkdir()
    for name, text in files.items():
        (path / name).write_text(text)
    return path


def archive_of(path: Path, files: dict[str, str]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


FILES = {"000001.txt": f"{RESULT}\n\n{RESULT}\r\n", "000000.txt": "", "readme.md": "no labels"}


@pytest.mark.parametrize("make", [folder_of, archive_of])
def test_a_folder_and_its_archive_give_the_same_rows(tmp_path: Path, make) -> None:
    found = read_kitti_folder(make(tmp_path / "found", FILES), scored=True)
    assert {key: len(rows) for key, rows in found.items()} == {"000000": 0, "000001": 2}
    row = found["000001"][0]
    assert (row.label, row.occluded, row.left, row.length, row.rotation_y, row.score) == (
        "Car",
        0,
        100,
        4,
        -1.55,
        0.875,
    )


def changed(**fields: str) -> str:
    """The row with some fields replaced, given by their number."""
    row = RESULT.split()
    for number, text in fields.items():
        row[int(number[1:])] = text
    return " ".join(row)


BROKEN = [
    pytest.param(LABEL, "a result row has 16", id="no-score"),
    pytest.param("Car 1 2 3", "has 15 fields", id="too-few"),
    pytest.param(changed(_5="wide"), "'wide' is not a number", id="text"),
    pytest.param(changed(_11="nan"), "not a finite number", id="nan"),
    pytest.param(changed(_2="0.5"), "not a whole number", id="half-occluded"),
    pytest.param(changed(_8="-1.5"), "must be positive", id="negative-size"),
    pytest.param(changed(_4="300"), "the 2D box must have left <= right", id="left-of-its-right"),
]


@pytest.mark.parametrize(("row", "problem"), BROKEN)
def test_a_broken_row_is_named(tmp_path: Path, row: str, problem: str) -> None:
    path = folder_of(tmp_path / "found", {"000003.txt": f"{RESULT}\n{row}\n"})
    with pytest.raises(FormatError, match=problem) as caught:
        read_kitti_folder(path, scored=True)
    assert (caught.value.path, caught.value.line) == (path / "000003.txt", 2)
    assert str(caught.value).startswith(f"{path / '000003.txt'}:2: ")


def test_unusable_folders_and_archives_are_errors(tmp_path: Path) -> None:
    (tmp_path / "file.txt").write_text(RESULT)
    (tmp_path / "cut.zip").write_bytes(archive_of(tmp_path / "b.zip", {"1.txt": RESULT * 99}).read_bytes()[:-30])
    archive_of(tmp_path / "empty.zip", {"x.md": ""})
    archive_of(tmp_path / "twice.zip", {"a/1.txt": "", "b/1.txt": ""})
    for name, problem in {
        "missing": "there is no such folder",
        "file.txt": "is neither a folder",
        "cut.zip": "is neither a folder",
        "empty.zip": "has no .txt files",
        "twice.zip": "two files called 1.txt",
    }.items():
        with pytest.raises(FormatError, match=problem):
            read_kitti_folder(tmp_path / name, scored=True)
    with pytest.raises(FormatError, match=r"has no \.txt file"):
        read_kitti_folder(folder_of(tmp_path / "none", {}), scored=True)
