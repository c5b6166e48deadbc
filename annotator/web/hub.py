"""Events to all open pages, and what tells them of changes in a project. Thread-safe."""

from __future__ import annotations

import asyncio
import json
import threading
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

from annotator.project import Project

Message = Mapping[str, Any]
"""One event as JSON; "type" determines its further fields (docs/architecture.md lists them)."""

# Maximum number of unsent events per page; a page that exceeds it is disconnected, and connects again.
QUEUE = 256


@dataclass(eq=False)
class Client:
    """One open page.

    Attributes:
        project: it receives no events of other projects.
        queue: unsent events as JSON texts; None = the end.
        dropped: True once it has been disconnected for exceeding the queue.
    """

    project: str | None
    operator: str
    queue: asyncio.Queue[str | None] = field(default_factory=lambda: asyncio.Queue(QUEUE + 1))
    frame: int | None = None
    dropped: bool = False


class Hub:
    """Keeps track of the open pages and their frames, and sends events to them in order."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._clients: dict[Client, asyncio.AbstractEventLoop] = {}

    # --- pages connect and disconnect (event loop) -----------------------------------------------------------------

    def join(self, client: Client) -> None:
        """Adds a page, and sends it the presence event; must be called in the event loop of its socket."""
        with self._lock:
            self._clients[client] = asyncio.get_running_loop()
        if client.project is not None:
            _put([client], _text(self._presence_event(client.project)))

    def leave(self, client: Client) -> None:
        with self._lock:
            self._clients.pop(client, None)
        if client.frame is not None:
            self._send_presence(client.project)

    def set_frame(self, client: Client, frame: int | None) -> None:
        """Records the frame that a page shows; None = no frame."""
        client.frame = frame
        self._send_presence(client.project)

    # --- the state of the pages (any thread) --------------------------------------------------------------------------

    def presence(self, project: str | None) -> dict[str, list[str]]:
        """Frame id -> names of the operators who have this frame of the project open."""
        by_frame: dict[str, list[str]] = {}
        for client in self.clients():
            if client.project == project and client.frame is not None:
                names = by_frame.setdefault(str(client.frame), [])
                if client.operator not in names:
                    names.append(client.operator)
        return {frame: sorted(names) for frame, names in by_frame.items()}

    def open_by(self, project: str, frame: int, besides: str) -> list[str]:
        """The names of the operators other than `besides` who have a frame open."""
        return [name for name in self.presence(project).get(str(frame), []) if name != besides]

    def projects(self) -> set[str]:
        """The projects that at least one page has open."""
        return {client.project for client in self.clients() if client.project is not None}

    def clients(self) -> list[Client]:
        """The open pages."""
        with self._lock:
            return list(self._clients)

    # --- events (any thread) ---------------------------------------------------------------------------------------

    def send(self, message: Message, to: str | None = None) -> None:
        """Sends an event to the pages of its "project" if it has one, of an operator or (None) of all.

        Never blocks; keeps the order of calls.
        """
        project = message.get("project")
        text = _text(message)
        with self._lock:
            concerned = defaultdict[asyncio.AbstractEventLoop, list[Client]](list)
            for client, loop in self._clients.items():
                if project in (None, client.project) and to in (None, client.operator):
                    concerned[loop].append(client)
            # within the lock, so that concurrent events reach all pages in the same order; one call for all pages, as
            # each wakes the event loop
            for loop, clients in concerned.items():
                _call(loop, _put, clients, text)

    def close(self) -> None:
        """Closes every page's socket."""
        with self._lock:
            for client, loop in self._clients.items():
                _call(loop, _end, client)

    def _send_presence(self, project: str | None) -> None:
        if project is not None:
            self.send(self._presence_event(project))

    def _presence_event(self, project: str) -> Message:
        return {"type": "presence", "project": project, "frames": self.presence(project)}


@dataclass(eq=False)
class _Told:
    """What the pages know of a project: its newest event, who has removed each of its recordings, and the versions of
    its still objects."""

    event: int
    removed_by: dict[int, str | None]
    stills: dict[int, tuple[int, int]]
    lock: threading.Lock = field(default_factory=threading.Lock)


class Announcer:
    """Sends the pages of a project an event for each changed frame, adjusted recording, rig whose still objects have
    changed, change of the classes, and added, removed or restored recording, whoever has made it."""

    def __init__(self, hub: Hub) -> None:
        self._hub, self._lock = hub, threading.Lock()
        # not by name: another project of the same name begins anew
        self._told = WeakKeyDictionary[Project, _Told]()

    def begin(self, project: Project) -> None:
        """To be called before a page of the project joins, which then reads what there is, and is told what comes."""
        now = _Told(project.log.last(), project.recordings.removed_by(), project.stills.versions())
        with self._lock:
            if project not in self._told or project.path.name not in self._hub.projects():
                self._told[project] = now

    def announce(self, project: Project, operator: str = "") -> None:
        """Sends the events since the last call. `operator`: who has added or restored a recording, if known."""
        with self._lock:
            told = self._told.get(project)
        if told is None or project.path.name not in self._hub.projects():
            return
        # in order, and once: both the thread of a change and the one that watches come here
        with told.lock:
            newest, changed = project.log.changed_frames(told.event)
            stills = project.stills.versions() if changed else told.stills
            adjusted = project.adjustments.since(told.event) if changed else ()
            classes = project.class_changes(told.event) if newest > told.event else []
            removed_by = project.recordings.removed_by()
            for frame in changed:
                self._send(project, "frame", frame.author, frame=frame.frame_id, revision=frame.revision)
            for recording, event, author in adjusted:
                self._send(project, "adjusted", author, recording=recording, adjusted=event)
            for recording, remover in sorted(removed_by.items()):
                if (remover is None) != (told.removed_by.get(recording, "") is None):
                    self._send(project, "recordings", remover or operator, recording=recording)
            for made in classes:
                self._send(project, "classes", made.author, renamed=dict(made.renamed))
            if stills != told.stills:
                self.tell_still(project)
            told.event, told.removed_by, told.stills = newest, removed_by, stills

    def tell_still(self, project: Project) -> None:
        """Sends that frames show other objects that stand still, or show them elsewhere."""
        self._hub.send({"type": "still", "project": project.path.name})

    def _send(self, project: Project, kind: str, operator: str, **fields: object) -> None:
        self._hub.send({"type": kind, "project": project.path.name, "operator": operator, **fields})


def _call(loop: asyncio.AbstractEventLoop, function: Any, *arguments: Any) -> None:
    # the pages of a closed loop are gone
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, *arguments)


def _text(message: Message) -> str:
    return json.dumps(message, separators=(",", ":"), ensure_ascii=False)


def _put(clients: Iterable[Client], text: str) -> None:
    for client in clients:
        if client.dropped:
            continue
        if client.queue.qsize() >= QUEUE:
            _end(client)
        else:
            client.queue.put_nowait(text)


def _end(client: Client) -> None:
    """Discards unsent events and ends the socket."""
    client.dropped = True
    while not client.queue.empty():
        client.queue.get_nowait()
    client.queue.put_nowait(None)
