"""Reading folders and archives of KITTI rows, and the errors of damaged ones."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from annotator.formats.kitti_objects import read_kitti_folder
from annotator.types.errors import FormatError

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


def test_archive_members_are_named_by_their_file_name_alone(tmp_path: Path) -> None:
    """Nothing is unpacked, so member names with .. or absolute paths are harmless."""
    files = {"data/1.txt": RESULT, "../../2.txt": RESULT, "/etc/3.txt": "", "__MACOSX/data/._1.txt": "\0"}
    path = archive_of(tmp_path / "a.zip", files)
    assert sorted(read_kitti_folder(path, scored=True)) == ["1", "2", "3"]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.zip"]


def changed(**fields: str) -> str:
    """The row with some fields replaced, given by their number."""
    row = RESULT.split()
    for number, text in fields.items():
        row[int(number[1:])] = text
    return " ".join(row)


BROKEN = [
    pytest.param(LABEL, "a result row has 16", id="no-score"),
    pytest.param("Car 1 2 3", "has 15 fields", id="too-few"),
    pytest.param(RESULT + " 1", "has 15 fields", id="too-many"),
    pytest.param(changed(_5="wide"), "'wide' is not a number", id="text"),
    pytest.param(changed(_5="1_00"), "'1_00' is not a number", id="underscore"),
    pytest.param(changed(_11="nan"), "not a finite number", id="nan"),
    pytest.param(changed(_15="inf"), "not a finite number", id="infinite-score"),
    pytest.param(changed(_2="0.5"), "not a whole number", id="half-occluded"),
    pytest.param(changed(_8="-1.5"), "must be positive", id="negative-size"),
    pytest.param(changed(_9="0"), "must be positive", id="no-size"),
    pytest.param(changed(_4="300"), "the 2D box must have left <= right", id="left-of-its-right"),
    pytest.param(changed(_7="10"), "the 2D box must have left <= right", id="upside-down"),
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
