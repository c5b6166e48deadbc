"""What a new user meets: each refusal is one line that says what to do next.

A new refusal is one row of `REFUSALS`; its command runs in a folder with what `place` makes.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from annotator.cli.main import main

Run = Callable[..., str]
ROW = "Car 0.00 0 -1.5 100 100 200 200 1.5 1.6 3.9 1.0 1.5 20.0 -1.5"

REFUSALS = [
    # names of projects, recordings and classes
    ("stats Room", "has no project 'Room' (did you mean 'room'?)"),
    ("project restore recordings", "is a folder; `annotator project copy` takes in a project's folder"),
    ("stats ../room", "--projects names the folder of projects"),
    ("project remove room People", "no recording 'People'; did you mean 'people'?"),
    ("classes attribut room pose", "unknown command 'classes attribut'; did you mean 'classes attribute'?"),
    # paths
    ("check peple", "peple: no such file or folder, and projects has no project 'peple' (it has: room)"),
    ("check no/such", "has no no); give the path of a recording"),
    ("add room recordigs/people", "has no recordigs; did you mean recordings?)"),
    ("check labels", "it holds text files; if they are labels, give the folder that also has their images and clouds"),
    # evaluation
    ("evaluate labels labels --protocol kitti", "append one to each row (1.0 if all are equally certain)"),
    ("evaluate recordings recordings --protocol oriented", "is no dataset in the format rcv, which has a dataset.json"),
    ("evaluate boxes.csv --protocol sunrgbd", "give DETECTIONS and TRUTH"),
    ("evaluate boxes.csv boxes.csv --protocol sunrgbd --project room", "not both"),
    ("evaluate boxes.csv boxes.csv --protocol sunrgbd --measured proposals", "need --project"),
    ("evaluate boxes.csv boxes.csv --protocol sunrgbd --relaxed", "--relaxed is for the kitti protocol"),
    ("evaluate boxes.csv boxes.csv --protocol sunrgbd", "boxes.csv:1: has no column score"),
    ("evaluate no such --protocol kitti", "no such folder"),
    # options
    ("add room", "no recording given"),
    ("train room --epochs 0", "--epochs must be greater than or equal to 1, not 0"),
    ("train room --image-epochs 0", "--image-epochs must be greater than or equal to 1, not 0"),
    ("train room --size 5", "--size must be"),
    ("train room --image-size 5", "--image-size must be"),
    ("train room --views -1", "--views must be"),
    ("import room", "no labels given; write annotator import room PATH, or --as 2d"),
    ("import room flat.json --pictures p --recording x", "--recording is for boxes on camera images"),
    ("import room flat.json --fraction 0.5", "--fraction and --seed need --as 2d"),
    ("import room flat.json --min-score 0.5", "--source and --min-score need --as proposals"),
    ("import room flat.json --as 2d", "is coco, which contains no 3D boxes; leave out --as"),
    ("import room --as 2d --pictures p", "leave out --pictures"),
    ("train room --size 100", "--size must be a multiple of 32, not 100"),
    ("demo d --frames 1", "--frames must be 2 or more, not 1"),
    ("serve --folder no/such", "--folder no/such: no such folder"),
    ("serve --host 0.0.0.0 --no-token", "it needs a token"),
    ("serve --token-file no/such --no-token", "exclude each other"),
    ("live room kinect:0 --loop", "a device has its own rate"),
    # what is set for a recording
    ("up room people 1 2", "three"),
    ("up room people 0 -1 0 --clear", "three"),
    ("up room people 0 0 0", "three"),
    ("calibrate room people --turn 0 900 0", "give"),
    ("calibrate room people --clear --shift 0 0 1", "give"),
    ("calibrate room people --time-offset 0.1", "have no times"),
    # import
    ("import room sun", "has images and no folder label/, so there are no labels to import"),
    ("import room labels --classes car=person", "the dataset has no class 'car'; did you mean 'Car'?"),
    ("import room flat.json", "Map the classes to those of the project, as in --classes Car=person, or add them with"),
    ("import room other", "no format of boxes was recognised; if it has one of these, name it: --format coco|yolo|"),
    ("import room labels/000000.txt", "has the labels of one frame; give the folder of all: labels"),
    # export
    ("export room out --split train=0.8,val=0.3", "add up to 1.1, not to 1; write train=0.73,val=0.27, or ratios"),
]


@pytest.fixture(scope="module")
def place(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the project `room`, its recording, and files that a command cannot use."""
    folder = tmp_path_factory.mktemp("place")
    shutil.copytree(generated / "people", folder / "recordings" / "people")
    projects = ["--projects", str(folder / "projects")]
    assert main(["new", "room", "--classes", "person", *projects]) == 0
    assert main(["add", "room", str(folder / "recordings" / "people"), *projects]) == 0
    for name in ("labels", "other", "sun/image", "sun/calib"):
        (folder / name).mkdir(parents=True)
    (folder / "labels/000000.txt").write_text(ROW)
    (folder / "boxes.csv").write_text("image,class,cx,cy,cz,l,w,h,yaw\n1,car,0,0,1,1,1,1,0\n")
    (folder / "boxes.json").write_text("{}")
    flat = {"images": [{"id": 1, "file_name": "000000.png", "width": 320, "height": 240}]}
    flat |= {"categories": [{"id": 1, "name": "Car"}]}
    flat |= {"annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [1, 1, 9, 9]}]}
    (folder / "flat.json").write_text(json.dumps(flat))
    (folder / "other/thesis.pdf").touch()
    return folder


@pytest.mark.parametrize(("command", "says"), REFUSALS)
def test_a_refusal_is_one_line_that_says_what_to_do(
    place: Path, monkeypatch: pytest.MonkeyPatch, run: Run, command: str, says: str
) -> None:
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    said = run(command, code=2)
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert says in errors[0]
    assert said.endswith(f"{errors[0]}\n"), "nothing after it"
    assert sorted(place.rglob("*")) == before


def test_ratios_and_rounded_shares_are_no_wrong_split(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    for number, split in enumerate(("a=4,b=1", "a=0.33,b=0.33,c=0.33")):
        assert main(["export", "room", f"../split{number}", "--format", "openlabel", "--split", split]) == 0


def test_a_check_of_labels_that_cannot_be_seen_fails(
    own_copy: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    monkeypatch.chdir(tmp_path)
    recording = own_copy("people")
    for words in ("new room --classes person", f"add room {recording}", "check room"):
        run(words)
    shutil.move(recording, tmp_path / "away")
    said = run("check room", code=1).splitlines()
    assert said[-2].endswith("give its new path: annotator project move room people PATH, or Locate on the start page")
    assert said[-1].endswith("; 1 recording or frame could not be read")
    shutil.move(tmp_path / "away", recording)
    for cached in (tmp_path / "projects/room/cache").iterdir():
        cached.unlink()
    for image in (recording / "color").iterdir():
        image.write_bytes(b"")
    assert run("check room", code=1).splitlines()[-1].endswith("; 5 recordings or frames could not be read")
    assert len(json.loads(run("check room --json", code=1))["unreadable"]) == 5


def test_repeated_findings_are_counted_and_listed_on_request(own_copy: Callable[[str], Path], run: Run) -> None:
    recording = own_copy("people")
    boxes = recording / "truth/boxes.json"
    boxes.write_text(json.dumps(json.loads(boxes.read_text()) | {f"gone{number}": [] for number in range(12)}))

    said = run("check", recording, code=1)
    assert said.count(" stray-file: ") == 5
    assert "stray-file: 7 more like these; --all lists them" in said
    assert run("check", recording, "--all", code=1).count(" stray-file: ") == 12
    assert json.loads(run("check", recording, "--json", code=1))["by_rule"] == {"stray-file": 12}
