"""The command line as a whole: fast help, lazy imports, ends; each refusal says what to do next."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from annotator.cli import main as cli
from annotator.cli.main import COMMANDS, Command, main
from annotator.cli.output import counted
from annotator.types.errors import FormatError
from annotator.workflows import doctor
from annotator.workflows.doctor import Line, Report, State

HEAVY = ("torch", "torchvision", "ultralytics", "open3d", "viser", "av", "ray")
LIGHTER = ("numpy", "scipy", "cv2", "pydantic", "sqlalchemy", "tyro", "rich")


def python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


def test_help_loads_no_library() -> None:
    code = "import sys; from annotator.cli.main import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    result = python(code)
    assert result.returncode == 0
    assert "usage: annotator" in result.stdout
    assert not set(HEAVY + LIGHTER) & set(result.stderr.split())


def test_every_command_exists_and_its_help_loads_nothing_heavy() -> None:
    """One process prints the help of all commands; it must not import the slow libraries."""
    code = """
import contextlib, io, sys
from annotator.cli.main import main
from annotator.cli.main import COMMANDS
for name in COMMANDS:
    text = io.StringIO()
    try:
        with contextlib.redirect_stdout(text):
            main([*name.split(), "--help", "--debug"])
    except SystemExit as end:
        assert end.code == 0, (name, end.code)
    assert f"usage: annotator {name}" in text.getvalue(), (name, text.getvalue())
print(*sys.modules)
"""
    result = python(code)
    assert result.returncode == 0, result.stderr
    loaded = sorted(set(HEAVY) & set(result.stdout.split()))
    assert loaded == [], "import these inside the functions that use them"


def test_an_option_that_is_given_twice_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--folder", "a", "--folder=b"]) == 2
    assert "--folder is given twice; give it once, with all its values: --folder A B" in capsys.readouterr().err


def test_completion_offers_all_commands_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    written = capsys.readouterr().out
    assert all(f"{name.split()[-1]}" in written for name in COMMANDS)
    (tmp_path / "bash").write_text(written)
    code = (
        'source "$0"; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=(); '
        '_tyro_annotator; echo "${COMPREPLY[@]}"; complete -p annotator'
    )

    def completed(*words: str) -> tuple[str, str]:
        result = subprocess.run(
            ["bash", "-c", code, tmp_path / "bash", *words], capture_output=True, text=True, check=True
        ).stdout.splitlines()
        return result[0], result[1]

    assert completed("annotator", "ex")[0] == "export"
    assert completed("annotator", "project", "move", "hands", "--p")[0] == "--projects"
    assert completed("annotator", "export", "hands", "out", "--format", "kitti-")[0] == "kitti-tracking"
    assert completed("annotator", "help", "ex")[0] == "export"
    # elsewhere bash offers files
    assert "-o default" in completed("annotator", "inspect", "x")[1]


ENDINGS = [
    (None, 0, ""),
    (1, 1, ""),
    # not wrapped, and not interpreted as markup
    (FormatError(Path("a/[b].json"), ("word " * 60).strip(), 3), 2, f"error: a/[b].json:3: {('word ' * 60).strip()}\n"),
    (ZeroDivisionError("by zero"), 1, "error: ZeroDivisionError: by zero\nthis is a bug in annotator; --debug shows"),
    (KeyboardInterrupt(), 130, "interrupted\n"),
]


@pytest.mark.parametrize(("end", "code", "says"), ENDINGS)
def test_how_a_command_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], end: Any, code: int, says: str
) -> None:
    def run() -> int | None:
        """Ends."""
        if isinstance(end, Exception):
            with counted("a bar that the message must not stand after"):
                raise end
        if end is not None and not isinstance(end, int):
            raise end
        return end  # type: ignore[no-any-return]

    monkeypatch.setattr(cli, "_fake", run, raising=False)
    monkeypatch.setitem(COMMANDS, "fake", Command("main:_fake", "for this test"))
    assert main(["fake"]) == code
    captured = capsys.readouterr()
    assert captured.err.startswith(says) and "Traceback" not in captured.err and captured.out == ""
    if isinstance(end, BaseException):
        for words in (["--debug", "fake"], ["fake", "--debug"]):
            with pytest.raises(type(end)):
                main(words)


@pytest.mark.skipif(os.name != "posix", reason="other systems handle closed pipes differently")
def test_a_closed_pipe_is_not_an_error() -> None:
    code = """
import sys
from annotator.cli import main as cli
def endless(words):
    while True:
        sys.stdout.write("line\\n")
cli._dispatch = endless
sys.exit(cli.main(["x"]))
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline() == b"line\n"
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(30) == 128 + 13
    process.stderr.close()


ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("state", "code"), [(State.OK, 0), (State.WARNING, 0), (State.FAILED, 1)])
def test_the_exit_code_is_1_if_a_check_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, state: State, code: int
) -> None:
    asked: list[Path] = []

    def examine(projects: Path) -> Report:
        asked.append(projects)
        line = Line(section="machine", name="thing", state=state, found="there")
        return Report(annotator_version="1", lines=(line,))

    monkeypatch.setattr(doctor, "examine", examine)
    assert main(["doctor", "--projects", str(tmp_path)]) == code
    assert f"thing  there: {state}\n" in capsys.readouterr().out
    assert main(["doctor", "--json", "--projects", str(tmp_path)]) == code
    assert Report.model_validate_json(capsys.readouterr().out).lines[0].state is state
    assert asked == [tmp_path, tmp_path]


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
