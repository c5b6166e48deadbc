"""Times a backup of a large project while clients write to it, and checks that it restores to the state of one moment.

python -m benchmarks.backup [--frames 10000] [--labels 30000] [--clients 5] [--json]
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import httpx
import numpy as np
import tyro

from annotator.project import FramePart, Project, WriteContext, create_project, open_project
from annotator.project.log.event_types import LabelCreated
from annotator.project.log.records import BoxRecord
from annotator.recordings import open_recording
from annotator.types import BoxKind, OrientedBox, Source
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from benchmarks.report import Table, finish, guarded
from benchmarks.workbench_server import answered, make_people, serving

NAME, LABEL = "long", "person"
BOX = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "quaternion": [1.0, 0.0, 0.0, 0.0]}
_BATCH = 500


@dataclass
class Arguments:
    """Back up a generated project while a server writes to it, restore it, and compare."""

    frames: int = 10_000
    """Number of frames of the recording."""
    labels: int = 30_000
    """Number of 3D labels."""
    views: int = 2_000
    """Number of labelled pseudo-views."""
    clients: int = 5
    """Number of clients that save one change after the other."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass
class Clients:
    """Clients that write until they are stopped.

    Attributes:
        errors: answers other than 200, and lost connections.
        seconds: duration of each save, with the time when it began.
    """

    errors: list[str] = field(default_factory=list)
    seconds: list[tuple[float, float]] = field(default_factory=list)
    stopped: threading.Event = field(default_factory=threading.Event)

    def write(self, client: httpx.Client, frame: int) -> None:
        """Adds boxes to a frame and deletes them again."""
        try:
            state = answered(client.get(f"/api/projects/{NAME}/frames/{frame}"))
            while not self.stopped.is_set():
                begin = time.perf_counter()
                answer = client.post(f"/api/projects/{NAME}/frames/{frame}/changes", json=_change(state))
                self.seconds.append((begin, time.perf_counter() - begin))
                if answer.status_code != 200:
                    self.errors.append(answer.text)
                    return
                state = answer.json()
        except (httpx.TransportError, ConfigError) as error:
            self.errors.append(str(error))


def _change(state: dict[str, Any]) -> dict[str, Any]:
    revision, labels = state["frame"]["revision"], state["labels"]
    change = {"kind": "create", "label": LABEL, "box": BOX}
    if len(labels) > 5:
        change = {"kind": "delete", "uid": labels[-1]["uid"]}
    return {"revision": revision, "changes": [change], "effort": {"actions": 1, "seconds": 1.0}}


def fill(project: Project, frames: int, labels: int, views: int) -> None:
    """Adds one recording with reviewed labels, and pseudo-views with boxes."""
    keys = [f"{n:06d}" for n in range(frames)]
    recording = project.recordings.add(project.path.parent / "recording", "rgbd", "long", keys, True)
    stored = project.frames.of([recording.id])
    shares = [labels * (n + 1) // frames - labels * n // frames for n in range(frames)]
    parts = [
        FramePart(frame.id, [_label(n, k) for k in range(share)], WriteContext(0, "Ada", Source.MANUAL))
        for n, (frame, share) in enumerate(zip(stored, shares, strict=True))
        if share
    ]
    for first in range(0, len(parts), _BATCH):
        project.log.append_to_frames(parts[first : first + _BATCH])
    rng = np.random.default_rng(0)
    for _ in range(views):
        picture = rng.integers(0, 255, (60, 60, 3), np.uint8)
        project.boxes.set_on_view(project.views.store(picture), [], BoxKind.BOX, WriteContext(0, "Ada", Source.MANUAL))


def _label(frame: int, number: int) -> LabelCreated:
    box = OrientedBox.from_parts(np.array([2.0 * number, 0.1, 3.0]), np.eye(3), np.array([1.0, 0.7, 0.4]))
    return LabelCreated(uid=f"{frame}-{number}", label=LABEL, box=BoxRecord.of(box))


@contextmanager
def _writing(url_client: Any, clients: Clients, number: int) -> Iterator[None]:
    """Clients that write within the block, each to its own frame."""
    threads = [threading.Thread(target=clients.write, args=(url_client(f"client {n}"), n + 1)) for n in range(number)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        clients.stopped.set()
        for thread in threads:
            thread.join()


def run(args: Arguments, folder: Path) -> dict[str, float | int | bool]:
    """Seconds, sizes and checks.

    Raises:
        ConfigError: a number out of its range, or a command that failed.
    """
    if args.frames < args.clients or args.clients < 1 or args.labels < 0:
        raise ConfigError(f"--clients must be 1 to --frames ({args.frames}), --labels 0 or more")
    with create_project(folder, NAME, (LABEL,)) as project:
        # the page's requests read the frames that the clients change, so these exist
        register_recording(project, open_recording(make_people(folder / "people", args.clients, 160, 120)))
        fill(project, args.frames - args.clients, args.labels, args.views)
    clients, file = Clients(), folder / "copy.zip"
    with serving(folder) as server, _writing(server.client, clients, args.clients):
        _wait_for(clients, args.clients * 5)
        begin = time.perf_counter()
        _annotator("backup", NAME, str(file), "--projects", str(folder))
        end = time.perf_counter()
        _wait_for(clients, len(clients.seconds) + args.clients)
    during = [seconds for began, seconds in clients.seconds if begin <= began <= end]
    restore = _seconds("restore", str(file), "restored", "--projects", str(folder))
    verify = _seconds("verify", "restored", "--deep", "--projects", str(folder))
    with open_project(folder / NAME) as live, open_project(folder / "restored") as restored:
        last = restored.log.last()
        is_prefix = list(restored.log.since()) == [event for event in live.log.since() if event.id <= last]
        events = live.log.last()
    return {
        "backup_s": end - begin,
        "restore_s": restore,
        "verify_deep_s": verify,
        "file_mib": file.stat().st_size / 2**20,
        "database_mib": (folder / "restored" / "project.db").stat().st_size / 2**20,
        "saves_during_backup": len(during),
        "save_during_p95_s": float(np.percentile(during, 95)) if during else 0.0,
        "save_p95_s": float(np.percentile([seconds for _, seconds in clients.seconds], 95)),
        "client_errors": len(clients.errors),
        "events_restored": last,
        "events_in_the_end": events,
        "is_state_of_one_moment": is_prefix,
    }


def _wait_for(clients: Clients, saves: int) -> None:
    while len(clients.seconds) < saves and not clients.errors:
        time.sleep(0.01)


def _seconds(*words: str) -> float:
    begin = time.perf_counter()
    _annotator(*words)
    return time.perf_counter() - begin


def _annotator(*words: str) -> None:
    command = [sys.executable, "-m", "annotator", "project", *words]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ)
    if done.returncode:
        raise ConfigError(f"annotator project {words[0]} failed: {done.stdout}{done.stderr}")


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    with TemporaryDirectory() as temporary:
        result = run(args, Path(temporary))
    table = Table("measure", "value")
    for name, value in result.items():
        table.add(name, value)
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
