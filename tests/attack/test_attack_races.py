"""Clients that race: on one box, one name, one job."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

import httpx
from live_server import PATIENCE_S, Live
from room_api import BOX, ROOM, change, state

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
    assert live.context.project("room").frames.count_present() == 10
