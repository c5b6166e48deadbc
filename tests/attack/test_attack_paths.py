"""Paths that lead out of what may be read: in every path parameter, in the folders' list, in the page's own files."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from attacks import content_of, request, require_alive
from live_server import Live, ended, running

from annotator.cli.main import main
from annotator.web.security import ServerSettings

SECRET = b"the-secret-outside"
PARTS = (
    "..",
    "%2e%2e",
    "..%2f..%2f..%2f..%2fetc%2fpasswd",
    "%252e%252e%252fsecret",
    "..%5c..%5csecret",
    "%2fetc%2fpasswd",
    "room%2f..%2f..%2fsecret",
    "room%00",
    "%00",
    "%ff%fe",
    "%c0%ae%c0%ae%2f",
    "%ed%a0%80",
    ".jobs",
    ".uploads",
    "room%20",
    "room.",
    "~",
    "%0d%0aSet-Cookie:%20a=b",
    "<script>alert(1)</script>",
    "a" * 5000,
    "-1",
    "9" * 400,
    "1e3",
    "١",
)


@pytest.fixture
def places(web_settings: ServerSettings, generated: Path, tmp_path: Path) -> Iterator[Live]:
    """A server whose registered folder also has links that lead out of it, beside a secret."""
    (tmp_path / "secret").write_bytes(SECRET)
    (web_settings.projects_root / "secret").write_bytes(SECRET)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, target in (("out", generated), ("up", ".."), ("loop", "loop"), ("file", tmp_path / "secret")):
        (folder / name).symlink_to(target)
    (folder / ".hidden").symlink_to(generated)
    with running(ServerSettings(web_settings.projects_root, (folder,), port=0)) as live:
        yield live


def test_no_path_parameter_leads_out(places: Live, tmp_path: Path) -> None:
    paths = places.client.get("/api/openapi.json").json()["paths"]
    operations = [(path, method.upper()) for path, methods in paths.items() for method in methods if "{" in path]
    assert len(operations) > 30
    wrong = []
    for path, method in operations:
        names = re.findall(r"\{[^}]*\}", path)
        for part in PARTS:
            for name in names:
                # the other parameters exist
                target = path.replace(name, part)
                target = re.sub(r"\{(project|name)\}", "room", target)
                target = re.sub(r"\{[^}]*\}", "1", target)
                status, answer = request(places, method, target, b"" if method == "GET" else b"{}")
                head = answer.partition(b"\r\n\r\n")[0].lower()
                leaks = SECRET in answer or b"root:" in answer or str(tmp_path).encode() in answer
                # a slash at the end is redirected away; tracks may have negative numbers
                refused = 400 <= status < 500 or (status == 307 and f"location: {places.url}/".encode() in head)
                refused = refused or re.search(r"/tracks/-1(/sheet)?$", target) is not None
                if not refused or leaks or b"set-cookie" in head:
                    wrong.append((method, target[:200], status))
    assert wrong == []
    require_alive(places)


def test_no_file_beside_the_page_is_served(places: Live) -> None:
    for prefix in ("/assets/", "/", "/viser/1/"):
        for name in (*PARTS, "../secret", "//etc/passwd", "js/../../secret", "../../../../../../../etc/passwd"):
            status, answer = request(places, "GET", prefix + name)
            assert 400 <= status < 500, (prefix + name, status)
            assert SECRET not in answer and b"root:" not in answer


SECRET_TEXT = "the secret of another folder"
PLACES = ("project.db", "project.db-wal", "models/view/run/weights/last.safetensors", "views", ".uploads")
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
    (folder / "secret.txt").write_text(SECRET_TEXT, encoding="utf-8")
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
        assert SECRET_TEXT not in answer.err + answer.out
    assert content_of(outside) == before
    assert not (outside.parent / "out").exists()


@pytest.mark.parametrize("place", [".jobs", ".jobs/journal.json", f".jobs/{'a' * 32}/x.zip"])
def test_a_server_does_not_start_with_linked_jobs(
    web_settings: ServerSettings, outside: Path, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    linked(web_settings.projects_root / place, outside)
    before = content_of(outside)
    assert main(["serve", "--projects", str(web_settings.projects_root), "--port", "0"]) == 2
    assert "is a link that leads out of the projects' folder of jobs; remove it" in capsys.readouterr().err
    assert content_of(outside) == before


@pytest.mark.parametrize("job", ["a" * 32, "../../outside"])
def test_a_journal_leads_nowhere(web_settings: ServerSettings, outside: Path, job: str) -> None:
    folder = web_settings.projects_root / ".jobs"
    (folder / ("a" * 32)).mkdir(parents=True)
    record = {"project": "room", "kind": "export", "state": "done", "created_ns": 1, "operator": "Eve"}
    files = {job: "../../../outside/secret.txt", "b" * 32: "/etc/passwd", "c" * 32: "..", "d" * 32: 3}
    jobs = [{**record, "id": name, "download": "kept", "result": {"file": file}} for name, file in files.items()]
    (folder / "journal.json").write_text(json.dumps({"jobs": jobs}), encoding="utf-8")
    before = content_of(outside)
    with running(web_settings) as live:
        # a name that is none makes it no journal
        assert len(live.client.get("/api/jobs").json()) == (4 if job == "a" * 32 else 0)
        for name in files:
            answer = live.client.get(f"/api/jobs/{name.replace('/', '%2f')}/download")
            assert answer.status_code in (404, 422), answer.text
            assert SECRET_TEXT not in answer.text and "root:" not in answer.text
    assert content_of(outside) == before


@pytest.mark.parametrize("path", ["/etc/passwd", "OUTSIDE", "../../outside"])
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
    with running(replace(web_settings, host="0.0.0.0", token="t" * 32, folders=(tmp_path / "offered",))) as live:
        _require_nothing(live)
        asked = {"kind": "export", "format": "rcv", "empty_frames": True}
        job = ended(live, live.client.post("/api/projects/room/jobs", json=asked).json())
        assert job["state"] == "failed", job
        assert "lies outside the folders that this server offers" in job["message"]


def _require_nothing(live: Live) -> None:
    for path in ("image.jpg", "", "/label"):
        answer = live.client.get(f"/api/projects/room/frames/1/{path}".replace("//", "/").rstrip("/"))
        assert 400 <= answer.status_code < 500, answer.text
        assert SECRET_TEXT not in answer.text and "root:" not in answer.text
