"""Events to all open pages. `Hub.send` is thread-safe."""

from __future__ import annotations

import asyncio
import json
import threading
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

from annotator.project import Project, Receipt

Message = Mapping[str, Any]
"""One event as JSON; "type" determines its further fields (docs/architecture.md lists them)."""

# Maximum number of unsent events per page; a page that exceeds it is disconnected, and connects again.
QUEUE = 256


@dataclass(eq=False)
class Client:
    """One open page.

    Attributes:
        project: it receives no events of other projects.
        since: id of the project's newest event when the page connected; it receives all later ones.
        queue: unsent events as JSON texts; None = the end.
        dropped: True once it has been disconnected for exceeding the queue.
    """

    project: str | None
    operator: str
    since: int = 0
    queue: asyncio.Queue[str | None] = field(default_factory=lambda: asyncio.Queue(QUEUE + 1))
    frame: int | None = None
    dropped: bool = False


class Hub:
    """Keeps track of the open pages and their frames, and sends events to them in order."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._clients: dict[Client, asyncio.AbstractEventLoop] = {}
        # not by name: another project of the same name begins anew
        self._told = WeakKeyDictionary[Project, dict[tuple[str, int], int]]()
        self._recordings = WeakKeyDictionary[Project, dict[int, str | None]]()

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

    def set_frame(self, client: Client, project: str | None, frame: int | None) -> None:
        """Records the frame that a page shows; None = no frame."""
        before = client.project
        with self._lock:
            client.project, client.frame = project or before, frame
        for name in {before, client.project}:
            self._send_presence(name)

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

    def projects(self) -> dict[str, int]:
        """Projects that at least one page has open -> the least `since` of these pages."""
        least: dict[str, int] = {}
        for client in self.clients():
            if client.project is not None:
                least[client.project] = min(client.since, least.get(client.project, client.since))
        return least

    def clients(self) -> list[Client]:
        """The open pages."""
        with self._lock:
            return list(self._clients)

    # --- events (any thread) ---------------------------------------------------------------------------------------

    def frame_changed(self, project: Project, frame_id: int, revision: int, operator: str) -> None:
        """Sends the event for a new revision of a frame, unless it was sent before."""
        if self._is_new(project, ("frame", frame_id), revision):
            event = {"type": "frame", "project": project.path.name, "frame": frame_id, "revision": revision}
            self.send({**event, "operator": operator})

    def frames_changed(self, project: Project, changed: Iterable[tuple[int, Receipt]], operator: str) -> None:
        """Sends the events for new revisions of frames."""
        for frame_id, receipt in changed:
            self.frame_changed(project, frame_id, receipt.revision, operator)

    def recording_adjusted(self, project: Project, recording: int, adjusted: int, operator: str) -> None:
        """Sends the event for a new up direction or calibration of a recording, unless it was sent before."""
        if self._is_new(project, ("adjusted", recording), adjusted):
            event = {"type": "adjusted", "project": project.path.name, "recording": recording, "adjusted": adjusted}
            self.send({**event, "operator": operator})

    def _is_new(self, project: Project, what: tuple[str, int], number: int) -> bool:
        """Whether pages were not told of this number of something, or of a newer one."""
        with self._lock:
            told = self._told.setdefault(project, {})
            is_new = number > told.get(what, -1)
            if is_new:
                told[what] = number
        return is_new

    def recordings_are(self, project: Project, recordings: Mapping[int, str | None], operator: str = "") -> None:
        """Takes a project's recordings; sends an event for each one that was added, removed or restored.

        Args:
            recordings: by id, who has removed it; None if it is in the project. So an event names who has removed a
                recording, whichever thread sees it first.
            operator: who has added or restored one; "" if that is not known.
        """
        now = dict(recordings)
        with self._lock:
            before = self._recordings.get(project, now)
            self._recordings[project] = now
        for recording, removed_by in sorted(now.items()):
            if (removed_by is None) != (before.get(recording, "") is None):
                event = {"type": "recordings", "project": project.path.name, "recording": recording}
                self.send({**event, "operator": removed_by or operator})

    def classes_changed(self, project: str, renamed: Mapping[str, str], operator: str) -> None:
        """Sends the event for changed classes or attributes; `renamed`: old class name -> new one."""
        self.send({"type": "classes", "project": project, "renamed": dict(renamed), "operator": operator})

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
