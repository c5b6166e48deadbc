"""A workbench server in a separate process (`annotator serve`), and its clients."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from annotator.types.errors import ConfigError

STARTS_WITHIN_S = 60.0
PRESET, LABEL = "people", "person"


class Server:
    """A running server.

    Attributes:
        url: `http://127.0.0.1:PORT`.
    """

    def __init__(self, projects: Path) -> None:
        port = _free_port()
        self.url = f"http://127.0.0.1:{port}"
        arguments = ["-m", "annotator", "serve", "--projects", str(projects), "--port", str(port)]
        self._process = subprocess.Popen(
            [sys.executable, *arguments], env=os.environ, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self._wait()

    def client(self, operator: str = "Ada") -> httpx.Client:
        """A signed-in client that sends the origin of the server's own page."""
        headers = {"Origin": self.url}
        session = httpx.post(f"{self.url}/api/session", json={"operator": operator}, headers=headers, timeout=60.0)
        answered(session)
        return httpx.Client(base_url=self.url, headers=headers, cookies=session.cookies, timeout=60.0)

    def memory_mb(self) -> float:
        """Resident memory of the server's own process, MB (Linux)."""
        fields = Path(f"/proc/{self._process.pid}/statm").read_text().split()
        return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    def kill(self) -> None:
        """Kills the server like a crash (`kill -9`)."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()

    def stop(self) -> None:
        """Stops the server cleanly; kills it after 20 s."""
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self.kill()

    def _wait(self) -> None:
        end = time.monotonic() + STARTS_WITHIN_S
        while time.monotonic() < end and self._process.poll() is None:
            try:
                httpx.get(f"{self.url}/api/session", timeout=5)
                return
            except httpx.TransportError:
                time.sleep(0.05)
        self.kill()
        raise ConfigError(f"the server did not start within {STARTS_WITHIN_S:.0f} s; run `annotator serve` to see why")


@contextmanager
def serving(projects: Path) -> Iterator[Server]:
    """A server that is stopped at the end of the block."""
    server = Server(projects)
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


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
