"""Events to all open pages. `Hub.send` may be called from any thread."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

Message = Mapping[str, Any]
"""One event as JSON; its "type" says what else is in it (docs/architecture.md lists them)."""

# A page that is so far behind has gone, or its line is too slow: it is dropped and will connect again.
QUEUE = 256


@dataclass(eq=False)
class Client:
    """One open page.

    Attributes:
        project: events of other projects do not concern it.
        operator: who looks at it.
        frame: the frame that it has open.
        workbenches: ids of the workbenches that it shows.
        queue: events that wait to be sent; None = the end.
    """

    project: str | None
    operator: str
    queue: asyncio.Queue[Message | None] = field(default_factory=lambda: asyncio.Queue(QUEUE + 1))
    frame: int | None = None
    workbenches: set[str] = field(default_factory=set)
    dropped: bool = False


class Hub:
    """Knows the open pages and what each has open; carries events to them in order."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._clients: dict[Client, asyncio.AbstractEventLoop] = {}
        self._announced: dict[tuple[str, int], int] = {}

    # --- pages come and go (from the event loop) -------------------------------------------------------------------

    def join(self, client: Client) -> None:
        """Adds a page, and tells it who has what open; must be called where its socket is served."""
        with self._lock:
            self._clients[client] = asyncio.get_running_loop()
        if client.project is not None:
            _put(client, self._presence_event(client.project))

    def leave(self, client: Client) -> None:
        """Forgets a page."""
        with self._lock:
            self._clients.pop(client, None)
        if client.frame is not None:
            self._tell_presence(client.project)

    def opened(self, client: Client, project: str | None, frame: int | None) -> None:
        """A page has opened a frame (None: closed it)."""
        before = client.project
        with self._lock:
            client.project, client.frame = project or before, frame
        for name in {before, client.project}:
            self._tell_presence(name)

    def shows(self, client: Client, workbench: str) -> None:
        """A page shows a workbench's viewport: events of that workbench go to it alone."""
        with self._lock:
            client.workbenches.add(workbench)

    # --- what is known (any thread) --------------------------------------------------------------------------------

    def presence(self, project: str | None) -> dict[str, list[str]]:
        """Who has which frame of a project open: frame id -> names."""
        found: dict[str, list[str]] = {}
        for client in self.clients():
            if client.project == project and client.frame is not None:
                names = found.setdefault(str(client.frame), [])
                if client.operator not in names:
                    names.append(client.operator)
        return {frame: sorted(names) for frame, names in found.items()}

    def open_by(self, project: str, frame: int, besides: str) -> list[str]:
        """The names of others who have a frame open."""
        return [name for name in self.presence(project).get(str(frame), []) if name != besides]

    def projects(self) -> set[str]:
        """Projects that some page has open."""
        return {client.project for client in self.clients() if client.project is not None}

    def workbenches(self) -> set[str]:
        """Workbenches that some page shows."""
        return {workbench for client in self.clients() for workbench in client.workbenches}

    def clients(self) -> list[Client]:
        """The open pages."""
        with self._lock:
            return list(self._clients)

    # --- events (any thread) ---------------------------------------------------------------------------------------

    def frame_changed(self, project: str, frame_id: int, revision: int, operator: str) -> None:
        """Says that a frame has a new revision; once, whoever else noticed it."""
        with self._lock:
            if self._announced.get((project, frame_id), -1) >= revision:
                return
            self._announced[project, frame_id] = revision
        self.send({"type": "frame", "project": project, "frame": frame_id, "revision": revision, "operator": operator})

    def forget(self, project: str) -> None:
        """A project has been replaced by another of the same name: its frames begin anew."""
        with self._lock:
            self._announced = {place: revision for place, revision in self._announced.items() if place[0] != project}

    def send(self, message: Message) -> None:
        """Sends an event to those whom it concerns: the pages of its "project" or "workbench", else all of them.

        Never waits, and calls from one thread arrive in their order.
        """
        with self._lock:
            chosen = [(client, loop) for client, loop in self._clients.items() if _concerns(client, message)]
            # within the lock, so that two threads' events reach all pages in the same order
            for client, loop in chosen:
                _hand_over(client, loop, message)

    def close(self) -> None:
        """Ends every page's socket."""
        with self._lock:
            for client, loop in self._clients.items():
                _call(loop, _end, client)

    def _tell_presence(self, project: str | None) -> None:
        if project is not None:
            self.send(self._presence_event(project))

    def _presence_event(self, project: str) -> Message:
        return {"type": "presence", "project": project, "frames": self.presence(project)}


def _concerns(client: Client, message: Message) -> bool:
    project, workbench = message.get("project"), message.get("workbench")
    return (project is None or project == client.project) and (workbench is None or workbench in client.workbenches)


def _hand_over(client: Client, loop: asyncio.AbstractEventLoop, message: Message) -> None:
    _call(loop, _put, client, message)


def _call(loop: asyncio.AbstractEventLoop, function: Any, *arguments: Any) -> None:
    # a loop that has ended has no pages any more
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, *arguments)


def _put(client: Client, message: Message) -> None:
    if client.dropped:
        return
    if client.queue.qsize() >= QUEUE:
        _end(client)
        return
    client.queue.put_nowait(message)


def _end(client: Client) -> None:
    """Lets the socket end at once: what still waits is not sent."""
    client.dropped = True
    for _ in _drained(client.queue):
        pass
    client.queue.put_nowait(None)


def _drained(queue: asyncio.Queue[Message | None]) -> Iterable[Message | None]:
    while not queue.empty():
        yield queue.get_nowait()
