"""A workbench server in a separate process (`annotator serve`), and its clients."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx

from annotator.project import open_project
from annotator.types.errors import ConfigError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


PRESET, LABEL = "people", "person"


class Server:
    """A running server; `url` is `http://127.0.0.1:PORT`, and `link` has the token, too."""

    def __init__(self, projects: Path) -> None:
        # a session of its own, as in its own terminal: Linux shares the processor among sessions, and in practice a
        # benchmark's clients are on other computers
        self._process = subprocess.Popen(
            [sys.executable, "-m", "annotator", "serve", "--projects", str(projects), "--port", "0"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        printed = re.search(r"(http://[^/]+)/\S+", self._process.stdout.readline())
        if printed is None:
            self.stop()
            raise ConfigError("the server did not start; run `annotator serve` to see why")
        self.link, self.url = printed.group(), printed.group(1)

    def client(self, operator: str) -> httpx.Client:
        """A signed-in client with the token's cookie and the origin of the server's own page."""
        options: dict[str, Any] = {"base_url": self.url, "headers": {"Origin": self.url}, "timeout": 60.0}
        with httpx.Client(**options) as opened:
            opened.get(self.link)
            answered(opened.post("/api/session", json={"operator": operator}))
            return httpx.Client(**options, cookies=opened.cookies)

    def memory_mb(self) -> float:
        """Resident memory of the server's own process, MB (Linux)."""
        fields = Path(f"/proc/{self._process.pid}/statm").read_text().split()
        return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    def stop(self) -> None:
        """Stops the server cleanly; kills it after 20 s."""
        self._process.terminate()
        try:
            self._process.communicate(timeout=20.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()


@contextmanager
def serving(projects: Path) -> Iterator[Server]:
    """A server that is stopped at the end of the block."""
    server = Server(projects)
    try:
        yield server
    finally:
        server.stop()


def answered(response: httpx.Response) -> Any:
    """The JSON of a response; None if it is empty."""
    if response.is_error:
        raise ConfigError(f"{response.request.method} {response.request.url.path}: {response.text[:300]}")
    return response.json() if response.content else None


def percentile(values: Sequence[float], percent: float) -> float:
    """The percentile of the values, by the nearest-rank method; NaN without values."""
    if not values:
        return float("nan")
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, -(-len(ordered) * int(percent) // 100) - 1))]


# The operator's waiting times, measured in a real browser from the key or mouse event to the new content on screen.
#
# A probe in the page checks at each animation frame which pictures, boxes and rows are there. For the 3D view it
# detects when the points of another cloud are uploaded to WebGL and drawn. It then reads one pixel, which blocks until
# the drawing is done, and takes the time. (Reading pixels at every animation frame would take longer than the measured
# operation.)


# Render as on a computer without a graphics card: WebGL in software, and the page itself without GL.
ARGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
)
VIEWPORT = {"width": 1366, "height": 768}
OPENS_WITHIN_S = 90.0
# A measurement fails if the content is not on screen within WATCH_S. It ends after QUIET_S without a change, so that
# details that load later are not counted in the next measurement.
WATCH_S, QUIET_S = 8.0, 1.5
# A buffer of at least this size is a point cloud; lines and arrows are smaller.
CLOUD_BYTES = 30_000

# Measures from the next `trigger` event until the last change of what the selector finds (pictures by their addresses,
# all else by what it shows), and optionally of the 3D view.
PROBE = """([trigger, selector, is_view_watched, quiet_ms, longest_ms]) => {
  const name = ({ src, complete, dataset }) =>
    src === undefined ? (dataset.id ?? dataset.uid ?? dataset.shown) : complete ? src : "";
  const content = () => [...document.querySelectorAll(selector)].map(name).join(" ");
  let seen = content();
  const at = { begin: null, page: null, view: null };
  window.measured = null;
  window.began[trigger] = null;
  window.cloud = { drawn: null, last: null };
  const tick = () => {
    const now = performance.now();
    at.begin = window.began[trigger];
    const found = content();
    if (at.begin !== null) {
      if (found !== seen) at.page = now;
      if (is_view_watched && window.cloud.drawn > at.begin) at.view ??= now;
      const last = Math.max(at.page ?? at.begin, is_view_watched ? window.cloud.last ?? at.begin : at.begin);
      const is_done = at.page !== null && (at.view !== null || !is_view_watched) && now - last > quiet_ms;
      if (is_done || now - at.begin > longest_ms) {
        window.measured = { page: at.page && at.page - at.begin, view: at.view && at.view - at.begin };
        return;
      }
    }
    seen = found;
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}"""

# Records in `window.cloud` when another cloud is drawn (the page's clock).
CLOUD_PROBE = """(cloud_bytes) => {
  const view = document.querySelector("[data-testid=viewport-frame]").contentWindow;
  const gl = view.WebGL2RenderingContext.prototype;
  window.cloud = { drawn: null, last: null };
  let is_new = false;
  const around = (name, before, after) => {
    const plain = gl[name];
    gl[name] = function (...values) {
      before?.(values);
      const result = plain.apply(this, values);
      after?.(this, values);
      return result;
    };
  };
  const upload = ([, data]) => (is_new ||= (data?.byteLength ?? 0) >= cloud_bytes);
  around("bufferData", upload);
  around("bufferSubData", ([target, , data]) => upload([target, data]));
  around("drawArrays", null, (context, [mode, , count]) => {
    if (!is_new || mode !== context.POINTS || count * 12 < cloud_bytes) return;
    is_new = false;
    context.readPixels(0, 0, 1, 1, context.RGBA, context.UNSIGNED_BYTE, new Uint8Array(4));
    window.cloud.last = performance.now();
    window.cloud.drawn ??= window.cloud.last;
  });
}"""

# Records the time of the first event of each kind, before the page's own listeners, which may stop its propagation.
BEGINNINGS = """() => {
  window.began = {};
  for (const name of ["keydown", "pointerup"])
    addEventListener(name, () => (window.began[name] ??= performance.now()), { capture: true });
}"""


@contextmanager
def chromium() -> Iterator[Browser]:
    """Headless Chromium that renders WebGL in software."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise ConfigError("playwright is not installed; run scripts/setup test") from error
    path = os.environ.get("ANNOTATOR_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        raise ConfigError("no chromium found on the PATH; install it, or set ANNOTATOR_CHROMIUM")
    _forbid_priority()
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=list(ARGS))
        try:
            yield browser
        finally:
            browser.close()


def _forbid_priority() -> None:
    """As root, Chromium would give itself a higher priority than the server has; ordinary users' browsers cannot."""
    if sys.platform == "linux":
        # takes CAP_SYS_NICE (23) from the programs that this one starts (PR_CAPBSET_DROP, 24); fails if not root
        ctypes.CDLL(None).prctl(24, 23, 0, 0, 0)


def signed_in(browser: Browser, server: Server, operator: str = "Ada") -> Page:
    """A signed-in page in a separate browser context."""
    page = browser.new_context(base_url=server.url, viewport=VIEWPORT).new_page()  # type: ignore[arg-type]
    page.add_init_script(f"({BEGINNINGS})()")
    page.request.get(server.link)
    page.request.post("/api/session", data={"operator": operator}, headers={"Origin": server.url})
    return page


def open_frame(page: Page, project: str, frame: int | None, uid: str = "") -> None:
    """Opens a frame in Annotate (None: the queue's first one), with a label selected; waits for image and 3D view."""
    place = "" if frame is None else f"/{frame}" + (f"?uid={uid}" if uid else "")
    page.goto(f"/#/{project}/annotate{place}")
    page.reload()
    until(page, "document.querySelector('[data-testid=viewport]')?.dataset.state === 'ready'", OPENS_WITHIN_S)
    until(page, "document.querySelector('img.picture')?.complete", OPENS_WITHIN_S)
    page.wait_for_timeout(2000)


def until(page: Page, expression: str, seconds: float) -> None:
    """Waits until a JavaScript expression is true."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        if time.monotonic() > end:
            raise ConfigError(f"timed out after {seconds:.0f} s waiting for: {expression}")
        page.wait_for_timeout(50)


def watch(page: Page, trigger: str, selector: str, with_view: bool) -> None:
    """Starts a measurement at the next `trigger` event; `with_view` includes the 3D view, which takes more time."""
    page.evaluate(PROBE, [trigger, selector, with_view, QUIET_S * 1000, WATCH_S * 1000])


def measured(page: Page) -> dict[str, float]:
    """When what the selector finds ("page") and the 3D view ("view") were on screen, milliseconds after the event."""
    until(page, "window.measured !== null", WATCH_S + OPENS_WITHIN_S)
    shown: dict[str, float | None] = page.evaluate("window.measured")
    times = {name: value for name, value in shown.items() if value is not None}
    if "page" not in times:
        raise ConfigError(f"what is new was not on screen within {WATCH_S:.0f} s")
    return times


def on_page(page: Page, x: float, y: float) -> tuple[float, float]:
    """Where a pixel of the camera image is on the page."""
    image = page.locator("[data-testid=image-editor] img.picture").first
    rect = image.evaluate("(i) => ({...i.getBoundingClientRect().toJSON(), w: i.naturalWidth, h: i.naturalHeight})")
    return rect["left"] + (x + 0.5) * rect["width"] / rect["w"], rect["top"] + (y + 0.5) * rect["height"] / rect["h"]


def drag(page: Page, start: tuple[float, float], end: tuple[float, float], key: str = "") -> None:
    """Drags the mouse from one point of the page to another; a key is pressed before it is released."""
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=4)
    if key:
        page.keyboard.press(key)
    page.mouse.up()


def draw_box(page: Page, box: tuple[float, float, float, float]) -> None:
    """Draws a box on the camera image with the mouse: x_min, y_min, x_max, y_max, pixels of the image."""
    drag(page, on_page(page, *box[:2]), on_page(page, *box[2:]))


def wait_for_frame(page: Page, frame: int) -> None:
    """Waits until a frame's image is on the page."""
    picture = f"[data-testid=image-editor] img.picture[src*='frames/{frame}/image']"
    until(page, f'document.querySelector("{picture}")?.complete', OPENS_WITHIN_S)
    page.wait_for_timeout(500)


def frames_of(projects: Path, name: str) -> list[int]:
    """Ids of a project's frames, in order."""
    with open_project(projects / name) as project:
        return [frame.id for frame in project.frames.of()]
