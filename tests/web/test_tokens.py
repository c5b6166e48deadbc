"""The token of a server: where it comes from, how long its cookie lives, and who may read what the server writes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from live_server import ended, running

from annotator.project import create_project
from annotator.types.errors import ConfigError
from annotator.web.jobs.records import WORK
from annotator.web.security import VARIABLE, ServerSettings, state_folder, with_token

LONG = "a-token-from-the-operator"


@pytest.fixture(autouse=True)
def _state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def token_file(folder: Path, content: str, mode: int = 0o600) -> Path:
    path = folder / "token"
    path.write_text(content)
    path.chmod(mode)
    return path


def test_every_address_has_a_new_token_unless_one_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = ServerSettings(tmp_path), ServerSettings(tmp_path, host="192.168.0.9")
    tokens = [with_token(settings).token for settings in (here, here, there, there)]
    assert len(set(tokens)) == 4
    assert all(token is not None and len(token) == 43 for token in tokens)
    assert with_token(here, token_file(tmp_path, f"{LONG}\n")).token == LONG
    monkeypatch.setenv(VARIABLE, LONG)
    assert with_token(there).token == LONG
    assert VARIABLE not in os.environ, "jobs would inherit it"
    assert with_token(here, no_token=True).token is None


@pytest.mark.parametrize(
    ("content", "mode", "said"),
    [
        (LONG, 0o644, "other users may read it; run chmod 600"),
        ("two words", 0o600, "is not one line with a token"),
        ("x" * 5000, 0o600, "is not one line with a token"),
        ("ü" * 20, 0o600, "a token needs at least 16 ASCII"),
    ],
)
def test_unusable_token_files_are_errors(tmp_path: Path, content: str, mode: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        with_token(ServerSettings(tmp_path), token_file(tmp_path, content, mode))


def test_browsers_stay_signed_in_on_this_computer_and_with_the_same_token(tmp_path: Path) -> None:
    here = ServerSettings(tmp_path)
    given, other = token_file(tmp_path, LONG), tmp_path / "other"
    kept = [with_token(here).cookie, with_token(here).cookie]
    assert kept[0] == kept[1]
    there = [with_token(ServerSettings(tmp_path, host="192.168.0.9")) for _ in range(2)]
    assert there[0].cookie != there[1].cookie
    same = {with_token(settings, given).cookie for settings in (here, *there)}
    assert len(same) == 1
    assert len({*kept, *same, with_token(ServerSettings(other)).cookie}) == 3
    assert with_token(here, token_file(tmp_path, LONG + "2")).cookie not in same
    secret = state_folder() / "secret"
    assert (secret.stat().st_mode & 0o777, secret.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    secret.write_bytes(b"damaged")
    assert with_token(here).cookie != kept[0]


def test_other_users_can_read_neither_projects_nor_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(WORK, "propose", "no.such.module:work")
    before = os.umask(0o022)
    try:
        with create_project(tmp_path / "projects", "room", ("person",)) as project:
            project.log.last()
        with running(ServerSettings(tmp_path / "projects", port=0)) as live:
            job = live.client.post("/api/projects/room/jobs", json={"kind": "propose"}).json()
            ended(live, job)
    finally:
        os.umask(before)
    room, jobs = tmp_path / "projects/room", tmp_path / "projects/.jobs"
    assert {folder.stat().st_mode & 0o777 for folder in (room, jobs)} == {0o700}
    files = [*room.glob("project.db*"), *(path for path in jobs.rglob("*") if path.is_file())]
    assert {file.name for file in files} >= {"project.db", "journal.json"}
    assert [file for file in files if file.stat().st_mode & 0o777 != 0o600] == []
