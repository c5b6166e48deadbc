"""The live page: the cloud with 3D boxes, and a panel with the camera image, the figures and the buttons."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from annotator.types import ReviewState
from annotator.web.live.overlay import draw_detections
from annotator.web.viewport.content import SceneContent, ShownBox
from annotator.web.viewport.scene import Scene
from annotator.web.viewport.server import HOST, silence, start_viser
from annotator.workflows.live.detection import Detected
from annotator.workflows.live.pipeline import Figures, Pipeline

if TYPE_CHECKING:
    import viser

# Limit of shown points, which are sent many times per second.
MOST_POINTS = 40_000
# Factor of the default point size, which is too large for near objects in a thinned cloud.
POINT_SIZE = 0.7
JPEG_QUALITY = 75
# Minimum interval between updates of the figures, seconds.
FIGURES_EVERY_S = 0.5
# Width of the panel with the image and the figures.
PANEL_PX = 440
SCENE_KEY = ("live", 0)


class LivePage:
    """A page with its own viser server; `show` must be called from one thread. Browsers connect through the proxy.

    Attributes:
        id: its name in messages.
        port, origin: as in `ViserEndpoint`.
    """

    def __init__(self, source: str, facts: Mapping[str, str]) -> None:
        """Starts the server.

        Args:
            source: description of the source, for people.
            facts: constant rows of the table of figures, such as the backend.
        """
        self.id = "live"
        self.origin = f"annotator://{secrets.token_hex(16)}"
        with silence():
            self._server = start_viser(HOST, self.origin)
        self.port = self._server.get_port()
        self._facts, self._figures_at_s = facts, 0.0
        self._pipeline: Pipeline | None = None
        self._scene = Scene(self._server, _ignored)
        self._reset_camera = threading.Event()
        gui = self._server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        gui.set_panel_label(f"annotator live: {source}")
        self._image: viser.GuiImageHandle | None = None
        self._text = gui.add_markdown("waiting for the first frame", order=2.0)
        self._pause = gui.add_button("Pause", order=3.0)
        look = gui.add_button("Look from the camera", order=4.0)

        @look.on_click
        def _(_: object) -> None:
            self._reset_camera.set()

    def follow(self, pipeline: Pipeline) -> None:
        """Shows a pipeline's figures beside the image, and connects the pause button to it."""
        self._pipeline = pipeline

        @self._pause.on_click
        def _(_: object) -> None:
            pipeline.pause(not pipeline.is_paused)
            self._pause.label = "Resume" if pipeline.is_paused else "Pause"

    def show(self, detected: Detected) -> None:
        """Shows one frame, in place of the previous one."""
        boxes = tuple(ShownBox(None, proposal.box, ReviewState.PROPOSED) for proposal in detected.found.proposals)
        reset_camera = self._reset_camera.is_set()
        self._reset_camera.clear()
        content = SceneContent(
            SCENE_KEY, detected.frame, boxes, most_points=MOST_POINTS, point_size=POINT_SIZE, reset_camera=reset_camera
        )
        self._scene.show(content)
        image = draw_detections(detected.frame, detected.found)
        if self._image is None:
            self._image = self._server.gui.add_image(image, format="jpeg", jpeg_quality=JPEG_QUALITY, order=1.0)
        else:
            self._image.image = image
        now = time.monotonic()
        if self._pipeline is not None and now - self._figures_at_s >= FIGURES_EVERY_S:
            self._figures_at_s = now
            self._text.content = table(detected, self._pipeline.figures(), self._facts)

    def close(self) -> None:
        """Stops the server."""
        with silence():
            self._server.stop()


def table(detected: Detected, figures: Figures, facts: Mapping[str, str]) -> str:
    """The figures as Markdown."""
    stages = " · ".join(f"{name} {ms:.0f}" for name, ms in figures.stages_ms.items())
    drops = " · ".join(f"{name} {count}" for name, count in vars(figures.drops).items() if count)
    objects = f"{len(detected.found.proposals)}" + (f", {lost} lost" if (lost := len(detected.found.lost)) else "")
    rows = {
        "frame": f"{detected.frame.key} ({figures.shown} shown)",
        "objects": objects,
        "frames/s": "-" if figures.fps is None else f"**{figures.fps:.1f}**",
        "latency": "-"
        if figures.latency_ms is None
        else f"**{figures.latency_ms:.0f} ms**, 95 %: {figures.latency_p95_ms:.0f} ms",
        "stages, ms": stages or "-",
        "dropped": drops or "none",
        **({"unreadable": str(figures.broken)} if figures.broken else {}),
        **facts,
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


async def _ignored(event: object) -> None:
    """The live page has no gizmo."""
