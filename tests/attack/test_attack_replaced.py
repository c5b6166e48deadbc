"""Projects are replaced on disk while operators save: nothing acknowledged afterwards is lost, and nothing is mixed.

What a single replacement does is in tests/project/test_replaced.py and tests/web/test_odd_projects.py.
"""

from __future__ import annotations

import random
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
from live_server import Live, wait_until
from room_api import BOX, ROOM, change
from store_samples import replace_database, replace_folder

from annotator.project import open_project

CLIENTS, SAVES = 3, 4
# while the project is being replaced
REFUSED = (400, 404, 409)


@dataclass(eq=False)
class Operators:
    """Clients that draw boxes, each on its own frame.

    Attributes:
        acknowledged: when the saving of each acknowledged box began, and its uid, by frame.
        odd: answers that no operator should see.
        steps: twice the number of replacements; odd during one.
    """

    live: Live
    acknowledged: dict[int, list[tuple[float, str]]] = field(default_factory=dict)
    odd: list[str] = field(default_factory=list)
    steps: int = 0
    ended: threading.Event = field(default_factory=threading.Event)

    def draw(self, frame: int) -> None:
        """Draws boxes on a frame until the end."""
        headers, cookies = dict(self.live.client.headers), dict(self.live.client.cookies)
        with httpx.Client(base_url=self.live.url, headers=headers, cookies=cookies, timeout=60) as client:
            while not self.ended.is_set():
                began, steps = time.monotonic(), self.steps
                shown = client.get(f"{ROOM}/frames/{frame}")
                if not self._is_fine(shown):
                    continue
                known = {label["uid"] for label in shown.json()["labels"]}
                new = {"kind": "create", "label": "person", "box": BOX}
                saved = change(client, shown.json()["frame"]["revision"], new, frame=frame)
                if self._is_fine(saved):
                    found = {label["uid"] for label in saved.json()["labels"]} - known
                    if len(found) == 1:
                        self.acknowledged.setdefault(frame, []).append((began, *found))
                    elif steps == self.steps and steps % 2 == 0:  # else the answer shows the other project
                        self.odd.append(f"{len(found)} new boxes")

    def _is_fine(self, answer: httpx.Response) -> bool:
        if answer.status_code not in (200, *REFUSED):
            self.odd.append(f"{answer.status_code} {answer.text}")
        return answer.status_code == 200

    def saved_since(self, mark: float) -> dict[int, set[str]]:
        """Uids of the boxes whose saving began after a time and was acknowledged, by frame."""
        return {
            frame: {uid for began, uid in list(saved) if began > mark} for frame, saved in self.acknowledged.items()
        }


def _moved(room: Path, backup: Path) -> None:
    aside = room.with_name(f"moved-{time.monotonic_ns()}")
    room.rename(aside)
    shutil.copytree(backup, room)


@pytest.mark.parametrize("replace", [replace_folder, replace_database, _moved])
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
            operators.steps += 1
            replace(room, backup)
            operators.steps += 1
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
