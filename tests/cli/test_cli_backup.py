"""The commands that back up, restore, verify, repair and copy projects."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from annotator.cli.main import main
from annotator.project import WriteContext, open_project
from annotator.types import BoxKind


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of projects, with the project `hands`."""
    folder = tmp_path / "projects"
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(folder))
    monkeypatch.chdir(tmp_path)
    assert main(["new", "hands", "--classes", "hand"]) == 0
    with open_project(folder / "hands") as project:
        project.recordings.add(tmp_path / "take", "rgbd", "take", ["0"], True)
        project.boxes.set_on_image(1, [], BoxKind.BOX, WriteContext(0, "Ada"))
    return folder


def test_back_up_verify_and_restore(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["project", "backup", "hands"]) == 0
    (file,) = root.parent.glob("hands-*.zip")
    assert f"annotator project restore {file.name} NAME" in capsys.readouterr().out
    assert main(["project", "backup", "hands", "bare.zip", "--models", "none"]) == 0
    assert main(["project", "restore", file.name]) == 2
    assert "exists already; choose another name" in capsys.readouterr().err
    assert main(["project", "restore", "bare.zip", "again"]) == 0
    assert "0 labels, 1 event, as of " in capsys.readouterr().out
    assert main(["project", "verify", "again", "--deep"]) == 0
    assert capsys.readouterr().out == "again: sound\n"
    assert main(["project", "copy", str(root / "again"), "taken"]) == 0
    assert f"reads the recording take from {root.parent / 'take'} (not on" in capsys.readouterr().out
    assert sorted(path.name for path in root.iterdir()) == ["again", "hands", "taken"]


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        ("DROP TABLE labels", "lacks the table labels"),
        ("DELETE FROM frames", "refers to a missing row of frames"),
        ("UPDATE frames SET finalised = 1", "frames has other values than the events give"),
    ],
)
def test_a_damaged_project_is_found_by_verify_and_by_check(
    root: Path, capsys: pytest.CaptureFixture[str], statement: str, says: str
) -> None:
    with closing(sqlite3.connect(root / "hands" / "project.db", isolation_level=None)) as connection:
        connection.execute(statement)
    for words in (["project", "verify", "hands", "--deep"], ["check", "hands"]):
        assert main(words) == 1
        said = capsys.readouterr().out
        assert says in said and "annotator project restore" in said
        assert main([*words, "--json"]) == 1
        assert says in " ".join(json.loads(capsys.readouterr().out)["problems"])


def test_repair_says_what_it_did(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["project", "repair", "hands"]) == 0
    assert "its state was made anew from 1 event; backed up before" in capsys.readouterr().out
    with closing(sqlite3.connect(root / "hands" / "project.db", isolation_level=None)) as connection:
        connection.execute("DROP TABLE labels")
    assert main(["project", "repair", "hands", "saved"]) == 0
    assert "a new project with 1 event; the damaged project is unchanged" in capsys.readouterr().out
    assert main(["project", "verify", "saved", "--deep"]) == 0


def test_missing_files_and_the_newest_backup_are_named(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with open_project(root / "hands") as project:
        view = project.views.store(np.zeros((4, 4, 3), np.uint8))
        project.boxes.set_on_view(view, [], BoxKind.BOX, WriteContext(1, "Ada"), frame_id=1)
    assert main(["project", "repair", "hands"]) == 0
    assert "lacks" not in capsys.readouterr().out
    (root / "hands" / "views" / f"{view}.png").unlink()
    lacks = f"the project lacks 1 file of its pseudo-views or detectors: views/{view}.png"
    for words in ("backup hands one.zip", "repair hands"):
        assert main(["project", *words.split()]) == 0
        assert lacks in capsys.readouterr().out
    assert main(["project", "verify", "hands", "--deep"]) == 1
    newest = max((root / ".backups" / "hands").iterdir())
    assert f"a backup such as {newest}, the newest automatic one" in capsys.readouterr().out
