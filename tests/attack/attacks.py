"""Requests as bytes, since client libraries correct or refuse hostile ones; and what must hold after any of them."""

from __future__ import annotations

import random
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from live_server import PATIENCE_S
from mortal import End, Mortal
from store_samples import state_of

from annotator.cli.main import main
from annotator.project import Project, open_project

if TYPE_CHECKING:
    from live_server import Live


MOST_GROWTH_MB = 300.0


def send(live: Live, content: bytes) -> tuple[int, bytes]:
    """Sends bytes and reads until the server closes; returns the first answer's status (0: none) and all bytes."""
    host, port = live.url.removeprefix("http://").split(":")
    parts = []
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as raw:
        try:
            raw.sendall(content)
            while part := raw.recv(65536):
                parts.append(part)
        except OSError:
            pass  # the server has closed the connection before it read everything
    answer = b"".join(parts)
    return (int(answer.split(b" ", 2)[1]) if answer.startswith(b"HTTP/1.1 ") else 0), answer


def request(
    live: Live, method: str, target: str | bytes, body: bytes = b"", headers: dict[str, str] | None = None
) -> tuple[int, bytes]:
    """A request of the signed-in operator's page; `target` is sent as it is."""
    given = {
        "Host": live.url.removeprefix("http://"),
        "Origin": live.url,
        "Cookie": live.cookies(),
        "Content-Type": "application/json",
        "Content-Length": str(len(body)),
        "Connection": "close",
        **(headers or {}),
    }
    lines = "".join(f"{name}: {value}\r\n" for name, value in given.items()).encode("latin-1")
    target = target if isinstance(target, bytes) else target.encode("utf-8", "surrogatepass")
    return send(live, method.encode() + b" " + target + b" HTTP/1.1\r\n" + lines + b"\r\n" + body)


def require_alive(live: Live) -> None:
    """The server answers, and the project is as it was."""
    answer = live.client.get("/api/projects/room")
    assert answer.status_code == 200, answer.text
    assert live.client.get("/api/projects/room/frames/1").status_code == 200


def memory_mb() -> float:
    """Resident memory of this process, which the servers of the tests share, MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


@contextmanager
def unharmed(live: Live) -> Iterator[None]:
    """After the block, the server answers and has not grown."""
    require_alive(live)
    before = memory_mb()
    yield
    require_alive(live)
    assert memory_mb() - before < MOST_GROWTH_MB


Labels = dict[str, list[tuple[str, str, tuple[float, ...]]]]
"""By frame: class, state and centre (rounded to micrometres) of each label, sorted."""


def require_sound(path: Path) -> None:
    """`verify --deep` finds nothing; the project opens with its detectors, and its events rebuild to what is stored."""
    assert main(["project", "verify", path.name, "--deep", "--projects", str(path.parent)]) == 0, path
    with open_project(path) as project:
        assert project.problems() == []
        stored = state_of(project)
        project.log.rebuild()
        assert state_of(project) == stored
        for model in project.models.all():
            assert model.path.is_file(), model
            assert model.manifest is None or model.manifest.is_file(), model


def labels_in(path: Path) -> Labels:
    """The labels of a project."""
    with open_project(path) as project:
        return {frame.key: _labels(project, frame.id) for frame in project.frames.of()}


def _labels(project: Project, frame: int) -> list[tuple[str, str, tuple[float, ...]]]:
    found = project.labels.of_frame(frame)
    return sorted((each.label, each.state.value, tuple(each.box.center_m.round(6).tolist())) for each in found)


def content_of(folder: Path) -> dict[str, bytes]:
    """All files of a folder, by relative path."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


class Killer:
    """Kills a command at moments that are spread over what it writes."""

    def __init__(self, mortal: Mortal, template: Path, folder: Path, times: int, chance: random.Random) -> None:
        self.mortal, self.template, self.folder, self.times, self.chance = mortal, template, folder, times, chance
        self.killed = 0

    def fresh(self) -> Path:
        """A new copy of the template."""
        shutil.rmtree(self.folder, ignore_errors=True)
        return Path(shutil.copytree(self.template, self.folder))

    def whole(self, *words: str | Path) -> End:
        """Runs a command to its end, which must succeed."""
        end = self.mortal.run(*words)
        assert end.code == 0, end
        return end

    def kills(self, *words: str | Path, done: Callable[[], object] = lambda: None) -> Iterator[End]:
        """Kills the command once per iteration, on a fresh copy; `done` undoes what a whole run wrote elsewhere.

        At least half the kills must hit: not every run of a command writes as often.
        """
        # the first run reads files that later ones find in memory
        for _ in range(2):
            self.fresh()
            moments = self.whole(*words).moments
            done()
        for number in range(self.times):
            self.fresh()
            moment = 1 + int(moments * (number + self.chance.random()) / self.times)
            end = self.mortal.run(*words, kill_at=moment)
            assert end.code in (0, -9), end
            self.killed += end.was_killed
            yield end
        assert self.killed * 2 >= self.times, f"only {self.killed} of {self.times} kills came before the end"
