"""Review in a real browser: changing the selected box in the views along its axes, and by numbers.

tests/page/geometry.test.js has the geometry of the views.
"""

from __future__ import annotations

import numpy as np
import pytest
from browser_page import seen_by_viewer
from review_desk import Desk, middle
from scipy.spatial.transform import Rotation

from annotator.types import ReviewState

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
expect = sync_api.expect


def test_numbers_edges_arrow_keys_and_the_handle_of_the_views_change_a_box(desk: Desk, wait_for) -> None:
    page, before = desk.page, desk.label.box
    revision = desk.project.frames.get(desk.frame).revision
    field = page.get_by_test_id("field-center-x")
    was = field.input_value()
    field.fill("9.5")
    field.press("Escape")
    expect(field).to_have_value(was)
    assert desk.label.state is ReviewState.PROPOSED
    field = page.get_by_test_id("field-size-length")
    field.fill("1.25")
    expect(page.get_by_test_id("label-state")).to_have_text("not saved")
    field.press("Enter")
    wait_for(lambda: desk.label.state is ReviewState.EDITED)
    assert desk.label.box.size_m[0] == pytest.approx(1.25)
    assert desk.project.frames.get(desk.frame).revision == revision + 1
    desk.settled()
    yaw = page.get_by_test_id("field-yaw")
    wanted = float(yaw.input_value()) + 20
    yaw.fill(f"{wanted:.1f}")
    yaw.press("Tab")
    wait_for(lambda: desk.project.frames.get(desk.frame).revision == revision + 2)
    turn = Rotation.from_matrix(before.rotation.T @ desk.label.box.rotation).magnitude()
    assert np.degrees(turn) == pytest.approx(20, abs=0.2)

    # the views
    # an edge moves one face by the same distance
    for view in ("top", "side"):
        before, rect = desk.label.box, desk.box(view).bounding_box()
        assert rect is not None
        pull = 31.0
        right = (rect["x"] + rect["width"] - 1, rect["y"] + rect["height"] / 2)
        desk.drag(right, (right[0] + pull, right[1]))
        wait_for(lambda before=before: np.abs(desk.label.box.size_m - before.size_m).max() > 1e-9)
        after = desk.label.box
        changed = np.flatnonzero(np.abs(after.size_m - before.size_m) > 1e-9)
        assert len(changed) == 1
        side = int(changed[0])
        px_m = before.size_m[side] / (rect["width"] - 2)  # the line around the box is 2 px wide
        assert after.size_m[side] - before.size_m[side] == pytest.approx(pull * px_m, rel=0.02)
        # the opposite face did not move
        shift = before.rotation.T @ (after.center_m - before.center_m)
        assert abs(shift[side]) == pytest.approx((after.size_m[side] - before.size_m[side]) / 2, abs=1e-6)
        assert np.abs(np.delete(shift, side)).max() < 1e-6
        np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-6)
        desk.settled()

    # the handle turns it about its centre
    before = desk.label.box
    handle = middle(page.get_by_test_id("ortho-top").get_by_test_id("rotate-handle"))
    center = middle(desk.box("top"))
    angle = np.radians(30)
    arm = np.subtract(handle, center)
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ arm
    desk.drag(handle, (center[0] + turned[0], center[1] + turned[1]))
    wait_for(lambda: np.abs(desk.label.box.rotation - before.rotation).max() > 0.1)
    after = desk.label.box
    turn = Rotation.from_matrix(before.rotation.T @ after.rotation).as_rotvec()
    assert np.linalg.norm(turn) == pytest.approx(angle, abs=np.radians(1.5))
    assert abs(turn[2]) == pytest.approx(np.linalg.norm(turn), rel=1e-3)  # seen from the top: about the box's own z
    np.testing.assert_allclose(after.center_m, before.center_m, atol=1e-6)
    np.testing.assert_allclose(after.size_m, before.size_m, atol=1e-9)
    desk.settled()  # the new views are along the new axes, where the box is a rectangle


def test_the_3d_view_forwards_keys_and_its_gizmo_moves_the_box(desk_3d: Desk, wait_for) -> None:
    desk, page = desk_3d, desk_3d.page
    first = desk.uid
    where = page.get_by_test_id("viewport").bounding_box()
    assert where is not None
    page.mouse.click(where["x"] + 8, where["y"] + where["height"] - 8)
    page.get_by_test_id("viewport-frame").content_frame.locator("body").evaluate("body => window.focus()")
    desk.press("Space")
    wait_for(lambda: desk.project.labels.get(first).label.state is ReviewState.ACCEPTED)
    page.locator(f'[data-testid="frame-box"][aria-current="true"]:not([data-uid="{first}"])').wait_for()
    desk.settled()
    with page.expect_response(lambda response: '"gizmo":"translate"' in (response.request.post_data or "")) as answer:
        desk.press("t")
    expect(page.get_by_test_id("gizmo-translate")).to_have_attribute("aria-pressed", "true")
    bench = desk.live.server.app.state.viewports.get(answer.value.url.split("/")[-2], "Grace")
    box, uid = desk.label.box, desk.uid
    wait_for(lambda: bench._scene.content.selected == uid)
    node = bench._server.scene.get_handle_by_name("/selected")
    rect = page.get_by_test_id("viewport").bounding_box()
    assert rect is not None
    page.wait_for_timeout(1000)  # until the gizmo is drawn

    def on_axis(axis: int, share: float) -> tuple[float, float]:
        return seen_by_viewer(bench, rect, box.center_m + share * node.scale * box.rotation[:, axis])

    # drags the arrow that is longest on the screen, from its middle outwards
    lengths = [np.linalg.norm(np.subtract(on_axis(axis, 1.0), on_axis(axis, 0.0))) for axis in range(3)]
    axis = int(np.argmax(lengths))
    start, end = on_axis(axis, 0.6), on_axis(axis, 1.0)
    page.mouse.move(*start)
    page.wait_for_timeout(300)
    page.mouse.down()
    page.mouse.move(*end, steps=8)
    expect(page.get_by_test_id("label-state")).to_have_text("not saved")
    assert desk.label.state is ReviewState.PROPOSED
    page.mouse.up()
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.EDITED)
    after = desk.project.labels.get(uid).label.box
    moved = after.center_m - box.center_m
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(moved / np.linalg.norm(moved), box.rotation[:, axis], atol=2e-3)
    np.testing.assert_allclose(after.size_m, box.size_m, atol=1e-9)
    np.testing.assert_allclose(after.rotation, box.rotation, atol=1e-6)
