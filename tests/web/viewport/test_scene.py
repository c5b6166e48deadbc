"""The nodes of a real viser server after a scene was shown."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from viser import TransformControlsEvent

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import RcvConfig
from annotator.recordings import Recording, open_recording
from annotator.types import Box2D, Frame, OrientedBox, PointCloud, ReviewState
from annotator.web.viewport.drawing import (
    MOST_POINTS,
    Draft,
    Gizmo,
    PointColor,
    SceneContent,
    ShownBox,
    arrow_lines,
    box_lines,
)
from annotator.web.viewport.viewports import Viewport
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.drawing_steps import label_steps
from annotator.workflows.workbench.frame_cache import OpenFrame

# Lines of one box.
LINES = len(box_lines(np.ones(3)))


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


def test_the_cloud_is_shown_in_the_camera_frame_in_metres(viewport: Viewport, frames: list[Frame]) -> None:
    shown = viewport.show(SceneContent(("room", 1), frames[0]))
    assert shown.points == shown.shown_points == len(frames[0].cloud)
    cloud = node(viewport, "/cloud")
    np.testing.assert_array_equal(cloud.points, frames[0].cloud.xyz_m)
    assert cloud.points.dtype == np.float32  # half precision would move points by millimetres
    np.testing.assert_array_equal(cloud.colors, frames[0].cloud.rgb)


def test_a_large_cloud_is_thinned_for_display(viewport: Viewport, frames: list[Frame]) -> None:
    xyz = np.random.default_rng(0).normal(0, 1, (MOST_POINTS + 50_000, 3)).astype(np.float32)
    shown = viewport.show(SceneContent(("room", 1), replace(frames[0], cloud=PointCloud(xyz))))
    assert (shown.shown_points, shown.points) == (MOST_POINTS, MOST_POINTS + 50_000)
    assert len(node(viewport, "/cloud").points) == MOST_POINTS
    size = node(viewport, "/cloud").point_size
    content = replace(viewport._scene.content, most_points=40_000)
    assert viewport.show(content).shown_points == 40_000
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
    viewport.show(replace(content, selected=None))
    assert not gizmo.visible
    assert len(node(viewport, "/boxes").points) == LINES * len(boxes)


def test_the_same_scene_sends_nothing_and_a_selection_sends_no_points(
    viewport: Viewport, frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    content = SceneContent(("room", 1), frames[0], boxes, "box0", Gizmo.TRANSLATE)
    viewport.show(content)
    sent(viewport)
    viewport.show(replace(content))
    assert sent(viewport) == []
    viewport.show(replace(content, selected="box1"))
    changed = sent(viewport)
    assert changed
    assert not [message for message in changed if "cloud" in message]


def test_colour_and_point_size_change_without_new_points(viewport: Viewport, frames: list[Frame]) -> None:
    content = SceneContent(("room", 1), frames[0])
    viewport.show(content)
    size = node(viewport, "/cloud").point_size
    sent(viewport)
    viewport.show(replace(content, color=PointColor.DEPTH, point_size=2.0))
    assert sent(viewport) == ["SceneNodeUpdateMessage /cloud colors", "SceneNodeUpdateMessage /cloud point_size"]
    assert node(viewport, "/cloud").point_size == pytest.approx(2 * size)
    assert not np.array_equal(node(viewport, "/cloud").colors, frames[0].cloud.rgb)


def test_another_frame_replaces_the_cloud_and_leaves_the_camera(viewport: Viewport, frames: list[Frame]) -> None:
    viewport.show(SceneContent(("room", 1), frames[0]))
    sent(viewport)
    viewport.show(SceneContent(("room", 1), frames[1]))
    np.testing.assert_array_equal(node(viewport, "/cloud").points, frames[1].cloud.xyz_m)
    assert not [message for message in sent(viewport) if "Camera" in message]
    viewport.show(SceneContent(("room", 2), frames[1]))
    assert [message for message in sent(viewport) if "Camera" in message]


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


def test_a_click_on_a_box_selects_it(
    viewport: Viewport, events: Any, frames: list[Frame], boxes: tuple[ShownBox, ...]
) -> None:
    viewport.show(SceneContent(("room", 1), frames[0], boxes))
    for origin, along in ((boxes[2].box.center_m + np.array([0, -20.0, 0]), 1.0), (np.zeros(3), -1.0)):
        viewport._clicked(SimpleNamespace(ray_origin=origin, ray_direction=(0, along, 0)))
    assert [event["uid"] for event in events.of("select")] == ["box2"]
