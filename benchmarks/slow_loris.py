"""How a server serves those who have signed in, while strangers hold connections open with half-sent requests.

python -m benchmarks.slow_loris [--connections 2000] [--seconds 30] [--json]

A second process opens the connections without a token, sends half of the headers, and a line more each second; a
connection that is closed is opened again at once. Once all are open, one client with the token's cookie reads over a
connection that stays open, one over a new connection each time, and one saves. Only the loopback address is used.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import resource
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import httpx
import tyro

from annotator.types.errors import ConfigError
from benchmarks.report import Table, finish, guarded
from benchmarks.workbench_edits import box_at
from benchmarks.workbench_server import LABEL, Server, answered, make_people, make_project, percentile, serving

HEAD = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n"
LINE_EVERY_S = 1.0
PAUSE_S = 0.02
FRAME = 1


@dataclass
class Arguments:
    """Measure waiting times under half-sent requests."""

    connections: int = 2000
    """Number of connections that the strangers hold open."""
    seconds: float = 30.0
    """Duration of the attack."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def attack(port: int, connections: int, seconds: float, opened: Any) -> None:
    """Holds connections open in this process; `opened` counts how often one was opened."""
    # real strangers use other computers; so this process is at least not scheduled together with the server
    os.setsid()
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    wanted = connections + 64
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))

    async def hold() -> None:
        while True:
            # closed or refused: again
            with suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                opened.value += 1
                writer.write(HEAD)
                while not writer.is_closing():
                    await asyncio.sleep(LINE_EVERY_S)
                    writer.write(b"X-Slow: yes\r\n")
                    await writer.drain()
            await asyncio.sleep(0)

    async def all_of_them() -> None:
        tasks = [asyncio.create_task(hold()) for _ in range(connections)]
        while opened.value < connections:
            await asyncio.sleep(LINE_EVERY_S)
        await asyncio.sleep(seconds)
        for task in tasks:
            task.cancel()

    asyncio.run(all_of_them())


def measure(connections: int, seconds: float, folder: Path) -> dict[str, Any]:
    """The waiting times of clients with the cookie, seconds, and what the attack cost the server."""
    make_project(folder / "projects", "room", (LABEL,), [make_people(folder / "people", 2, 160, 120)])
    log = folder / "stderr.txt"
    with serving(folder / "projects", log) as server:
        context = multiprocessing.get_context("spawn")
        opened = context.Value("q", 0)
        attacker = context.Process(target=attack, args=(server.port, connections, seconds, opened))
        attacker.start()
        while opened.value < connections and attacker.is_alive():
            time.sleep(0.05)
        if not attacker.is_alive():
            raise ConfigError("the connections could not be opened; raise the limit of open files (ulimit -n)")
        works = {"open connection": _read, "new connections": _connect, "saves": _save}
        began, began_cpu = time.monotonic(), _processor_s(server)
        with ThreadPoolExecutor(len(works)) as pool:
            runs = {name: pool.submit(_repeat, server, work, began + seconds) for name, work in works.items()}
        waits = {name: run.result() for name, run in runs.items()}
        cores = (_processor_s(server) - began_cpu) / (time.monotonic() - began)
        attacker.join()
        logs = [log, *(folder / "projects/.jobs").glob("server.log*")]
        return {
            "connections": connections,
            "opened": opened.value,
            "waits": {
                name: {"requests": len(times), "p50_s": percentile(times, 50), "p95_s": percentile(times, 95)}
                for name, times in waits.items()
            },
            "p95_s": max(percentile(times, 95) for times in waits.values()),
            "cores": cores,
            "log_bytes": sum(path.stat().st_size for path in logs),
        }


def _processor_s(server: Server) -> float:
    """Processor time of the server until now (Linux)."""
    user, system = Path(f"/proc/{server.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def _repeat(server: Server, work: Callable[[httpx.Client, int], None], end: float) -> list[float]:
    times = list[float]()
    with server.client() as client:
        while not times or time.monotonic() < end:
            began = time.monotonic()
            work(client, len(times))
            times.append(time.monotonic() - began)
            time.sleep(PAUSE_S)
    return times


def _read(client: httpx.Client, _: int) -> None:
    answered(client.get("/api/projects/room"))


def _connect(client: httpx.Client, _: int) -> None:
    # without `verify`, httpx reads all certificates of this computer each time
    url, cookies = client.base_url.join("/api/session"), client.cookies
    answered(httpx.get(url, cookies=cookies, timeout=60.0, verify=False))


def _save(client: httpx.Client, revision: int) -> None:
    # the frame is not asked for, which would load the detectors; they take long and are not measured here
    create = {"kind": "create", "label": LABEL, "box": box_at(0.0), "track_id": None}
    body = {"revision": revision, "changes": [create], "effort": {"actions": 1, "seconds": 0.1}}
    answered(client.post(f"/api/projects/room/frames/{FRAME}/changes", json=body))


def main() -> None:
    """Prints the waiting times."""
    arguments = tyro.cli(Arguments, description=__doc__)
    if arguments.connections < 1 or arguments.seconds <= 0:
        raise ConfigError("--connections and --seconds must be more than 0")
    with TemporaryDirectory() as folder:
        result = measure(arguments.connections, arguments.seconds, Path(folder))
    waits = Table("client", "requests", "median s", "95 % s")
    for name, wait in result["waits"].items():
        waits.add(name, *wait.values())
    costs = Table("connections", "opened", "cores", "log bytes")
    costs.add(*(result[name] for name in ("connections", "opened", "cores", "log_bytes")))
    finish(result, arguments.json, waits, costs)


if __name__ == "__main__":
    guarded(main)
