"""A workbench server in a separate process (`annotator serve`), and its clients."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from annotator.types.errors import ConfigError

PRESET, LABEL = "people", "person"


class Server:
    """A running server.

    Attributes:
        url: `http://127.0.0.1:PORT`.
        link: the URL with the token.
        port, pid: of the server, and of its process.
    """

    def __init__(self, projects: Path, log: Path | None = None) -> None:
        arguments = ["-m", "annotator", "serve", "--projects", str(projects), "--port", "0"]
        with (log or Path(os.devnull)).open("wb") as errors:
            # a session of its own, as in its own terminal: Linux shares the processor among sessions, and in practice a
            # benchmark's clients are on other computers
            self._process = subprocess.Popen(
                [sys.executable, *arguments],
                env=os.environ,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                start_new_session=True,
            )
        assert self._process.stdout is not None
        printed = re.search(r"(http://[^/]+)/\S+", self._process.stdout.readline())
        if printed is None:
            self.kill()
            raise ConfigError("the server did not start; run `annotator serve` to see why")
        self.link, self.url = printed.group(), printed.group(1)
        self.port, self.pid = int(self.url.rpartition(":")[2]), self._process.pid

    def client(self, operator: str | None = "Ada") -> httpx.Client:
        """A client with the token's cookie and the origin of the server's own page; signed in, except as None."""
        options: dict[str, Any] = {"base_url": self.url, "headers": {"Origin": self.url}, "timeout": 60.0}
        with httpx.Client(**options) as opened:
            opened.get(self.link)
            if operator is not None:
                answered(opened.post("/api/session", json={"operator": operator}))
            return httpx.Client(**options, cookies=opened.cookies)

    def memory_mb(self) -> float:
        """Resident memory of the server's own process, MB (Linux)."""
        fields = Path(f"/proc/{self._process.pid}/statm").read_text().split()
        return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    def kill(self) -> None:
        """Kills the server like a crash (`kill -9`)."""
        self._process.send_signal(signal.SIGKILL)
        self._ended(None)

    def stop(self) -> None:
        """Stops the server cleanly; kills it after 20 s."""
        self._process.terminate()
        try:
            self._ended(20.0)
        except subprocess.TimeoutExpired:
            self.kill()

    def _ended(self, timeout_s: float | None) -> None:
        self._process.wait(timeout_s)
        assert self._process.stdout is not None
        self._process.stdout.close()


@contextmanager
def serving(projects: Path, log: Path | None = None) -> Iterator[Server]:
    """A server that is stopped at the end of the block; `log` gets its standard error."""
    server = Server(projects, log)
    try:
        yield server
    finally:
        server.stop()


def answered(response: httpx.Response) -> Any:
    """The JSON of a response; None if it is empty.

    Raises:
        ConfigError: the response is an error.
    """
    if response.is_error:
        raise ConfigError(f"{response.request.method} {response.request.url.path}: {response.text[:300]}")
    return response.json() if response.content else None


def percentile(values: Sequence[float], percent: float) -> float:
    """The percentile of the values, by the nearest-rank method; NaN without values."""
    if not values:
        return float("nan")
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, -(-len(ordered) * int(percent) // 100) - 1))]


def make_people(folder: Path, frames: int, width_px: int, height_px: int) -> Path:
    """Generates an RGB-D recording of people."""
    from annotator.synthetic import write_generated

    write_generated(folder, PRESET, frames, 0, width_px, height_px)
    return folder


def make_project(projects: Path, name: str, classes: Sequence[str], recordings: Sequence[Path]) -> None:
    """Creates a project with these recordings; their boxes become labels."""
    from annotator.project import create_project
    from annotator.recordings import open_recording
    from annotator.workflows.add_recordings import register_recording

    with create_project(projects, name, classes) as project:
        for path in recordings:
            register_recording(project, open_recording(path))
