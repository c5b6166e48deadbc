"""The page's geometry (js/box3d.js, js/rotation.js, js/camera.js) agrees with the package's, in a real browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.outline import box_on_image, heading_px
from annotator.geometry.projection import project
from annotator.types import Camera, OrientedBox, PointCloud
from annotator.workflows.workbench.contact_sheet import views_of_points

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Route

SCRIPTS = Path(__file__).resolve().parents[3] / "web_assets" / "js"
ORIGIN = "http://page.test"
PAGE = """<!doctype html><script type="module">
import * as rotation from "/rotation.js";
import * as box3d from "/box3d.js";
import * as camera from "/camera.js";
window.modules = { rotation, box3d, camera };
</script>"""
UP = [0.02, -0.96, -0.28]
LENSES = [
    (),
    (0.1, -0.2, 0.001, 0.002, 0.05),
    (0.1, -0.2, 0.001, 0.002, 0.05, 0.01, 0.02, 3e-3, 1e-3, 2e-3, 3e-3, 1e-3),
]
TILTED_LENS = (*LENSES[2], 0.02, -0.03)

Call = Callable[..., object]


@pytest.fixture(scope="module")
def call(browser: Browser) -> Iterator[Call]:
    """`call("box3d.turned", box, axis, angle)` runs a function of a module in the browser."""

    def answer(route: Route) -> None:
        name = route.request.url.removeprefix(ORIGIN + "/")
        if name:
            route.fulfill(body=(SCRIPTS / name).read_text(), content_type="text/javascript")
        else:
            route.fulfill(body=PAGE, content_type="text/html")

    page = browser.new_page()
    page.route(f"{ORIGIN}/**", answer)
    page.goto(f"{ORIGIN}/")
    page.wait_for_function("window.modules")

    def run(name: str, *values: object) -> object:
        return page.evaluate(
            "([name, values]) => { const [m, f] = name.split('.'); return window.modules[m][f](...values); }",
            [name, list(values)],
        )

    yield run
    page.close()


def random_boxes(count: int) -> list[OrientedBox]:
    rng = np.random.default_rng(7)
    turns = Rotation.random(count, random_state=7).as_matrix()
    return [
        OrientedBox.from_parts(rng.uniform([-1, -1, 3], [1, 1, 6]), turn, rng.uniform(0.3, 2.0, 3)) for turn in turns
    ]


def as_json(box: OrientedBox) -> dict[str, object]:
    return {"center": box.center_m.tolist(), "size": box.size_m.tolist(), "rotation": box.rotation.tolist()}


def from_json(box: dict) -> OrientedBox:
    return OrientedBox.from_parts(*(np.array(box[name], np.float64) for name in ("center", "rotation", "size")))


def own_view(box: OrientedBox) -> dict[str, object]:
    """A view along the box's axes, with x to the right and z up, as from the server."""
    x, y, z = box.rotation.T
    return {
        "axes": [x.tolist(), (-z).tolist(), y.tolist()],
        "metres_per_px": 0.01,
        "origin_m": [float(x @ box.center_m) - 1.6, float(-z @ box.center_m) - 1.6],
        "width": 320,
        "height": 320,
    }


def same_corners(a: OrientedBox, b: OrientedBox) -> bool:
    """Whether two boxes are the same up to a permutation of their axes."""
    distance = np.linalg.norm(box_corners(a)[:, None] - box_corners(b)[None], axis=2)
    return bool((distance.min(axis=0) < 1e-9).all() and (distance.min(axis=1) < 1e-9).all())


def test_corners_agree_with_the_package(call: Call) -> None:
    for box in random_boxes(5):
        np.testing.assert_allclose(call("box3d.corners", as_json(box)), box_corners(box), atol=1e-12)


@pytest.mark.parametrize("lens", [*LENSES, TILTED_LENS])
def test_projection_agrees_with_the_package(call: Call, lens: tuple[float, ...]) -> None:
    camera = Camera(640, 480, 500.0, 510.0, 321.5, 240.5, lens)
    data = {"fx": 500, "fy": 510, "cx": 321.5, "cy": 240.5, "distortion": lens, "width": 640, "height": 480}
    points = np.array([[0.0, 0, 2], [0.7, -0.4, 2], [-0.9, 0.6, 3], [0.1, 0.1, -1]])
    ours = [call("camera.project", data, point.tolist()) for point in points]
    np.testing.assert_allclose(ours[:3], project(camera, points)[:3], atol=1e-9)
    assert ours[3] is None
    for box in random_boxes(3):
        px = np.array([corner for line in call("camera.outline", data, as_json(box)) for corner in line])
        seen = box_on_image(camera, box, "thing")
        assert seen is not None
        assert px.min(axis=0) == pytest.approx([seen.x_min, seen.y_min], abs=0.5)
        assert px.max(axis=0) == pytest.approx([seen.x_max, seen.y_max], abs=0.5)


def test_an_outline_is_clipped_to_the_image_and_the_near_plane(call: Call) -> None:
    data = {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "distortion": [], "width": 640, "height": 480}
    around = OrientedBox.from_parts(np.array([0.0, 0, 0.5]), np.eye(3), np.array([0.2, 0.2, 4.0]))
    lines = call("camera.outline", data, as_json(around))
    px = np.array([corner for line in lines for corner in line])
    assert len(lines) > 0 and np.isfinite(px).all()
    assert (px >= -0.5 - 1e-9).all() and (px <= np.array([639.5, 479.5]) + 1e-9).all()
    behind = OrientedBox.from_parts(np.array([0.0, 0, -3]), np.eye(3), np.ones(3))
    assert call("camera.outline", data, as_json(behind)) == []


def test_moving_one_edge_in_a_view_moves_one_face(call: Call) -> None:
    for box in random_boxes(4):
        view = own_view(box)
        rect = call("box3d.viewRect", view, as_json(box))
        rect["x_max"] += 12.5
        grown = from_json(call("box3d.withViewRect", view, as_json(box), rect))
        np.testing.assert_allclose(grown.size_m, box.size_m + np.array([0.125, 0, 0]), atol=1e-9)
        np.testing.assert_allclose(grown.center_m, box.center_m + 0.0625 * box.rotation[:, 0], atol=1e-9)
        rect["y_min"] -= 10
        higher = from_json(call("box3d.withViewRect", view, as_json(box), rect))
        np.testing.assert_allclose(higher.size_m, box.size_m + np.array([0.125, 0, 0.1]), atol=1e-9)


def test_moving_the_rectangle_keeps_the_size(call: Call) -> None:
    box = random_boxes(1)[0]
    view = own_view(box)
    rect = call("box3d.viewRect", view, as_json(box))
    moved = {"x_min": rect["x_min"] + 7, "x_max": rect["x_max"] + 7, "y_min": rect["y_min"], "y_max": rect["y_max"]}
    after = from_json(call("box3d.withViewRect", view, as_json(box), moved))
    np.testing.assert_allclose(after.size_m, box.size_m, atol=1e-9)
    np.testing.assert_allclose(after.center_m, box.center_m + 0.07 * box.rotation[:, 0], atol=1e-9)


def test_an_edge_cannot_cross_the_opposite_edge(call: Call) -> None:
    box = random_boxes(1)[0]
    view = own_view(box)
    rect = call("box3d.viewRect", view, as_json(box))
    rect["x_max"] = rect["x_min"] - 5
    assert min(call("box3d.withViewRect", view, as_json(box), rect)["size"]) > 0


def test_a_rotation_in_a_view_is_clockwise_on_the_screen(call: Call) -> None:
    box = random_boxes(1)[0]
    view = own_view(box)
    turned = from_json(call("box3d.turnedInView", view, as_json(box), np.pi / 6))
    axes = np.array(view["axes"])
    heading = axes @ turned.rotation[:, 0]  # in the view: x right, y down
    np.testing.assert_allclose(heading, [np.cos(np.pi / 6), np.sin(np.pi / 6), 0], atol=1e-9)
    np.testing.assert_allclose(turned.center_m, box.center_m, atol=1e-12)


# Of each of Review's views, the box axes that point right, down and into it, with their signs; and how an edge pulled
# by 10 px (0.1 m) to the right or down changes length, width and height, and the centre along these, m.
GESTURES = {
    ("top", "x_max"): ((0, 0.1, 0), (0, -0.05, 0)),  # the right edge is the right side
    ("top", "y_min"): ((-0.1, 0, 0), (-0.05, 0, 0)),  # the upper edge is the front
    ("front", "x_max"): ((0, 0.1, 0), (0, 0.05, 0)),  # the right edge is the left side: it faces you
    ("front", "x_min"): ((0, -0.1, 0), (0, 0.05, 0)),
    ("front", "y_max"): ((0, 0, 0.1), (0, 0, -0.05)),
    ("side", "x_max"): ((0.1, 0, 0), (0.05, 0, 0)),  # the right edge is the front
    ("side", "x_min"): ((-0.1, 0, 0), (0.05, 0, 0)),
}
# A turn of the handle by 10 degrees clockwise: about which axis of the box, and in which sense.
TURNS = {"top": (2, -1), "front": (0, -1), "side": (1, 1)}


def view_of(name: str, box: OrientedBox) -> dict[str, object]:
    """A view as the server draws it, with 1 cm per pixel."""
    cloud = PointCloud(np.zeros((0, 3), np.float32), None, None)
    size_px = 1.7 * box.size_m.max() / 0.01
    (view,) = [
        item.view for item in views_of_points(cloud, np.zeros(0, np.int64), box, round(size_px)) if item.name == name
    ]
    return {"axes": view.axes.tolist(), "metres_per_px": view.metres_per_px, "origin_m": view.origin_m.tolist()}


@pytest.mark.parametrize(("name", "edge"), GESTURES)
def test_an_edge_of_a_view_moves_the_face_that_it_shows(call: Call, name: str, edge: str) -> None:
    size, shift = GESTURES[name, edge]
    for box in random_boxes(3):
        view = view_of(name, box)
        rect = call("box3d.viewRect", view, as_json(box))
        rect[edge] += 0.1 / view["metres_per_px"]
        after = from_json(call("box3d.withViewRect", view, as_json(box), rect))
        np.testing.assert_allclose(after.size_m - box.size_m, size, atol=1e-9)
        np.testing.assert_allclose(box.rotation.T @ (after.center_m - box.center_m), shift, atol=1e-9)


@pytest.mark.parametrize("name", TURNS)
def test_the_handle_of_a_view_turns_the_box_as_the_view_shows_it(call: Call, name: str) -> None:
    axis, sign = TURNS[name]
    for box in random_boxes(3):
        after = from_json(call("box3d.turnedInView", view_of(name, box), as_json(box), np.radians(10)))
        turn = Rotation.from_matrix(box.rotation.T @ after.rotation).as_rotvec(degrees=True)
        np.testing.assert_allclose(turn, np.eye(3)[axis] * sign * 10, atol=1e-6)


def test_the_heading_is_up_in_the_top_view_comes_nearer_in_the_front_view_and_is_right_of_the_right_side(
    call: Call,
) -> None:
    box = random_boxes(1)[0]
    for name, along, sight in (("top", [0, -1], 0), ("front", [0, 0], -1), ("side", [1, 0], 0)):
        view = view_of(name, box)
        arrow = call("box3d.viewHeading", view, as_json(box))
        reach_px = np.array(along) * 0.4 * box.size_m[0] / view["metres_per_px"]
        np.testing.assert_allclose(np.subtract(arrow["to"], arrow["from"]), reach_px, atol=1e-6)
        assert arrow["sight"] == pytest.approx(sight, abs=1e-9)


def test_the_heading_on_the_image_agrees_with_the_package_and_ends_at_the_border(call: Call) -> None:
    camera = Camera(640, 480, 500.0, 510.0, 321.5, 240.5)
    data = {"fx": 500, "fy": 510, "cx": 321.5, "cy": 240.5, "distortion": [], "width": 640, "height": 480}
    for box in random_boxes(4):
        arrow = call("camera.imageHeading", data, as_json(box))
        middle, tip = heading_px(camera, box, 10.0)[0]
        np.testing.assert_allclose(arrow["from"], middle, atol=1e-6)
        inside = bool((tip >= -0.5).all() and (tip <= [639.5, 479.5]).all())
        if inside:
            np.testing.assert_allclose(arrow["to"], tip, atol=1e-6)
    right = {"center": [2.4, 0, 4], "size": [2, 1, 1], "rotation": np.eye(3).tolist()}
    arrow = call("camera.imageHeading", data, right)
    np.testing.assert_allclose(arrow["to"], [639.5, 240.5], atol=1e-6)
    assert arrow["sight"] == pytest.approx(2.4 / np.hypot(2.4, 4))
    assert call("camera.imageHeading", data, {**right, "center": [8, 0, 4]}) is None


def test_turning_the_heading_keeps_the_corners(call: Call) -> None:
    for box in random_boxes(3):
        turned = from_json(call("box3d.headingTurned", as_json(box)))
        assert same_corners(box, turned)
        np.testing.assert_allclose(turned.rotation[:, 0], box.rotation[:, 1], atol=1e-12)
        four = as_json(box)
        for _ in range(4):
            four = call("box3d.headingTurned", four)
        assert call("box3d.sameBox", four, as_json(box))


@pytest.mark.parametrize("up", [None, UP, [0, 0, 1]])
def test_angles_are_recovered(call: Call, up: list[float] | None) -> None:
    for box in random_boxes(4):
        angles = call("box3d.anglesDeg", as_json(box), up)
        back = call("box3d.withAnglesDeg", as_json(box), up, angles)
        np.testing.assert_allclose(back["rotation"], box.rotation, atol=1e-9)


def test_yaw_is_about_up_and_zero_away_from_the_camera(call: Call) -> None:
    up = np.array(UP) / np.linalg.norm(UP)
    start = {"center": [0, 0, 4], "size": [1, 1, 1], "rotation": np.eye(3).tolist()}
    flat = call("box3d.withAnglesDeg", start, UP, {"yaw": 0, "pitch": 0, "roll": 0})
    rotation = np.array(flat["rotation"])
    np.testing.assert_allclose(rotation[:, 2], up, atol=1e-9)
    assert rotation[2, 0] > 0.9  # the length axis looks away from the camera
    left = call("box3d.withAnglesDeg", start, UP, {"yaw": 90, "pitch": 0, "roll": 0})
    np.testing.assert_allclose(np.array(left["rotation"])[:, 0], rotation[:, 1], atol=1e-9)
    steep = call("box3d.withAnglesDeg", start, UP, {"yaw": 30, "pitch": 90, "roll": 0})
    angles = call("box3d.anglesDeg", steep, UP)
    assert (angles["yaw"], angles["pitch"], angles["roll"]) == pytest.approx((30, 90, 0), abs=1e-4)
