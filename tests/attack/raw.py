"""Requests as bytes, since client libraries correct or refuse hostile ones; and what must hold after any of them."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from live_server import PATIENCE_S

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
