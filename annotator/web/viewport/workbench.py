"""One open workbench's viewport: its own viser server on loopback, what it shows, and what is done in it."""

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
from annotator.web.viewport.content import SceneContent
from annotator.web.viewport.picking import picked
from annotator.web.viewport.scene import Scene, Shown
from annotator.web.viewport.server import HOST, silence, start_viser

if TYPE_CHECKING:
    import viser

LOG = logging.getLogger("annotator.web")
# A drag whose end never came (a browser that died) holds the gizmo no longer than this, seconds.
DRAG_ENDS_S = 5.0

Send = Callable[["Workbench", dict[str, Any]], None]
"""Carries an event of a workbench to its page; called from any thread."""


class Workbench:
    """A viewport; `show` may be called from any thread.

    Attributes:
        id: name in its address; not to be guessed.
        operator: who opened it.
        project: what it shows frames of.
        port: of its viser server, on 127.0.0.1.
        origin: a secret that its viser server asks of everybody who connects.
        sockets: browsers that are connected through the proxy.
        used_s: when it was last used, `time.monotonic`.
    """

    def __init__(self, id: str, operator: str, project: str, send: Send) -> None:
        """Starts the server.

        Args:
            send: gets the events.
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

    def show(self, content: SceneContent) -> Shown:
        """Shows this."""
        with self._lock:
            self.used_s = time.monotonic()
            dragged = self._dragged_s is not None and time.monotonic() - self._dragged_s < DRAG_ENDS_S
            same = content.selected == self._scene.content.selected
            return self._scene.show(content, hold_gizmo=dragged and same)

    def close(self) -> None:
        """Ends the server; browsers that look at it lose their connection."""
        with silence():
            self._server.stop()

    def _listen(self) -> None:
        @self._server.scene.on_click()
        def clicked(event: viser.SceneClickEvent) -> None:
            with _logged("a click"):
                self._clicked(np.array(event.ray_origin, np.float64), np.array(event.ray_direction, np.float64))

    def _clicked(self, origin_m: np.ndarray, direction: np.ndarray) -> None:
        boxes = [shown for shown in self._scene.content.boxes if shown.uid is not None]
        number = picked([shown.box for shown in boxes], origin_m, direction)
        if number is not None:
            self.tell("select", uid=boxes[number].uid)

    async def _gizmo_moved(self, event: viser.TransformControlsEvent) -> None:
        # a coroutine: viser runs these one after the other on its loop, plain functions in any order in a pool
        with _logged("a move of the gizmo"):
            self._dragged_s = None if event.phase == "end" else time.monotonic()
            box, selected = self._scene.gizmo_box(), self._scene.selected
            if event.phase != "start" and box is not None and selected is not None:
                self.tell("box", uid=selected.uid, box=_box_json(box), final=event.phase == "end")

    def tell(self, event: str, **more: object) -> None:
        """Sends an event, as the page gets it."""
        self.used_s = time.monotonic()
        self._send(self, {"type": "viewport", "workbench": self.id, "event": event, **more})


def _box_json(box: OrientedBox) -> dict[str, object]:
    return {"center": box.center_m.tolist(), "size": box.size_m.tolist(), "rotation": box.rotation.tolist()}


@contextmanager
def _logged(what: str) -> Iterator[None]:
    """An error in a callback would end on stderr, without a word on what was being done."""
    try:
        yield
    except Exception:
        LOG.exception("viewport: %s failed", what)
