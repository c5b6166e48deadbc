"""Projects that are replaced, damaged or locked under a running server; and the others, which must not notice."""

from __future__ import annotations

import asyncio
import os
import shutil
import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from fastapi import FastAPI
from in_process import HERE, ask
from live_server import PATIENCE_S, wait_until
from room_api import BOX, ROOM
from store_samples import damage, replace_folder

from annotator.files import unfinished_folder
from annotator.project import create_project
from annotator.project.labels import Labels
from annotator.types import BoxKind, DetectorKind
from annotator.web.app import Fair, create_app
from annotator.web.background import Learner
from annotator.web.folders import clear_leftovers, hold_server_lock
from annotator.web.routes import projects
from annotator.web.schemas import Box3DJson
from annotator.web.security import ServerSettings
from annotator.workflows.workbench import contact_sheet

if TYPE_CHECKING:
    import httpx
    from live_server import Live

    from annotator.web.context import Context


@pytest.fixture
def app(web_settings: ServerSettings) -> FastAPI:
    return create_app(web_settings)


def send(app: FastAPI, method: str, path: str, **request: Any) -> httpx.Response:
    return ask(app, method, path, cookies={"annotator_operator": "Ada"}, headers={"Origin": HERE}, **request)


def draw(app: FastAPI, revision: int) -> httpx.Response:
    change = {"kind": "create", "label": "person", "box": BOX}
    return send(app, "POST", f"{ROOM}/frames/1/changes", json={"revision": revision, "changes": [change]})


def labels(app: FastAPI) -> int:
    return len(send(app, "GET", f"{ROOM}/frames/1").json()["labels"])


def test_nothing_of_a_replaced_database_is_taken_for_that_of_the_new_one(
    app: FastAPI, web_settings: ServerSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    context: Context = app.state.context
    room = web_settings.projects_root / "room"
    old, backup = context.project("room"), room.with_name("backup")
    old.configure(settings=old.config.settings.model_copy(update={"learn_every": 10}))
    shutil.copytree(room, backup)
    rounds: list[Path] = []
    reviewed = [40]
    monkeypatch.setattr(context.jobs, "add", lambda _, path, *rest: rounds.append(path) or SimpleNamespace(id="1"))
    monkeypatch.setattr(Labels, "count", lambda *_: reviewed[0])
    learner, frame, box = Learner(context.jobs), old.frames.get(1), Box3DJson.model_validate(BOX).box()
    learner.look("room", old)
    picture = context.caches.sheets.get(old, frame, box)
    replace_folder(room, backup)
    new = context.project("room")
    reviewed[0] = 12
    learner.look("room", new)
    assert len(rounds) == 2, "what the former one has learned does not count"
    monkeypatch.setattr(contact_sheet, "picture", lambda *_: np.zeros((2, 2, 3), np.uint8))
    assert context.caches.sheets.get(new, frame, box) != picture
    context.close()


def test_a_project_without_its_database_says_what_to_do(app: FastAPI, web_settings: ServerSettings) -> None:
    assert draw(app, 0).status_code == 200
    (web_settings.projects_root / "room" / "project.db").unlink()
    missing = draw(app, 1)
    assert missing.status_code == 409
    assert "project.db: is missing; restore it" in missing.json()["error"]["message"]
    shutil.rmtree(web_settings.projects_root / "room")
    assert draw(app, 1).status_code == 404


NONSENSE = (
    "INSERT INTO labels (uid, frame_id, moment_id, class_id, box, source, state, author, time_ns, track_linked, "
    "box_kind, attributes, values_set) VALUES ('u', 1, 1, 1, '{', 'manual', 'bogus', 'Ada', 0, 0, 'box', '{}', 0)"
)
ODD: dict[str, Callable[[Path], object]] = {
    "dropped": damage("DROP TABLE labels"),
    "too-new": damage("PRAGMA user_version = 1000"),
    "a-link": lambda folder: (folder / "models" / "view").symlink_to("/"),
    "json-folder": lambda folder: ((folder / "project.json").unlink(), (folder / "project.json").mkdir()),
}


def test_no_link_in_an_open_project_is_served(live: Live, tmp_path: Path) -> None:
    secret = tmp_path / "secret.jpg"
    secret.write_bytes(b"\xff\xd8 not for others")
    project = live.context.project("room")
    run, view = project.models_folder / "view" / "run", "0" * 64
    (run / "validation").mkdir(parents=True)
    (run / "detector.safetensors").write_bytes(b"weights")
    project.models.register(
        DetectorKind.VIEW,
        run / "detector.safetensors",
        labels=["person"],
        box_kind=BoxKind.BOX,
        metrics={},
        fingerprint="f",
        activate=False,
    )
    (run / "validation" / "0.jpg").symlink_to(secret)
    (project.path / "views" / f"{view}.png").symlink_to(secret)
    for path in ("models/1/pictures/0.jpg", f"views/{view}.png"):
        answer = live.client.get(f"{ROOM}/{path}")
        assert (answer.status_code, secret.read_bytes() in answer.content) == (404, False)
    assert live.client.get(f"{ROOM}/models").json()["models"][0]["pictures"] == []


def test_odd_projects_are_cards_that_say_what_to_do(
    app: FastAPI, web_settings: ServerSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, harm in ODD.items():
        create_project(web_settings.projects_root, name, ["person"]).close()
        harm(web_settings.projects_root / name)
    create_project(web_settings.projects_root, "nonsense", ["person"]).close()
    damage(f"PRAGMA ignore_check_constraints = 1;;{NONSENSE}")(web_settings.projects_root / "nonsense")
    not_text = web_settings.projects_root / os.fsdecode(b"not-\xff-text")
    shutil.copytree(web_settings.projects_root / "room", not_text)
    answer = send(app, "GET", "/api/projects")
    assert answer.status_code == 200
    listed = {entry["name"]: entry["problem"] for entry in answer.json()}
    assert listed.keys() == {"room", *ODD, "nonsense", "not-?-text"}
    assert listed.pop("room") is None
    assert all(listed.values())
    for name in ODD:
        opened = send(app, "GET", f"/api/projects/{name}")
        assert opened.status_code in (400, 404), (name, opened.text)
        assert opened.json()["error"]["message"] == listed[name]
    assert "models/view: is a link that leads out of the project" in listed["a-link"]
    assert "check the permissions" not in str(listed)
    monkeypatch.setattr(Path, "is_file", _refuse)
    assert "check the permissions" in send(app, "GET", "/api/projects/dropped").json()["error"]["message"]


def _refuse(path: Path) -> bool:
    raise PermissionError(13, "Permission denied", str(path))


def test_a_locked_project_delays_no_other(
    app: FastAPI, web_settings: ServerSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(projects, "LIST_WAIT_S", 0.0)
    create_project(web_settings.projects_root, "locked", ["person"]).close()
    create_project(web_settings.projects_root, "other", ["person"]).close()
    path = web_settings.projects_root / "locked" / "project.db"
    statuses: list[int] = []
    with closing(sqlite3.connect(path, isolation_level=None)) as holder:
        holder.execute("PRAGMA locking_mode = EXCLUSIVE")
        holder.execute("BEGIN EXCLUSIVE")
        waiting = [
            threading.Thread(target=lambda: statuses.append(send(app, "GET", "/api/projects/locked").status_code))
            for _ in range(2)
        ]
        for thread in waiting:
            thread.start()
        wait_until(lambda: app.state.context._opens)
        listed = {entry["name"]: entry["problem"] for entry in send(app, "GET", "/api/projects").json()}
        assert listed["room"] is None
        assert listed["other"] is None
        assert "is locked by another process" in listed["locked"]
        wrong = send(app, "POST", f"{ROOM}/recordings", json={"path": "none"})
        assert wrong.status_code == 404
        assert all(thread.is_alive() for thread in waiting), "they wait for the lock, and nobody waits for them"
        holder.execute("ROLLBACK")
    for thread in waiting:
        thread.join(PATIENCE_S)
    assert statuses == [200, 200]


def test_requests_to_one_project_leave_threads_to_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("annotator.web.app.AT_ONCE", 2)
    begun: list[str] = []

    async def passing() -> None:
        end = asyncio.Event()

        async def app(scope: Any, receive: Any, send: Any) -> None:
            begun.append(scope["path"])
            if "slow" in scope["path"]:
                await end.wait()

        async def call(path: str) -> None:
            await fair({"type": "http", "path": path}, _nothing, _nothing)

        fair = Fair(app, SimpleNamespace())  # type: ignore[arg-type]
        slow = [asyncio.create_task(call(f"/api/projects/slow/{n}")) for n in range(5)]
        while len(begun) < 2:
            await asyncio.sleep(0)
        await call("/api/projects/quick/1")
        assert len(begun) == 3
        end.set()
        await asyncio.gather(*slow)
        assert len(begun) == 6
        assert not fair._gates

    asyncio.run(passing())


async def _nothing(*_: object) -> Any:
    return None


def test_a_start_removes_what_killed_processes_left(
    web_settings: ServerSettings, caplog: pytest.LogCaptureFixture
) -> None:
    root, mark = web_settings.projects_root, "0123456789abcdef" * 2
    left = [root / f".new.{mark}.unfinished", root / "room" / f".project.json.{mark}.tmp"]
    left.append(root / "room" / "views" / f".{mark}.png.{mark}.tmp")
    young, others = root / f".young.{mark}.tmp", root / "room" / "views" / f"{mark}.tmp"
    left[0].mkdir()
    for path in (*left[1:], young, others):
        path.touch()
        if path is not young:
            os.utime(path, (0, 0))
    left.append(root / f".link.{mark}.tmp")
    left[-1].symlink_to(root / "room")
    os.utime(left[-1], (0, 0), follow_symlinks=False)
    clear_leftovers(root)
    assert not any(os.path.lexists(path) for path in left)
    assert young.exists()
    assert others.exists()
    assert (root / "room" / "project.json").exists()
    assert caplog.text.count("a process that was killed had left it") == len(left)


def test_a_start_leaves_alone_what_a_process_still_fills(web_settings: ServerSettings) -> None:
    with unfinished_folder(web_settings.projects_root, "restored") as filled:
        clear_leftovers(web_settings.projects_root)
        assert filled.exists()


def test_a_project_that_cannot_be_written_is_shown_and_refuses_changes(
    web_settings: ServerSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path: path.stat().st_mtime_ns for path in web_settings.projects_root.rglob("*")}
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode, **kind: mode != os.W_OK and access(path, mode, **kind))
    app = create_app(web_settings)
    with hold_server_lock(web_settings.projects_root):
        assert labels(app) == 0
        refused = draw(app, 0)
        assert refused.status_code == 400
        assert "read-only disk" in refused.json()["error"]["message"]
        jobs = app.state.context.jobs.folder
        assert jobs.is_dir()
        assert not jobs.is_relative_to(web_settings.projects_root)
    app.state.context.close()
    assert not jobs.exists()
    assert {path: path.stat().st_mtime_ns for path in web_settings.projects_root.rglob("*")} == before
