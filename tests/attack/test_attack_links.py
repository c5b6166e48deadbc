"""Links and paths in a project or a projects folder that somebody sent: nothing outside is read or written."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from live_server import Live, ended, running
from sound import content_of

from annotator.cli.main import main
from annotator.web.security import ServerSettings

SECRET = "the secret of another folder"
PLACES = (
    "project.db",
    "project.db-wal",
    "project.db-journal",
    "models",
    "models/image",
    "models/view/dataset",
    "models/view/run/weights/last.safetensors",
    "models/view/run/validation/0.jpg",
    "views",
    ".uploads",
)
COMMANDS = (
    ["stats", "room"],
    ["check", "room"],
    ["train", "room", "--only", "image", "--epochs", "1", "--weights", "never"],
    ["annotate", "room"],
    ["lift", "room"],
    ["track", "room"],
    ["export", "room", "OUT"],
    ["views", "room", "OUT"],
    ["add", "room", "RECORDING"],
)


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A folder of somebody else."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "secret.txt").write_text(SECRET, encoding="utf-8")
    return folder


def linked(place: Path, outside: Path) -> None:
    """Puts a link to the folder outside, or to a copy there of what it replaces, in a place of the project."""
    target = outside
    if place.exists():
        target = Path(shutil.move(place, outside / place.name))
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)


@pytest.mark.parametrize("place", PLACES)
def test_no_command_follows_a_link(
    web_settings: ServerSettings,
    generated: Path,
    outside: Path,
    place: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    room = web_settings.projects_root / "room"
    linked(room / place, outside)
    before = content_of(outside)
    words = {"OUT": str(outside.parent / "out"), "RECORDING": str(generated / "hands")}
    for command in COMMANDS:
        code = main([*(words.get(word, word) for word in command), "--projects", str(room.parent)])
        answer = capsys.readouterr()
        # a check finds the link, and says so
        assert code == (1 if command[0] == "check" else 2), (command, answer)
        assert f"{place}: is a link that leads out of the project" in answer.err + answer.out
        assert SECRET not in answer.err + answer.out
    assert content_of(outside) == before
    assert not (outside.parent / "out").exists()


@pytest.mark.parametrize("place", PLACES)
def test_no_server_follows_a_link(web_settings: ServerSettings, outside: Path, place: str) -> None:
    linked(web_settings.projects_root / "room" / place, outside)
    before = content_of(outside)
    with running(web_settings) as live:
        (card,) = live.client.get("/api/projects").json()["projects"]
        assert f"{place}: is a link that leads out of the project" in card["problem"]
        for path in ("", "/models", "/models/1/pictures/0.jpg", f"/views/{'0' * 64}.png", "/frames/1"):
            answer = live.client.get(f"/api/projects/room{path}")
            assert 400 <= answer.status_code < 500
            assert SECRET not in answer.text and str(outside) not in answer.text
    assert content_of(outside) == before


JOBS: dict[str, Callable[[Path, Path], None]] = {
    "the folder": lambda jobs, outside: jobs.symlink_to(outside),
    "the lock": lambda jobs, outside: _file(jobs / "lock").symlink_to(outside / "secret.txt"),
    "the journal": lambda jobs, outside: _file(jobs / "journal.json").symlink_to(outside / "secret.txt"),
    "an export": lambda jobs, outside: _file(jobs / ("a" * 32) / "x.zip").symlink_to(outside / "secret.txt"),
    "a job": lambda jobs, outside: _file(jobs / ("a" * 32)).symlink_to(outside),
}


def _file(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


@pytest.mark.parametrize("kind", JOBS)
def test_a_server_does_not_start_with_linked_jobs(
    web_settings: ServerSettings, outside: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    JOBS[kind](web_settings.projects_root / ".jobs", outside)
    before = content_of(outside)
    assert main(["serve", "--projects", str(web_settings.projects_root), "--port", "0"]) == 2
    assert "is a link that leads out of the projects' folder of jobs; remove it" in capsys.readouterr().err
    assert content_of(outside) == before


@pytest.mark.parametrize("file", ["../../../outside/secret.txt", "/etc/passwd", "..", ".", "", "a/../../../x", 3, None])
@pytest.mark.parametrize("job", ["a" * 32, "../../outside", "/etc", "..", ""])
def test_a_journal_leads_nowhere(web_settings: ServerSettings, outside: Path, file: Any, job: str) -> None:
    jobs = web_settings.projects_root / ".jobs"
    (jobs / ("a" * 32)).mkdir(parents=True)
    record = {"id": job, "project": "room", "kind": "export", "state": "done", "created_ns": 1, "operator": "Eve"}
    content = {"jobs": [{**record, "download": "kept", "result": {"file": file}}]}
    (jobs / "journal.json").write_text(json.dumps(content), encoding="utf-8")
    before = content_of(outside)
    with running(web_settings) as live:
        for name in {"a" * 32, job.replace("/", "%2f")}:
            answer = live.client.get(f"/api/jobs/{name}/download")
            assert answer.status_code in (404, 405, 422)
            assert SECRET not in answer.text and "root:" not in answer.text
    assert content_of(outside) == before


@pytest.mark.parametrize("path", ["/etc", "/etc/passwd", "/proc/self/environ", "OUTSIDE", "../../outside"])
def test_a_recording_elsewhere_shows_nothing(web_settings: ServerSettings, outside: Path, path: str) -> None:
    """Its path is of the project's author. What is no recording is not shown; to others, nothing outside is."""
    named = path.replace("OUTSIDE", str(outside))
    with closing(sqlite3.connect(web_settings.projects_root / "room" / "project.db")) as database, database:
        database.execute("UPDATE recordings SET path = ?", [named])
    with running(web_settings) as live:
        _require_nothing(live)


def test_other_computers_see_no_recording_elsewhere(web_settings: ServerSettings, tmp_path: Path) -> None:
    """Neither a page nor a job of a server for other computers reads it, although it is a sound one."""
    (tmp_path / "offered").mkdir()
    settings = replace(web_settings, host="0.0.0.0", token="t" * 32, folders=(tmp_path / "offered",))
    with running(settings) as live:
        _require_nothing(live)
        for request in (
            {"kind": "import", "recordings": [1]},
            {"kind": "export", "format": "rcv", "empty_frames": True},
        ):
            job = ended(live, live.client.post("/api/projects/room/jobs", json=request).json())
            assert job["state"] == "failed", job
            assert "lies outside the folders that this server offers" in job["message"]


def _require_nothing(live: Live) -> None:
    for path in ("image.jpg", "", "/label"):
        answer = live.client.get(f"/api/projects/room/frames/1/{path}".replace("//", "/").rstrip("/"))
        assert 400 <= answer.status_code < 500, answer.text
        assert SECRET not in answer.text and "root:" not in answer.text
