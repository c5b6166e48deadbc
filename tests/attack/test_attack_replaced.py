"""Projects are replaced on disk while operators save: nothing acknowledged afterwards is lost, and nothing is mixed."""

from __future__ import annotations

import random
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
from live_server import Live, wait_until

from annotator.project import open_project

pytestmark = pytest.mark.attack

BOX = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "quaternion": [0.9, 0.1, 0.4, 0.1]}
CLIENTS, SAVES = 3, 4


@dataclass(eq=False)
class Operators:
    """Clients that draw boxes, each on its own frame.

    Attributes:
        acknowledged: number of boxes of each frame that the server acknowledged since `mark`, by frame.
        odd: answers that no operator should see.
    """

    live: Live
    acknowledged: dict[int, list[tuple[float, str]]] = field(default_factory=dict)
    odd: list[str] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)

    def draw(self, frame: int) -> None:
        """Draws boxes on a frame until the end."""
        path = f"/api/projects/room/frames/{frame}"
        headers, cookies = dict(self.live.client.headers), dict(self.live.client.cookies)
        with httpx.Client(base_url=self.live.url, headers=headers, cookies=cookies, timeout=60) as client:
            while not self.ended.is_set():
                began = time.monotonic()
                shown = client.get(path)
                if not self._is_fine(shown, (404, 400, 409)):
                    continue
                change = {"kind": "create", "label": "person", "box": BOX}
                known = {label["uid"] for label in shown.json()["labels"]}
                body = {"revision": shown.json()["frame"]["revision"], "changes": [change]}
                saved = client.post(f"{path}/changes", json=body)
                if self._is_fine(saved, (404, 400, 409)):
                    (uid,) = {label["uid"] for label in saved.json()["labels"]} - known
                    self.acknowledged.setdefault(frame, []).append((began, uid))

    def _is_fine(self, answer: httpx.Response, refused: tuple[int, ...]) -> bool:
        if answer.status_code != 200 and answer.status_code not in refused:
            self.odd.append(f"{answer.status_code} {answer.text}")
        return answer.status_code == 200

    def saved_since(self, mark: float) -> dict[int, set[str]]:
        """Uids of the boxes whose saving began after a time and was acknowledged, by frame."""
        return {
            frame: {uid for began, uid in list(saved) if began > mark} for frame, saved in self.acknowledged.items()
        }


def _folder(room: Path, backup: Path) -> None:
    shutil.rmtree(room)
    shutil.copytree(backup, room)


def _database(room: Path, backup: Path) -> None:
    """The database alone, next to what SQLite has beside the old one."""
    (room / "project.db").unlink()
    with (
        closing(sqlite3.connect(backup / "project.db")) as source,
        closing(sqlite3.connect(room / "new.db")) as target,
    ):
        source.backup(target)
    (room / "new.db").rename(room / "project.db")


def _moved(room: Path, backup: Path) -> None:
    aside = room.with_name(f"moved-{time.monotonic_ns()}")
    room.rename(aside)
    shutil.copytree(backup, room)


@pytest.mark.parametrize("replace", [_folder, _database, _moved])
def test_saves_go_to_the_project_that_is_on_disk(
    live: Live, tmp_path: Path, chance: random.Random, times: int, replace: Callable[[Path, Path], None]
) -> None:
    room, backup = live.settings.projects_root / "room", tmp_path / "backup"
    shutil.copytree(room, backup)
    operators = Operators(live)
    threads = [threading.Thread(target=operators.draw, args=(frame,)) for frame in range(1, CLIENTS + 1)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(times):
            time.sleep(chance.uniform(0.0, 0.3))
            replace(room, backup)
            mark = time.monotonic()
            wait_until(
                lambda since=mark: sum(map(len, operators.saved_since(since).values())) >= SAVES or operators.odd
            )
            saved = operators.saved_since(mark)
            with open_project(room) as project:
                assert project.problems() == []
                for frame, uids in saved.items():
                    assert uids <= {label.uid for label in project.labels.of_frame(frame)}
    finally:
        operators.ended.set()
        for thread in threads:
            thread.join()
    assert operators.odd == []
