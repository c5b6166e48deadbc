"""The first drag in Label: from the release of the mouse to the object's 3D box on the page, and what that costs.

A probe in the page notes at each animation frame whether the outline of the dashed 3D box is on the image, and whether
all dashed boxes and their pictures are on the views. The server's time is that of the requests that save the drag and
return boxes, as the browser measured it.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import mean
from typing import TYPE_CHECKING, Any

from benchmarks.workbench_browser import OPENS_WITHIN_S, draw_box, open_mode, signed_in, until, wait_for_frame
from benchmarks.workbench_server import Server, answered, percentile

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Request

# A drag whose boxes are not on the page by then has none: the detector found nothing.
LONGEST_MS = 8000
# Time for the requests that follow the boxes, such as that of the 3D view.
SETTLES_MS = 700

PROBE = """(longest_ms) => {
  const at = { begin: null, cleared: false, dashed: null, box: null, all: null };
  window.drag = null;
  window.began.pointerup = null;
  const count = (selector) => document.querySelectorAll(selector).length;
  const tick = () => {
    const now = performance.now();
    at.begin = window.began.pointerup;
    if (at.begin !== null) {
      const dashed = count(".views .box.suggested");
      at.cleared ||= dashed === 0;
      if (at.cleared && dashed) {
        at.dashed ??= now - at.begin;
        if (count("[data-testid=image-editor] [data-testid=editor-overlay]:not([data-id])")) at.box ??= now - at.begin;
        const pictures = [...document.querySelectorAll(".views img.picture[src]")];
        if (dashed === 4 && pictures.length === 4 && pictures.every((picture) => picture.complete))
          at.all ??= now - at.begin;
      }
      if ((at.box !== null && at.all !== null) || now - at.begin > longest_ms) {
        window.drag = at;
        return;
      }
    }
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}"""


def first_drags(
    browser: Browser, server: Server, project: str, boxes: Sequence[tuple[int, tuple[float, float, float, float]]]
) -> dict[str, Any]:
    """Draws image boxes, each on the frame as it was before, with the detector loaded.

    Args:
        boxes: frame, and x_min, y_min, x_max, y_max on its image, pixels.
    """
    page = signed_in(browser, server)
    open_mode(page, project, "label", boxes[0][0])
    with server.client() as client:
        _wait_for_detector(client, project, boxes[0])
    sent: list[Request] = []
    page.on("requestfinished", lambda request: sent.append(request))
    drags: list[dict[str, float | None]] = []
    costs: list[dict[str, float]] = []
    for frame, box in boxes:
        page.evaluate("(hash) => (location.hash = hash)", f"#/{project}/label/{frame}")
        wait_for_frame(page, frame)
        page.evaluate(PROBE, LONGEST_MS)
        sent.clear()
        draw_box(page, box)
        until(page, "window.drag !== null", OPENS_WITHIN_S)
        page.wait_for_timeout(SETTLES_MS)
        drags.append(page.evaluate("window.drag"))
        costs.append(_costs(sent))
        page.keyboard.press("Control+z")
        until(page, "!document.querySelector('[data-testid=object]')", OPENS_WITHIN_S)
    page.context.close()
    found = [drag for drag in drags if drag["box"] is not None]
    times = {name: [drag[name] or 0.0 for drag in found] for name in ("dashed", "box", "all")}
    return {
        "drags": len(drags),
        "found": len(found),
        **{f"{name}_p{p}_ms": percentile(values, p) for name, values in times.items() for p in (50, 95)},
        **{name: mean(cost[name] for cost in costs) for name in costs[0]},
    }


def _wait_for_detector(client: Any, project: str, first: tuple[int, tuple[float, float, float, float]]) -> None:
    frame, (x_min, y_min, x_max, y_max) = first
    label = answered(client.get(f"/api/projects/{project}"))["classes"][0]
    body = {
        "image_box": {"label": label, "x_min": x_min, "y_min": y_min, "x_max": x_max, "y_max": y_max},
        "boxes": [],
    }
    while (
        answered(client.post(f"/api/projects/{project}/frames/{frame}/label/steps", json=body))["detector"] != "ready"
    ):
        pass


def _costs(sent: Sequence[Request]) -> dict[str, float]:
    """The requests of one drag: those that save it and return boxes, pictures, and the 3D view's."""
    drag, pictures, view = (
        [request for request in sent if part in request.url] for part in ("/label/", "/views/", "/scene")
    )
    return {
        "requests": float(len(drag)),
        "pictures": float(len(pictures)),
        "view_requests": float(len(view)),
        "bytes": float(sum(request.sizes()["responseBodySize"] for request in [*drag, *pictures])),
        "server_ms": sum(request.timing["responseStart"] - request.timing["requestStart"] for request in drag),
    }
