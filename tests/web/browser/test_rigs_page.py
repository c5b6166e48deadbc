"""Rigs on the page: all cameras are added by one click, and the outline of another camera's label is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from room_api import label_object

from annotator.project import WriteContext, create_project
from annotator.types import Source

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page


def test_virtual_cameras_are_added_and_share_a_label(start: Page, shop: Shop) -> None:
    create_project(shop.live.settings.projects_root, "rig", ("car",)).close()
    shop.projects.append("rig")
    start.reload()
    start.get_by_test_id("add-recording-rig").click()
    start.get_by_test_id("folder-clouds").click()
    start.get_by_test_id("add-drive").click()
    added = start.get_by_test_id("added-recording")
    expect(added).to_have_text(["drive: 1 frame"])
    # another choice makes the button usable again
    start.get_by_test_id("which-cameras").select_option(label="4 virtual cameras all around the LiDAR")
    start.get_by_test_id("add-drive").click()
    expect(added.nth(4)).to_have_text("drive@around-270: 1 frame")
    start.get_by_test_id("dialog-done").click()
    project, tag = shop.live.context.project("rig"), start.get_by_test_id("editor-tag")
    uid = label_object(project, 2, -10.0)
    start.goto("/#/rig/review/3")
    expect(tag).to_have_text(["car #3 · around-000"])
    # what changes in the other camera is shown at once
    project.labels.delete(2, uid, WriteContext(project.frames.get(2).revision, "maria", Source.MANUAL))
    expect(tag).to_have_count(0)
    start.goto("/#/rig/label/3")
    start.get_by_test_id("image-editor").locator("img.picture[src]").wait_for()
    expect(tag).to_have_count(0)
    label_object(project, 2, -10.0)
    expect(tag).to_have_text(["car #3 · around-000"])
    start.goto("/#/rig/alignment/3")
    expect(start.get_by_test_id("correction-effect")).to_contain_text("no calibration to correct")
    expect(start.get_by_test_id("keep-correction")).to_be_hidden()
    expect(start.get_by_test_id("estimate-up")).to_be_visible()
