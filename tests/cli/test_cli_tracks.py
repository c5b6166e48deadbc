"""The commands `track` and `interpolate`."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator.cli.main import main
from annotator.project import WriteContext, open_project
from annotator.types import ReviewState


@pytest.fixture
def root(generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the project `room`: five frames with three labelled people."""
    folder = tmp_path / "projects"
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(folder))
    assert main(["new", "room", "--classes", "person"]) == 0
    assert main(["add", "room", str(generated / "people")]) == 0
    return folder / "room"


def test_interpolate_and_track(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with open_project(root) as project:
        for frame in project.frames.of()[1:4]:
            for revision, label in enumerate(project.labels.of_frame(frame.id), frame.revision):
                project.labels.delete(frame.id, label.uid, WriteContext(revision, "ann"))
    capsys.readouterr()
    assert main(["interpolate", "room", "people", "--track", "1"]) == 0
    assert "track 1: 3 frames filled" in capsys.readouterr().out
    assert main(["interpolate", "room", "people", "--track", "2", "--from", "000000", "--to", "000004", "--refit"]) == 0
    with open_project(root) as project:
        states = [[label.state for label in project.labels.of_frame(frame.id)] for frame in project.frames.of()]
        assert states[2] == [ReviewState.PROPOSED] * 2
        assert all(label.track_id in (1, 2, 3) for f in project.frames.of() for label in project.labels.of_frame(f.id))
    assert main(["interpolate", "room", "people", "--track", "9"]) == 2
    assert "track 9 has 0 reviewed boxes" in capsys.readouterr().err
    assert main(["track", "room", "--recordings", "people"]) == 0
    assert "12 boxes in 3 tracks of 1 recording, 0 changed" in capsys.readouterr().out
    assert main(["track", "room", "--no-smooth"]) == 0
