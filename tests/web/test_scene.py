"""What a viewport shows: the nodes of a real viser server, points, colours, lines of boxes and views, and picking."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from viser import TransformControlsEvent

from annotator.geometry.ground import Ground, find_ground
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import project
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import first_views
from annotator.recordings import Recording, open_recording
from annotator.types import Box2D, Camera, Frame, OrientedBox, PointCloud, ReviewState
from annotator.web.viewport.drawing import (
    Ahead,
    Draft,
    Gizmo,
    PointColor,
    SceneContent,
    ShownBox,
    box_lines,
    frustum_lines,
    pick,
    placed_box_lines,
    point_colors,
    scene_up,
    shown_points,
    view_placement,
)
from annotator.web.viewport.faces import LEAST_M
from annotator.web.viewport.guides import arrow_lines
from annotator.web.viewport.palette import PALETTES, Theme
from annotator.web.viewport.viewports import Viewport
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.drawing_steps import label_steps
from annotator.workflows.workbench.frame_cache import OpenFrame

DARK, LIGHT = PALETTES[Theme.DARK], PALETTES[Theme.LIGHT]
# Lines of one box.
LINES = len(box_lines(np.ones(3)))


class SentEvents(list[dict[str, Any]]):
    """The events that a viewport has sent."""

    def of(self, event: str) -> list[dict[str, Any]]:
        return [message for message in self if message["event"] == event]


@pytest.fixture
def events() -> SentEvents:
    return SentEvents()


@pytest.fixture
def viewport(events: SentEvents) -> Iterator[Viewport]:
    """A viewport with a real viser server, without a browser."""
    viewport = Viewport("0123456789abcdef", "Ada", "room", lambda message, _: events.append(message))
    yield viewport
    viewport.close()


@pytest.fixture(scope="module")
def recording(generated: Path) -> Recording:
    return open_recording(generated / "people")


@pytest.fixture(scope="module")
def frames(recording: Recording) -> list[Frame]:
    return [recording.frame(index) for index in range(2)]


@pytest.fixture(scope="module")
def boxes(recording: Recording, frames: list[Frame]) -> tuple[ShownBox, ...]:
    truth = load_truth(recording, 0, frames[0])
    states = [ReviewState.PROPOSED, ReviewState.ACCEPTED, ReviewState.EDITED]
    return tuple(ShownBox(f"box{n}", t.box, state) for n, (t, state) in enumerate(zip(truth, states, strict=False)))


def node(viewport: Viewport, name: str) -> Any:
    return viewport._server.scene.get_handle_by_name(name)


def sent(viewport: Viewport) -> list[str]:
    """Kinds of the messages for a browser since the last call, in order."""
    buffer = viewport._server._websock_server.get_message_buffer()
    first = getattr(viewport, "seen_messages", 0)
    viewport.seen_messages = buffer.message_counter  # type: ignore[attr-defined]
    known = sorted(buffer.message_from_id.items())
    return [
        " ".join(
            [type(message).__name__, getattr(message, "name", ""), *sorted(getattr(message, "updates", ()))]
        ).strip()
        for number, message in known
        if number >= first
    ]


def assert_same_cloud(shown: Any, frame: Frame) -> None:
    """All points of a frame, each with its colour, in any order."""
    (rgb, xyz), cloud = (shown.colors, shown.points), frame.cloud
    assert cloud.rgb is not None
    orders = [np.lexsort([*points.T, *colors.T]) for points, colors in ((xyz, rgb), (cloud.xyz_m, cloud.rgb))]
    np.testing.assert_array_equal(xyz[orders[0]], cloud.xyz_m[orders[1]])
    np.testing.assert_array_equal(rgb[orders[0]], cloud.rgb[orders[1]])


def test_the_cloud_is_shown_in_the_camera_frame_in_metres(viewport: Viewport, frames: list[Frame]) -> None:
    assert viewport._server.get_host() == "127.0.0.1", "its server listens on loopback only"
    shown = viewport.show(SceneContent(("room", 1), frames[0]))
    assert shown == (len(frames[0].cloud), len(frames[0].cloud))
    cloud = node(viewport, "/cloud")
    assert_same_cloud(cloud, frames[0])
    assert cloud.points.dtype == np.float32  # half precision would move points by millimetres


def test_a_large_cloud_is_thinned_for_display(viewport: Viewport, frames: list[Frame]) -> None:
    xyz = np.random.default_rng(0).normal(0, 1, (200_000, 3)).astype(np.float32)
    content = SceneContent(("room", 1), replace(frames[0], cloud=PointCloud(xyz)), most_points=150_000)
    assert viewport.show(content) == (150_000, 200_000)
    assert len(node(viewport, "/cloud").points) == 150_000
    size = node(viewport, "/cloud").point_size
    assert viewport.show(replace(content, most_points=40_000))[0] == 40_000
    assert node(viewport, "/cloud").point_size > 1.5 * size


def test_boxes_are_lines_in_the_colour_of_their_state(
    viewport: Viewport, frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    viewport.show(SceneContent(("room", 1), frames[0], boxes))
    lines = node(viewport, "/boxes")
    assert lines.points.shape == (LINES * len(boxes), 2, 3)
    colors = lines.colors.reshape(len(boxes), -1, 3)
    assert len(np.unique(colors[:, 0], axis=0)) == len(boxes)
    viewport.show(SceneContent(("room", 1), frames[0], ()))
    assert node(viewport, "/boxes") is None


def test_the_selected_box_is_attached_to_the_gizmo(
    viewport: Viewport, frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    content = SceneContent(("room", 1), frames[0], boxes, "box1", Gizmo.TRANSLATE)
    viewport.show(content)
    gizmo, selected = node(viewport, "/selected"), boxes[1].box
    np.testing.assert_allclose(gizmo.position, selected.center_m)
    turned = Rotation.from_quat(gizmo.wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(turned, selected.rotation, atol=1e-9)
    assert len(node(viewport, "/boxes").points) == LINES * (len(boxes) - 1)
    assert node(viewport, "/selected/lines").thickness > node(viewport, "/boxes").thickness
    assert (gizmo.visible, gizmo.disable_axes, gizmo.disable_rotations) == (True, False, True)
    viewport.show(replace(content, gizmo=Gizmo.ROTATE))
    assert (gizmo.disable_axes, gizmo.disable_sliders, gizmo.disable_rotations) == (True, True, False)
    viewport.show(replace(content, gizmo=Gizmo.OFF))
    assert (gizmo.visible, gizmo.disable_axes, gizmo.disable_rotations) == (True, True, True)
    assert node(viewport, "/selected/faces") is None
    viewport.show(replace(content, gizmo=Gizmo.FACES))
    handles = node(viewport, "/selected/faces")
    np.testing.assert_allclose(np.abs(handles.batched_positions).sum(axis=0), selected.size_m, rtol=1e-6)
    viewport.show(replace(content, gizmo=Gizmo.ROTATE))
    assert not handles.visible
    viewport.show(replace(content, selected=None))
    assert not gizmo.visible
    assert len(node(viewport, "/boxes").points) == LINES * len(boxes)


def test_colour_and_point_size_change_without_new_points(viewport: Viewport, frames: list[Frame]) -> None:
    content = SceneContent(("room", 1), frames[0])
    viewport.show(content)
    size = node(viewport, "/cloud").point_size
    sent(viewport)
    viewport.show(replace(content, color=PointColor.DEPTH, point_size=2.0))
    assert sent(viewport) == ["SceneNodeUpdateMessage /cloud colors", "SceneNodeUpdateMessage /cloud point_size"]
    assert node(viewport, "/cloud").point_size == pytest.approx(2 * size)
    assert not np.array_equal(
        np.sort(node(viewport, "/cloud").colors, axis=None), np.sort(np.asarray(frames[0].cloud.rgb), axis=None)
    )


def test_another_frame_replaces_the_cloud_and_leaves_the_camera(viewport: Viewport, frames: list[Frame]) -> None:
    viewport.show(SceneContent(("room", 1), frames[0]))
    sent(viewport)
    viewport.show(SceneContent(("room", 1), frames[1]))
    assert_same_cloud(node(viewport, "/cloud"), frames[1])
    assert not [message for message in sent(viewport) if "Camera" in message]
    viewport.show(SceneContent(("room", 2), frames[1]))
    assert [message for message in sent(viewport) if "Camera" in message]


def test_points_that_were_sent_ahead_are_shown_without_being_sent(viewport: Viewport, frames: list[Frame]) -> None:
    here, there = (Ahead(frame, find_ground(frame.cloud.xyz_m, scene_up(frame))) for frame in frames)
    content = SceneContent(("room", 1), frames[0], ground=here.ground)

    def messages(shown: SceneContent) -> list[str]:
        sent(viewport)
        assert viewport.show(shown) == (len(shown.frame.cloud),) * 2  # type: ignore[union-attr]
        visible = [name for name in ("/cloud", "/cloud2") if (cloud := node(viewport, name)) and cloud.visible]
        assert len(visible) == 1
        assert_same_cloud(node(viewport, visible[0]), shown.frame)  # type: ignore[arg-type]
        return [message for message in sent(viewport) if message.startswith("PointCloudMessage")]

    assert messages(content) == ["PointCloudMessage /cloud"]
    assert messages(replace(content, ahead=there)) == ["PointCloudMessage /cloud2"]
    assert messages(replace(content, frame=frames[1], ground=there.ground)) == []
    assert messages(content) == [], "the last one is still there"
    # other points of the same frames
    assert viewport.show(replace(content, ahead=there, most_points=1000))[0] == 1000
    assert viewport.show(replace(content, frame=frames[1], ground=there.ground, most_points=1000))[0] == 1000


def drawn_draft(frame: Frame, box: OrientedBox, drags: int) -> Draft:
    """A draft with the given number of drawn boxes, each of which encloses the true box."""
    image_box = box_on_image(frame.camera, box, "person")
    assert image_box is not None
    drawn: list[Box2D | None] = []
    found = label_steps(OpenFrame(frame), image_box, drawn, RcvConfig())
    for _ in range(drags):
        view = found.views[len(drawn)]
        seen = box_corners(box) @ view.axes[:2].T
        drawn.append(view.box_px(np.stack([seen.min(axis=0), seen.max(axis=0)], axis=1), "person"))
        found = label_steps(OpenFrame(frame), image_box, drawn, RcvConfig())
    return Draft(image_box, found.steps[-1].views, found.box)


@pytest.mark.parametrize("drags", [0, 1, 2, 4])
def test_a_draft_has_a_frustum_two_pictures_two_arrows_and_the_box_so_far(
    viewport: Viewport, frames: list[Frame], boxes: tuple[ShownBox, ...], drags: int
) -> None:
    draft = drawn_draft(frames[0], boxes[0].box, drags)
    viewport.show(SceneContent(("room", 1), frames[0], draft=draft))
    assert node(viewport, "/draft/frustum") is not None
    assert node(viewport, "/draft/view0") is not None
    assert node(viewport, "/draft/view1") is not None
    arrows = node(viewport, "/draft/axes")
    one = arrow_lines(np.zeros(3), np.ones(3), np.ones(3))
    assert arrows.points.shape == (2 * len(one), 2, 3)
    # red in linear RGB
    assert arrows.colors.reshape(-1, 3)[0].tolist() == [255, 10, 6]
    assert (node(viewport, "/draft/box") is not None) == (drags >= 2)
    if drags >= 2:
        assert draft.box is not None
        distance = np.linalg.norm(draft.box.center_m - boxes[0].box.center_m)
        assert distance < 0.3 * boxes[0].box.size_m.max()
    viewport.show(SceneContent(("room", 1), frames[0]))
    assert node(viewport, "/draft/frustum") is None
    assert node(viewport, "/draft/view0") is None


def drag(viewport: Viewport, phase: str) -> None:
    """Calls the gizmo's callback like viser does on a browser's message."""
    gizmo = node(viewport, "/selected")
    event = TransformControlsEvent(client=None, client_id=0, target=gizmo, phase=phase)
    asyncio.run(viewport._gizmo_moved(event))


def test_a_dragged_gizmo_sends_its_box_and_stays_during_updates(
    viewport: Viewport, events: Any, frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    content = SceneContent(("room", 1), frames[0], boxes, "box1", Gizmo.TRANSLATE)
    viewport.show(content)
    gizmo, box = node(viewport, "/selected"), boxes[1].box
    drag(viewport, "start")
    assert events.of("box") == []
    gizmo.position = box.center_m + np.array([0.1, 0, 0])
    drag(viewport, "update")
    viewport.show(replace(content))  # an update by the page, or another operator, during the drag
    np.testing.assert_allclose(gizmo.position, box.center_m + np.array([0.1, 0, 0]))
    drag(viewport, "end")
    moved, final = events.of("box")
    assert (moved["final"], final["final"]) == (False, True)
    assert (final["uid"], final["workbench"]) == ("box1", viewport.id)
    np.testing.assert_allclose(final["box"]["center"], box.center_m + np.array([0.1, 0, 0]))
    np.testing.assert_allclose(final["box"]["rotation"], box.rotation, atol=1e-9)
    np.testing.assert_allclose(final["box"]["size"], box.size_m)
    viewport.show(replace(content))
    np.testing.assert_allclose(gizmo.position, box.center_m)


def test_a_dragged_face_sends_its_box_and_the_opposite_face_stays(
    viewport: Viewport, events: Any, frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    content = SceneContent(("room", 1), frames[0], boxes, "box1", Gizmo.FACES)
    viewport.show(content)
    box, eye_m = boxes[1].box, np.array([0.3, -2.0, -1.0])

    def pull(phase: str, face: int, by_m: float) -> None:
        axis, sign = face % 3, 1 if face < 3 else -1
        grabbed = box.center_m + sign * 0.5 * box.size_m[axis] * box.rotation[:, axis]
        event = SimpleNamespace(
            client=SimpleNamespace(camera=SimpleNamespace(position=eye_m)),
            phase=phase,
            instance_index=face,
            start_position=grabbed,
            # anywhere on the ray through the place to which the face is pulled
            end_position=eye_m + 0.7 * (grabbed + by_m * sign * box.rotation[:, axis] - eye_m),
        )
        asyncio.run(viewport._face_dragged(event))  # type: ignore[arg-type]

    for face, by_m in ((0, 0.2), (1, -0.1), (5, 0.3), (3, -9.0)):
        events.clear()
        for phase in ("start", "update"):
            pull(phase, face, by_m)
        # an update by the page during the drag leaves it where it is dragged
        lines = node(viewport, "/selected/lines").points.copy()
        viewport.show(replace(content))
        np.testing.assert_array_equal(node(viewport, "/selected/lines").points, lines)
        pull("end", face, by_m)
        assert [event["final"] for event in events.of("box")] == [False, True]
        sent_box = events.of("box")[-1]["box"]
        axis, sign = face % 3, 1 if face < 3 else -1
        size_m = box.size_m.copy()
        size_m[axis] = max(size_m[axis] + by_m, LEAST_M)
        np.testing.assert_allclose(sent_box["size"], size_m, atol=1e-6)
        opposite, still = (
            np.array(center) - sign * 0.5 * size[axis] * box.rotation[:, axis]
            for center, size in ((sent_box["center"], sent_box["size"]), (box.center_m, box.size_m))
        )
        np.testing.assert_allclose(opposite, still, atol=1e-6)
        viewport.show(replace(content))


def test_a_box_is_drawn_as_its_edges_and_an_arrow_through_its_front(boxes: tuple[ShownBox, ...]) -> None:
    truth = boxes[0].box
    lines = placed_box_lines(truth)
    assert lines.shape == (21, 2, 3)
    corners = box_corners(truth)
    ends = lines[:12].reshape(-1, 3)
    nearest = np.linalg.norm(ends[:, None] - corners, axis=2)
    assert nearest.min(axis=1).max() < 1e-5
    np.testing.assert_array_equal(np.bincount(nearest.argmin(axis=1)), np.full(8, 3))
    # in the box's own axes: from the middle of the top, along its heading, to a head in front of the front face
    shaft, head = ((part - truth.center_m) @ truth.rotation for part in (lines[12], lines[13:]))
    top_m, front_m = truth.size_m[2] / 2, truth.size_m[0] / 2
    tip = [front_m + 0.4 * truth.size_m.mean(), 0, top_m]
    np.testing.assert_allclose(shaft, [[0, 0, top_m], tip], atol=1e-5)
    assert (head[..., 0] > front_m).all()
    np.testing.assert_allclose(head[:4, 0], [tip] * 4, atol=1e-5)


@pytest.mark.parametrize("distortion", [(), (0.08, -0.1, 0.001, -0.002, 0.02)])
def test_the_frustum_projects_onto_the_image_box(frames: list[Frame], distortion: tuple[float, ...]) -> None:
    frame, camera = frames[0], frames[0].camera
    bent = Camera(camera.width_px, camera.height_px, camera.fx, camera.fy, camera.cx, camera.cy, distortion)
    seen = Frame("0", 0, bent, frame.rgb, frame.cloud)
    box = Box2D("person", 40.0, 30.0, 200.0, 180.0)
    lines = frustum_lines(seen, box)
    px = project(bent, lines[:4, 1])
    corners = np.array([[40, 30], [200, 30], [200, 180], [40, 180]])
    np.testing.assert_allclose(px, corners, atol=0.05)
    np.testing.assert_array_equal(lines[:4, 0], 0)
    border = project(bent, lines[4:, 0])
    on_edge = np.abs(border[:, [0, 0, 1, 1]] - [40, 200, 30, 180]).min(axis=1)
    assert on_edge.max() < 0.05


def test_a_view_is_placed_in_front_of_its_points_with_each_pixel_in_place(
    frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    frame = frames[0]
    image_box = box_on_image(frame.camera, boxes[0].box, "person")
    assert image_box is not None
    views = first_views(frame, image_box, RcvConfig())
    assert views is not None
    for view in views:
        seen_from, center, looks_at = view_placement(view)
        right, down, into = view.axes
        assert (view.xyz_m @ into).min() > center @ into
        # the centre of pixel (0, 0), computed from the placement's size and from the view's origin
        height_px, width_px = view.rgb.shape[:2]
        half = 0.5 * view.extent_m * (1 - 1 / np.array([width_px, height_px]))
        corner = center - half[0] * right - half[1] * down
        np.testing.assert_allclose([corner @ right, corner @ down], view.origin_m, atol=1e-9)
        along = looks_at - seen_from
        np.testing.assert_allclose(along / np.linalg.norm(along), into, atol=1e-9)


UP = np.array([0.0, -1.0, 0.0])


def ground_of(cloud: PointCloud) -> Ground:
    return find_ground(cloud.xyz_m, UP)


def frame_of(xyz: np.ndarray, rgb: np.ndarray | None = None, reflectance: np.ndarray | None = None) -> Frame:
    camera = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
    cloud = PointCloud(xyz.astype(np.float32), rgb, reflectance)
    return Frame("0", 0, camera, np.zeros((6, 8, 3), np.uint8), cloud)


def test_a_thinned_point_keeps_its_own_colour_and_the_first_points_are_everywhere() -> None:
    n = 1000
    xyz = np.column_stack([np.arange(n), np.zeros(n), np.ones(n)])
    rgb = np.column_stack([np.arange(n) % 256, np.arange(n) // 256, np.zeros(n)]).astype(np.uint8)
    shown = shown_points(frame_of(xyz, rgb).cloud, 100)
    assert len(shown) == 100
    assert 250 < shown.xyz_m[:50, 0].mean() < 750  # a browser may draw only these
    colors = point_colors(shown, PointColor.RGB, ground_of(shown), DARK).astype(int)
    np.testing.assert_array_equal(colors[:, 0] + 256 * colors[:, 1], shown.xyz_m[:, 0].astype(int))


@pytest.mark.parametrize("what", ["nothing", "rgb", "reflectance", "empty"])
def test_every_cloud_has_every_kind_of_colour(what: str) -> None:
    rng, n = np.random.default_rng(0), 0 if what == "empty" else 50
    rgb = rng.integers(0, 256, (n, 3)).astype(np.uint8) if what == "rgb" else None
    reflectance = rng.random(n).astype(np.float32) if what == "reflectance" else None
    cloud = frame_of(rng.normal(0, 1, (n, 3)) + np.array([0, 0, 5]), rgb, reflectance).cloud
    for color in PointColor:
        colors = point_colors(cloud, color, ground_of(cloud), DARK)
        assert (colors.shape, colors.dtype) == ((n, 3), np.uint8)


def test_height_colours_show_the_height_above_the_ground() -> None:
    height = np.tile(np.linspace(0, 2, 100), 20)
    ahead = np.repeat(np.linspace(2, 12, 20), 100)
    slope = frame_of(np.column_stack([np.zeros(2000), 0.05 * ahead - height, ahead])).cloud
    colors = point_colors(slope, PointColor.HEIGHT, ground_of(slope), DARK).reshape(20, 100, 3).astype(int)
    assert (colors[:, 0, 2] > colors[:, 0, 0]).all()  # low: blue
    assert (colors[:, -1, 0] > colors[:, -1, 2]).all()  # high: red


def test_points_are_left_out_by_height_and_by_the_selected_box_and_those_in_no_box_stand_out(
    viewport: Viewport, frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    content = SceneContent(("room", 1), frames[0], boxes, "box1")
    total, _ = viewport.show(content)
    ground = find_ground(frames[0].cloud.xyz_m, scene_up(frames[0]))
    above_m = ground.above_m(frames[0].cloud.xyz_m)
    standing = viewport.show(replace(content, hide_ground=True))[0]
    assert standing == np.count_nonzero(above_m > ground.thickness_m) < 0.9 * total
    assert viewport.show(replace(content, most_height_m=1.0))[0] == np.count_nonzero(above_m < 1.0)
    near = viewport.show(replace(content, only_selected=True))[0]
    assert np.count_nonzero(contains(boxes[1].box, frames[0].cloud.xyz_m)) < near < 0.5 * total
    assert node(viewport, "/boxes") is None, "other boxes are left out, too"
    assert viewport.show(replace(content, most_height_m=0.0, hide_ground=True))[0] == 0
    assert node(viewport, "/cloud") is None
    viewport.show(replace(content, color=PointColor.UNLABELLED))
    cloud = node(viewport, "/cloud")
    stands = ground.above_m(cloud.points) >= ground.thickness_m
    in_a_box = np.any([contains(shown.box, cloud.points) for shown in boxes], axis=0)
    before = node(viewport, "/guides").colors[0].copy()
    bright = (cloud.colors == DARK.unlabelled).all(axis=1)
    np.testing.assert_array_equal(bright, stands & ~in_a_box)
    sent(viewport)
    viewport.show(replace(content, color=PointColor.UNLABELLED, boxes=boxes[1:]))
    assert "SceneNodeUpdateMessage /cloud colors" in sent(viewport), "a box was removed"
    assert np.count_nonzero((cloud.colors == DARK.unlabelled).all(axis=1)) > bright.sum()
    # the theme is that of the page
    viewport.show(replace(content, color=PointColor.UNLABELLED, theme=Theme.LIGHT))
    np.testing.assert_array_equal((cloud.colors == LIGHT.unlabelled).all(axis=1), bright)
    assert (node(viewport, "/guides").colors[0] != before).any()


def test_a_box_may_have_another_colour_than_that_of_its_state(
    viewport: Viewport, frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    violet = replace(boxes[0], color=(255, 0, 255))
    viewport.show(SceneContent(("room", 1), frames[0], (violet, *boxes[1:])))
    colors = node(viewport, "/boxes").colors.reshape(len(boxes), -1, 3)
    assert colors[0, 0].tolist() == [255, 0, 255]
    assert colors[1, 0].tolist() != [255, 0, 255]


unit = st.floats(-1, 1)


def box_at(z_m: float, size: float = 1.0, turn: tuple[float, float, float] = (0, 0, 0)) -> OrientedBox:
    return OrientedBox.from_parts(
        np.array([0, 0, z_m]), Rotation.from_rotvec(turn).as_matrix(), np.array([size, size, size])
    )


AHEAD = np.array([0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)


def test_the_nearest_box_on_the_ray_is_picked() -> None:
    boxes = [box_at(9), box_at(3), box_at(6), box_at(-3)]
    assert pick(boxes, ORIGIN, AHEAD) == 1
    assert pick(boxes, ORIGIN, -AHEAD) == 3
    assert pick(boxes, ORIGIN, np.array([1.0, 0, 0])) is None
    # boxes around the ray's origin come last
    assert pick([box_at(0, 20), box_at(3)], ORIGIN, AHEAD) == 1
    assert pick([box_at(0, 20), box_at(0, 2)], ORIGIN, AHEAD) == 1


@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit), st.tuples(unit, unit, unit))
def test_a_ray_to_a_point_in_a_box_meets_it(turn: tuple, inside: tuple, start: tuple) -> None:
    box = box_at(5, 1.0, turn)
    target = box.T_camera_box.apply(0.49 * np.array(inside))
    origin = np.array(start)
    assert pick([box], origin, target - origin) == 0
