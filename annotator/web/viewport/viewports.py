"""3D viewports, each with its own viser server on loopback, and the set of open viewports of the server."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from annotator.types import OrientedBox
from annotator.types.errors import NotFoundError
from annotator.web.viewport.content import SceneContent
from annotator.web.viewport.picking import pick
from annotator.web.viewport.scene import PointCounts, Scene
from annotator.web.viewport.server import HOST, silence, start_viser

if TYPE_CHECKING:
    import viser

LOG = logging.getLogger("annotator.web")
# A drag whose end event is missing (the browser may have crashed) is assumed to be over after this time, seconds.
DRAG_ENDS_S = 5.0
# Maximum number of viewports per operator; the oldest ones close.
MOST_PER_OPERATOR = 6
# A viewport without a connected browser closes after this time, which exceeds a reload or reconnection, seconds.
UNSEEN_S = 60.0
SWEEP_S = 5.0

Send = Callable[["Viewport", dict[str, Any]], None]
"""Sends an event of a viewport to its page; called from any thread."""


class Viewport:
    """One viewport with its viser server; `show` is thread-safe.

    Attributes:
        id: its name in URLs; not guessable.
        operator: its owner.
        project: the project whose frames it shows.
        port: of its viser server, on 127.0.0.1.
        origin: a secret that its viser server requires of every connection.
        sockets: number of browsers connected through the proxy.
        used_s: time of its last use, `time.monotonic`.
    """

    def __init__(self, id: str, operator: str, project: str, send: Send) -> None:
        """Starts the viser server.

        Args:
            send: called with the viewport's events.
        """
        self.id, self.operator, self.project = id, operator, project
        self.sockets = 0
        self.used_s = time.monotonic()
        self._send = send
        self._lock = threading.Lock()
        self._dragged_s: float | None = None
        self.origin = f"annotator://{secrets.token_hex(16)}"
        with silence():
            self._server = start_viser(HOST, self.origin)
        self.port = self._server.get_port()
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._scene = Scene(self._server, self._gizmo_moved)
        self._listen()

    def show(self, content: SceneContent) -> PointCounts:
        """Shows a scene. While an operator drags the gizmo, the selected box stays at the gizmo."""
        with self._lock:
            self.used_s = time.monotonic()
            dragged = self._dragged_s is not None and time.monotonic() - self._dragged_s < DRAG_ENDS_S
            same = content.selected == self._scene.content.selected
            return self._scene.show(content, hold_gizmo=dragged and same)

    def close(self) -> None:
        """Stops the viser server, which disconnects its browsers."""
        with silence():
            self._server.stop()

    def _listen(self) -> None:
        @self._server.scene.on_click()
        def clicked(event: viser.SceneClickEvent) -> None:
            with _logged("a click"):
                self._clicked(np.array(event.ray_origin, np.float64), np.array(event.ray_direction, np.float64))

    def _clicked(self, origin_m: np.ndarray, direction: np.ndarray) -> None:
        boxes = [shown for shown in self._scene.content.boxes if shown.uid is not None]
        index = pick([shown.box for shown in boxes], origin_m, direction)
        if index is not None:
            self.send("select", uid=boxes[index].uid)

    async def _gizmo_moved(self, event: viser.TransformControlsEvent) -> None:
        # a coroutine: viser runs coroutines in order on its event loop, but plain functions in a pool in any order
        with _logged("a move of the gizmo"):
            self._dragged_s = None if event.phase == "end" else time.monotonic()
            box, selected = self._scene.gizmo_box(), self._scene.selected
            if event.phase != "start" and box is not None and selected is not None:
                self.send("box", uid=selected.uid, box=_box_json(box), final=event.phase == "end")

    def send(self, event: str, **fields: object) -> None:
        """Sends an event to the page."""
        self.used_s = time.monotonic()
        self._send(self, {"type": "viewport", "workbench": self.id, "event": event, **fields})


def _box_json(box: OrientedBox) -> dict[str, object]:
    return {"center": box.center_m.tolist(), "size": box.size_m.tolist(), "rotation": box.rotation.tolist()}


@contextmanager
def _logged(what: str) -> Iterator[None]:
    """Logs an exception of a viser callback together with the event that caused it."""
    try:
        yield
    except Exception:
        LOG.exception("viewport: %s failed", what)


class Viewports:
    """The open viewports: limits their number per operator, and closes unused ones. Thread-safe."""

    def __init__(
        self,
        send: Send,
        *,
        most: int = MOST_PER_OPERATOR,
        unseen_s: float = UNSEEN_S,
        sweep_s: float = SWEEP_S,
    ) -> None:
        """
        Args:
            send: called with the events of all viewports.
            most: maximum number per operator.
            unseen_s: time after which a viewport without a connected browser closes, seconds.
            sweep_s: interval between checks for such viewports, seconds.
        """
        self._send = send
        self._most, self._unseen_s, self._sweep_s = most, unseen_s, sweep_s
        self._lock = threading.Lock()
        self._open: dict[str, Viewport] = {}
        self._stop = threading.Event()
        self._sweeper: threading.Thread | None = None

    def open(self, operator: str, project: str) -> Viewport:
        """Opens a viewport; closes the operator's oldest ones beyond the limit."""
        new = Viewport(secrets.token_hex(8), operator, project, self._send)
        with self._lock:
            self._open[new.id] = new
            of_operator = [viewport for viewport in self._open.values() if viewport.operator == operator]
            surplus = [self._open.pop(viewport.id) for viewport in of_operator[: -self._most]]
            if self._sweeper is None:
                self._sweeper = threading.Thread(target=self._sweep, name="viewports", daemon=True)
                self._sweeper.start()
        for viewport in surplus:
            viewport.close()
        return new

    def get(self, id: str, operator: str) -> Viewport:
        """An operator's viewport.

        Raises:
            NotFoundError: no such viewport, or it belongs to another operator.
        """
        with self._lock:
            viewport = self._open.get(id)
        if viewport is None or viewport.operator != operator:
            raise NotFoundError(f"3D viewport {id} is closed; reload the page to open a new one")
        return viewport

    def close_one(self, id: str, operator: str) -> None:
        """Closes a viewport.

        Raises:
            NotFoundError: as in `get`.
        """
        viewport = self.get(id, operator)
        with self._lock:
            removed = self._open.pop(id, None)
        if removed is not None:
            viewport.close()

    def close(self) -> None:
        """Closes all viewports."""
        self._stop.set()
        with self._lock:
            viewports = list(self._open.values())
            self._open.clear()
            sweeper, self._sweeper = self._sweeper, None
        for viewport in viewports:
            viewport.close()
        if sweeper is not None:
            sweeper.join()

    def connected(self, viewport: Viewport, change: int) -> None:
        """Counts a browser that has connected to a viewport (+1) or disconnected (-1)."""
        with self._lock:
            viewport.sockets += change
            viewport.used_s = time.monotonic()
        viewport.send("connected", connected=viewport.sockets > 0)

    def _sweep(self) -> None:
        while not self._stop.wait(self._sweep_s):
            now = time.monotonic()
            with self._lock:
                for viewport in self._open.values():
                    if viewport.sockets > 0:
                        viewport.used_s = now
                unseen = [viewport for viewport in self._open.values() if now - viewport.used_s > self._unseen_s]
                for viewport in unseen:
                    del self._open[viewport.id]
            for viewport in unseen:
                LOG.info("viewport %s of %s closed: no page shows it", viewport.id, viewport.operator)
                viewport.close()
