"""Rigs on the page: all cameras are added by one click, and the outline of another camera's label is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from room_api import label_object, rig_settings

from annotator.project import WriteContext
from annotator.types import Source
from annotator.web.security import ServerSettings

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Page


@pytest.fixture
def web_settings(tmp_path: Path) -> ServerSettings:
    return rig_settings(tmp_path)


def test_virtual_cameras_are_added_and_share_a_label(start: Page, live: Live) -> None:
    start.get_by_test_id("add-recording-room").click()
    start.get_by_test_id("folder-clouds").click()
    start.get_by_test_id("add-drive").click()
    added = start.get_by_test_id("added-recording")
    expect(added).to_have_text(["drive: 1 frame"])
    # another choice makes the button usable again
    start.get_by_test_id("which-cameras").select_option(label="4 virtual cameras all around the LiDAR")
    start.get_by_test_id("add-drive").click()
    expect(added.nth(4)).to_have_text("drive@around-270: 1 frame")
    start.get_by_test_id("dialog-done").click()
    project, tag = live.context.project("room"), start.get_by_test_id("editor-tag")
    uid = label_object(project, 2, -10.0)
    start.goto("/#/room/review/3")
    expect(tag).to_have_text(["car #3 · around-000"])
    # what changes in the other camera is shown at once
    project.labels.delete(2, uid, WriteContext(project.frames.get(2).revision, "maria", Source.MANUAL))
    expect(tag).to_have_count(0)
    start.goto("/#/room/label/3")
    start.get_by_test_id("image-editor").locator("img.picture[src]").wait_for()
    expect(tag).to_have_count(0)
    label_object(project, 2, -10.0)
    expect(tag).to_have_text(["car #3 · around-000"])
    start.goto("/#/room/alignment/3")
    expect(start.get_by_test_id("correction-effect")).to_contain_text("no calibration to correct")
    expect(start.get_by_test_id("keep-correction")).to_be_hidden()
    expect(start.get_by_test_id("estimate-up")).to_be_visible()
