"""Clients that race: on one box, one name, one job."""

from __future__ import annotations

import random
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from live_server import PATIENCE_S, Live, wait_until
from room_api import BOX, ROOM, change, state
from store_samples import replace_database, replace_folder

from annotator.project import open_project

RACERS = 10
ROUNDS = 15


def _racing(live: Live, race: Callable[[httpx.Client, int], None]) -> None:
    """Lets `race(client, number)` run for all racers at once, each signed in with its own name."""
    barrier = threading.Barrier(RACERS)
    failures: list[BaseException] = []
    headers, cookies = {"Origin": live.url}, dict(live.client.cookies)

    def run(number: int) -> None:
        try:
            with httpx.Client(base_url=live.url, headers=headers, cookies=cookies, timeout=PATIENCE_S) as client:
                client.cookies.delete("annotator_operator")
                assert client.post("/api/session", json={"operator": f"racer {number}"}).status_code == 200
                barrier.wait(PATIENCE_S)
                race(client, number)
        except BaseException as error:
            failures.append(error)
            barrier.abort()

    threads = [threading.Thread(target=run, args=(number,)) for number in range(RACERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]


def test_of_ten_changes_of_one_box_on_one_revision_one_is_stored(live: Live) -> None:
    made = change(live.client, 0, {"kind": "create", "label": "person", "box": BOX, "track_id": 1}).json()
    (uid,) = (label["uid"] for label in made["labels"])
    lock, barrier = threading.Lock(), threading.Barrier(RACERS)
    won: Counter[int] = Counter()
    answers: list[int] = []

    def race(client: httpx.Client, number: int) -> None:
        for round_ in range(ROUNDS):
            revision = state(client)["frame"]["revision"]
            barrier.wait(PATIENCE_S)
            box = {**BOX, "center": [number / 10, round_ / 100, 3.0]}
            edit = {"kind": "edit", "uid": uid, "label": "person", "box": box, "track_id": number}
            answer = change(client, revision, edit)
            with lock:
                answers.append(answer.status_code)
                if answer.status_code == 200:
                    won[round_] += 1
                    mine = answer.json()["labels"][0]
                    assert (mine["track_id"], mine["box"]["center"]) == (number, box["center"])
            barrier.wait(PATIENCE_S)

    _racing(live, race)
    assert Counter(answers) == {200: ROUNDS, 409: ROUNDS * (RACERS - 1)}
    assert set(won.values()) == {1}
    assert state(live.client)["frame"]["revision"] == made["frame"]["revision"] + ROUNDS


def test_undo_during_a_race_reverts_own_work_only(live: Live) -> None:
    lock = threading.Lock()
    kept: set[str] = set()

    def race(client: httpx.Client, number: int) -> None:
        mine: list[str] = []
        for _ in range(6):
            while True:
                before = state(client)
                answer = change(client, before["frame"]["revision"], {"kind": "create", "label": "person", "box": BOX})
                if answer.status_code == 200:
                    break
                assert answer.status_code == 409
            old = {label["uid"] for label in before["labels"]}
            mine += [label["uid"] for label in answer.json()["labels"] if label["uid"] not in old]
        for _ in range(3):
            assert client.post(f"{ROOM}/undo", json={}).status_code == 200
        with lock:
            kept.update(mine[:3])

    _racing(live, race)
    assert {label["uid"] for label in state(live.client)["labels"]} == kept
    assert len(kept) == 3 * RACERS


def test_classes_and_recordings_that_ten_change_at_once_stay_whole(live: Live) -> None:
    def race(client: httpx.Client, number: int) -> None:
        for _ in range(5):
            names = ["person", f"class{number}"]
            added = client.post(f"{ROOM}/recordings", json={"path": "once_generated/hands", "labels": False})
            assert added.status_code == 200 or "is in the project already" in added.text
            answers: list[Any] = [client.patch(ROOM, json={"classes": names}), client.get(ROOM)]
            assert all(answer.status_code == 200 for answer in answers), [answer.text for answer in answers]
            assert len(answers[1].json()["classes"]) == 2

    _racing(live, race)
    found = live.client.get(ROOM).json()
    assert [recording["name"] for recording in found["recordings"]] == ["people", "hands"]
    assert live.client.get(f"{ROOM}/frames").json()["total"] == 10


# --- projects are replaced on disk while operators save ---------------------------------------------------------------

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


def test_a_project_of_one_name_is_created_once(live: Live) -> None:
    statuses: list[int] = []

    def race(client: httpx.Client, number: int) -> None:
        answer = client.post("/api/projects", json={"name": "wanted", "classes": [f"class{number}"]})
        statuses.append(answer.status_code)

    _racing(live, race)
    assert statuses.count(201) == 1 and len(statuses) == RACERS
    assert all(400 <= status < 500 for status in statuses if status != 201)
    assert [path.name for path in live.settings.projects_root.iterdir() if "wanted" in path.name] == ["wanted"]
