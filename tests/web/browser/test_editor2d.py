"""The 2D editor with a real mouse: boxes are stored as they are drawn. tests/page/editor.test.js has its geometry."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

ASSETS = Path(__file__).resolve().parents[3] / "web_assets"
WIDTH_PX, HEIGHT_PX = 320, 240

BENCH = """<!doctype html><html><head>
<link rel="stylesheet" href="/assets/css/base.css"><link rel="stylesheet" href="/assets/css/editor2d.css">
<style>
body {display: block}
#host {position: absolute; left: 37.25px; top: 21.5px; width: 700.4px; height: 500.7px}
</style>
</head><body><div id="host"></div><script type="module">
import { createEditor } from "/assets/js/editor2d/editor.js";
const log = [];
const editor = createEditor(document.getElementById("host"), {
  classes: ["person", "chair"],
  onChange: (boxes, why, index, actions) => log.push({ why, index, actions, boxes }),
  onRotate: (angle, final) => final && log.push({ why: "rotate", angle }),
  onOverlay: (id) => log.push({ why: "overlay", id }),
  ...OPTIONS,
});
await editor.setPicture("PICTURE", WIDTH, HEIGHT);
window.bench = { editor, log };
</script></body></html>"""


def _picture() -> str:
    picture = io.BytesIO()
    Image.linear_gradient("L").resize((WIDTH_PX, HEIGHT_PX)).save(picture, "PNG")
    return "data:image/png;base64," + base64.b64encode(picture.getvalue()).decode()


@dataclass(eq=False)
class Bench:
    """A page that contains only an editor of about 700 x 500 CSS pixels."""

    page: Any

    def js(self, code: str, value: Any = None) -> Any:
        """Evaluates code in which `editor` and `log` are the bench's and `value` is an argument."""
        return self.page.evaluate(f"(value) => {{ const {{ editor, log }} = window.bench; return {code}; }}", value)

    @property
    def log(self) -> list[dict]:
        return self.js("log")

    @property
    def boxes(self) -> list[dict]:
        return self.js("editor.boxes")

    def edges(self, index: int = 0) -> list[float]:
        box = self.boxes[index]
        return [box[name] for name in ("x_min", "y_min", "x_max", "y_max")]

    def at(self, x: float, y: float) -> tuple[float, float]:
        """The position of an image pixel on the page, computed from the <img> element."""
        rect = self.page.evaluate("() => document.querySelector('img.picture').getBoundingClientRect().toJSON()")
        return (
            rect["left"] + (x + 0.5) / WIDTH_PX * rect["width"],
            rect["top"] + (y + 0.5) / HEIGHT_PX * rect["height"],
        )

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drags a real mouse from one image pixel to another."""
        begin, stop = self.at(*start), self.at(*end)
        mouse = self.page.mouse
        mouse.move(*begin)
        mouse.down()
        mouse.move((begin[0] + stop[0]) / 2, (begin[1] + stop[1]) / 2 + 3)
        mouse.move(*stop)
        mouse.up()

    @property
    def whys(self) -> list[str]:
        """What the changes since the last look were."""
        return [entry["why"] for entry in self.js("log.splice(0)")]

    def set(self, *boxes: dict, selected: int = 0) -> None:
        self.js(f"editor.setBoxes(value, {selected})", list(boxes))

    def click(self, x: float, y: float) -> None:
        self.page.mouse.click(*self.at(x, y))


@pytest.fixture
def live() -> SimpleNamespace:
    """Replaces the server: the test itself serves the page's files."""
    return SimpleNamespace(url="http://page.test")


def _serve_asset(route: Any) -> None:
    file = ASSETS / route.request.url.partition("/assets/")[2]
    kind = "text/css" if file.suffix == ".css" else "text/javascript"
    route.fulfill(body=file.read_text(), content_type=kind)


@pytest.fixture
def bench(open_page: Callable[..., Any]) -> Callable[..., Bench]:
    """`bench(options="{…}", **browser_context)`: a page with one editor."""

    def make(options: str = "{}", **context: Any) -> Bench:
        page = open_page(**context)
        html = BENCH.replace("OPTIONS", options).replace("PICTURE", _picture())
        html = html.replace("WIDTH", str(WIDTH_PX)).replace("HEIGHT", str(HEIGHT_PX))
        page.route("**/assets/**", _serve_asset)
        page.route("**/bench", lambda route: route.fulfill(body=html, content_type="text/html"))
        page.goto("/bench")
        page.wait_for_function("() => window.bench")
        _settle(page)
        return Bench(page)

    return make


def _settle(page: Any) -> None:
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def _box(x_min: float, y_min: float, x_max: float, y_max: float, **more: Any) -> dict:
    return {"label": "person", "x_min": x_min, "y_min": y_min, "x_max": x_max, "y_max": y_max, **more}


def test_a_drag_stores_its_start_and_end_at_every_zoom(bench) -> None:
    it = bench("{single: true}", device_scale_factor=2)
    for wanted in (0.75, 4.0, 25.0):
        it.set(selected=-1)
        before = it.at(150.0, 110.0)
        it.page.mouse.move(*before)
        for _ in range(60):
            scale = it.js("editor.transform.scale")
            if abs(np.log(scale / wanted)) < 0.2:
                break
            it.page.mouse.wheel(0, -120 if wanted > scale else 120)
            _settle(it.page)
        assert scale == pytest.approx(wanted, rel=0.25)
        assert it.at(150.0, 110.0) == pytest.approx(before, abs=0.01), "the pixel under the pointer stays"
        reach = min(60.0, 150.0 / scale)
        start, end = (150 - reach, 110 - 0.7 * reach), (150 + 0.8 * reach + 0.3, 110 + reach)
        it.drag(start, end)
        assert it.edges() == pytest.approx([*start, *end], abs=0.05)
    assert set(it.whys) == {"draw"}
    assert it.js("getComputedStyle(editor.root.querySelector('img')).imageRendering") == "pixelated"


def test_boxes_are_drawn_changed_selected_nudged_and_deleted(bench) -> None:
    it = bench()
    # a box is drawn where it is stored
    it.set(_box(-0.5, -0.5, 9.5, HEIGHT_PX - 0.5), selected=-1)
    _settle(it.page)
    line = it.page.evaluate("() => document.querySelector('.box .line').getBoundingClientRect().toJSON()")
    picture = it.page.evaluate("() => document.querySelector('img.picture').getBoundingClientRect().toJSON()")
    assert line["left"] == pytest.approx(picture["left"], abs=1)
    assert line["bottom"] == pytest.approx(picture["bottom"], abs=1)
    assert line["width"] == pytest.approx(picture["width"] * 10 / WIDTH_PX, abs=2)
    # edges, corners and the inside
    for grab, drop, edges, why in (
        ((50, 90), (42, 97), [42, 60, 150, 120], "resize"),
        ((100, 90), (112, 75), [62, 45, 162, 105], "move"),
    ):
        it.set(_box(50, 60, 150, 120))
        it.drag(grab, drop)
        assert it.edges() == pytest.approx(edges, abs=0.5)
        assert it.whys == [why]
    # Escape cancels a drag
    it.set(_box(50, 60, 150, 120))
    it.page.mouse.move(*it.at(100, 90))
    it.page.mouse.down()
    it.page.mouse.move(*it.at(140, 130))
    assert it.edges() == pytest.approx([90, 100, 190, 160], abs=0.5)
    it.page.keyboard.press("Escape")
    it.page.mouse.move(*it.at(10, 10))
    it.page.mouse.up()
    assert it.edges() == [50, 60, 150, 120]
    assert it.whys == []
    # a click selects one of several, and Delete removes it
    it.set(_box(20, 20, 80, 90), _box(120, 30, 200, 160), selected=1)
    it.click(50, 60)
    assert it.js("editor.selected") == 0
    it.page.keyboard.press("Delete")
    assert it.edges() == [120, 30, 200, 160]
    assert it.whys == ["delete"]
    # Space and the middle button pan, and change no box
    before = it.at(100, 100)
    it.page.mouse.move(*before)
    it.page.keyboard.down(" ")
    it.drag((100, 100), (130, 120))
    it.page.keyboard.up(" ")
    _settle(it.page)
    assert it.at(70, 80) == pytest.approx(before, abs=0.5)
    it.page.mouse.down(button="middle")
    it.page.mouse.move(*before)
    it.page.mouse.up(button="middle")
    _settle(it.page)
    assert it.at(100, 100) == pytest.approx(before, abs=0.5)
    assert it.whys == []
    # a click on an outline tells its id
    outline = [[[40, 40], [120, 40]], [[120, 40], [120, 100]], [[120, 100], [40, 100]], [[40, 100], [40, 40]]]
    it.js("editor.setBoxes([]) ?? editor.setOverlays([{segments: value, color: 'lime', id: 'abc'}])", outline)
    it.click(80, 70)
    it.click(200, 200)
    assert it.js("log.splice(0)") == [{"why": "overlay", "id": "abc"}]
    # arrow keys move edges by whole pixels, as one change
    it.js("editor.setOverlays([])")
    it.set(_box(50.25, 60.5, 150.25, 120.5))
    it.js("editor.root.focus()")
    # the page's clock stands still: key presses are far apart on a busy machine
    it.page.clock.install()
    it.page.clock.pause_at(datetime.now() + timedelta(hours=1))
    for key in ("ArrowRight", "ArrowDown", "Shift+ArrowLeft", "Alt+ArrowRight", "Alt+Shift+ArrowDown"):
        it.page.keyboard.press(key)
    assert it.whys == []
    it.page.clock.run_for(500)
    assert it.edges() == [41.25, 61.5, 142.25, 131.5]
    assert [(entry["why"], entry["actions"]) for entry in it.log] == [("nudge", 5)]


def _touch(session: Any, kind: str, *points: tuple[float, float]) -> None:
    touches = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
    session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})


def test_one_box_is_suggested_replaced_and_turned_and_fingers_draw_and_zoom(bench) -> None:
    it = bench("{single: true}", has_touch=True)
    # a suggestion is accepted by a click or Enter, and corrected by a drag
    it.set(_box(50, 60, 150, 120, suggested=True))
    it.click(100, 90)
    it.set(_box(50, 60, 150, 120, suggested=True))
    it.page.keyboard.press("Enter")
    it.set(_box(50, 60, 150, 120, suggested=True))
    it.drag((150, 90), (160, 90))
    assert all(entry["boxes"][0]["suggested"] is False for entry in it.log)
    assert it.log[1]["boxes"][0]["x_max"] == 150
    assert it.whys == ["accept", "accept", "resize"]
    # another box replaces it
    it.drag((170, 100), (220, 180))
    assert len(it.boxes) == 1
    assert it.edges() == pytest.approx([170, 100, 220, 180], abs=0.5)
    # the rotation handle counts clockwise angles as positive
    it.js("editor.setHandles({rotate: true}) ?? editor.setBoxes([value], 0)", _box(110, 100, 210, 160))
    _settle(it.page)
    handle = it.page.get_by_test_id("rotate-handle").bounding_box()
    center_x, center_y = it.at(160, 130)
    it.page.mouse.move(handle["x"] + handle["width"] / 2, handle["y"] + handle["height"] / 2)
    it.page.mouse.down()
    it.page.mouse.move(center_x + 60, center_y - 90)
    it.page.mouse.move(center_x + 80, center_y)
    it.page.mouse.up()
    assert it.log[-1]["angle"] == pytest.approx(1.5708, abs=0.01)
    assert it.whys == ["draw", "rotate"]
    # one finger draws, two fingers zoom
    it.js("editor.setHandles({rotate: false}) ?? editor.setBoxes([])")
    session = it.page.context.new_cdp_session(it.page)
    _touch(session, "touchStart", it.at(40, 50))
    _touch(session, "touchMove", it.at(100, 90))
    _touch(session, "touchMove", it.at(180, 140))
    _touch(session, "touchEnd")
    assert it.edges() == pytest.approx([40, 50, 180, 140], abs=0.5)
    scale = it.js("editor.transform.scale")
    (x, y), (u, v) = it.at(100, 120), it.at(200, 120)
    _touch(session, "touchStart", (x, y))
    _touch(session, "touchStart", (x, y), (u, v))
    _touch(session, "touchMove", (x - 50, y), (u + 50, v))
    _touch(session, "touchMove", (x - 100, y), (u + 100, v))
    _touch(session, "touchEnd")
    _settle(it.page)
    assert it.js("editor.transform.scale") == pytest.approx(scale * (u - x + 200) / (u - x), rel=0.05)
    assert it.edges() == pytest.approx([40, 50, 180, 140], abs=0.5)
    assert it.whys == ["draw"]
