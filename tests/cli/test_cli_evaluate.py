"""`annotator evaluate`: table, JSON, curve images, and errors."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from annotator.cli.main import main

HEAD = "image,class,cx,cy,cz,l,w,h,yaw"
CAR = "Car 0.00 0 0.10 100.00 120.00 190.00 180.00 1.50 1.60 4.00 2.00 1.60 20.00 0.20"
PNG = b"\x89PNG\r\n\x1a\n"
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def rooms(tmp_path: Path) -> list[str]:
    (tmp_path / "truth.csv").write_text(f"{HEAD}\n1,night/stand,0,0,0,2,1.5,0.5,0.3\n")
    (tmp_path / "found.csv").write_text(f"{HEAD},score\n1,night/stand,0,0,0,2,1.5,0.5,0.3,0.9\n")
    return [str(tmp_path / "found.csv"), str(tmp_path / "truth.csv")]


def said(capsys: Capture, *words: object, code: int = 0) -> str:
    capsys.readouterr()
    assert main(["evaluate", *map(str, words)]) == code
    captured = capsys.readouterr()
    return captured.err if code else captured.out


def test_evaluate_prints_a_table_or_one_json_object(rooms: list[str], capsys: Capture) -> None:
    table = said(capsys, *rooms, "--protocol", "sunrgbd")
    assert "night/stand" in table
    assert "1.000" in table
    lines = said(capsys, *rooms, "--protocol", "sunrgbd", "--json").splitlines()
    assert [json.loads(line)["0.25"] for line in lines] == [{"mAP": 1.0, "AP": {"night/stand": 1.0}}]


def test_kitti_curves_are_written_as_images(tmp_path: Path, capsys: Capture) -> None:
    for name, score in (("found", " 0.5"), ("label_2", "")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "000000.txt").write_text(CAR + score)
    words = [tmp_path / "found", tmp_path / "label_2", "--protocol", "kitti", "--curves", tmp_path / "a" / "curves"]
    assert f"{tmp_path / 'a' / 'curves'}: 4 images" in said(capsys, *words)
    files = sorted((tmp_path / "a" / "curves").iterdir())
    assert [file.name for file in files] == [f"Car_{metric}.png" for metric in ("3d", "aos", "bbox", "bev")]
    assert all(file.read_bytes().startswith(PNG) for file in files)
    assert list(json.loads(said(capsys, *words, "--json"))) == ["Car"]


def test_a_project_instead_of_files(made_rooms: Path, tmp_path: Path, capsys: Capture) -> None:
    root = ["--projects", str(shutil.copytree(made_rooms / "labelled", tmp_path / "projects"))]
    words = ["--project", "room", *root, "--protocol", "oriented"]
    found = json.loads(said(capsys, *words, "--recordings", "people", "--json"))
    assert found["mAP"] == pytest.approx({"0.25": 1.0, "0.5": 1.0, "0.7": 1.0})
    assert found["classes"]["person"]["objects"] == 15
    assert "note: imported from the recordings themselves, and so compared with themselves: 15 of 15 labels" in said(
        capsys, *words
    )
    assert "no true box" in said(capsys, *words, "--measured", "proposals", code=2)
    assert "measure proposals" in said(capsys, *words, "--against", "reviewed", code=2)


def test_unusable_arguments_are_errors(rooms: list[str], tmp_path: Path, capsys: Capture) -> None:
    assert "give DETECTIONS and TRUTH" in said(capsys, rooms[0], "--protocol", "sunrgbd", code=2)
    assert "not both" in said(capsys, *rooms, "--protocol", "sunrgbd", "--project", "x", code=2)
    assert "need --project" in said(capsys, *rooms, "--protocol", "sunrgbd", "--measured", "proposals", code=2)
    assert "--relaxed is for the kitti protocol" in said(capsys, *rooms, "--protocol", "sunrgbd", "--relaxed", code=2)
    assert "no such folder" in said(capsys, tmp_path / "a", tmp_path / "b", "--protocol", "kitti", code=2)
    broken = said(capsys, rooms[1], rooms[1], "--protocol", "sunrgbd", code=2)
    assert f"{rooms[1]}:1: " in broken.replace("\n", "")
