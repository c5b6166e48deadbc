"""Adding bags whose topics must be chosen, in a real browser."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from bag_writer import BagWriter
from ros_takes import SIZE, START_NS, K, write_camera, write_mount, write_scan

from annotator.recordings import open_recording
from annotator.recordings.recording import stored_options

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page


def test_topics_and_calibrations_are_chosen_with_a_preview(start: Page, shop: Shop, tmp_path: Path) -> None:
    live, root = shop.live, shop.folder
    (tmp_path / "left and right").mkdir()
    with BagWriter(tmp_path / "left and right", "ros1") as bag:
        write_mount(bag)
        write_scan(bag, START_NS)
        for name in ("left", "right"):
            write_camera(bag, name, START_NS)
    shutil.copy(bag.path, root / "two_cameras.bag")
    with BagWriter(tmp_path, "ros1") as bag:
        write_camera(bag, "camera/color", START_NS)
        bag.image("/camera/depth/image_raw", START_NS, np.full(SIZE[::-1], 2000, np.uint16), "16UC1")
        for name in ("camera_info", "other_info"):
            bag.info(f"/camera/depth/{name}", START_NS, SIZE, K)
    shutil.copy(bag.path, root / "depth.bag")
    live.client.post("/api/projects", json={"name": "drive", "classes": ["car"]})
    shop.projects.append("drive")
    start.reload()
    start.get_by_test_id("add-recording-drive").click()
    start.get_by_test_id(f"folder-{root.name}").click()
    start.get_by_test_id("add-two_cameras.bag").click()
    dialog = start.get_by_test_id("topics-dialog")
    expect(dialog.get_by_test_id("topics-problem")).to_contain_text("choose one of its topics with Images")
    dialog.get_by_test_id("dialog-add").click()
    expect(dialog).to_contain_text("Please choose topics that can be read first.")
    dialog.get_by_test_id("topic-image").select_option("/right/image_raw")
    picture = dialog.get_by_test_id("topics-preview")
    expect(picture).to_be_visible()
    assert picture.evaluate("image => image.naturalWidth") == 32
    expect(dialog.get_by_test_id("topic-points")).to_contain_text("/points (chosen automatically)")
    expect(dialog.get_by_test_id("topic-camera_info")).to_contain_text("/right/camera_info (chosen automatically)")
    expect(dialog.get_by_test_id("topic-depth_info")).to_be_hidden()
    dialog.get_by_test_id("dialog-add").click()
    expect(start.get_by_test_id("added-recording")).to_have_text("two_cameras: 1 frame")
    (stored,) = live.context.project("drive").recordings.all()
    assert stored.options == '{"image":"/right/image_raw"}'
    assert len(open_recording(stored.path, stored_options(stored.options))) == 1

    start.get_by_test_id("add-depth.bag").click()
    expect(dialog.get_by_test_id("topics-problem")).to_contain_text("topics with Depth calibration: /camera/depth/c")
    dialog.get_by_test_id("topic-depth_info").select_option("/camera/depth/other_info")
    expect(dialog.get_by_test_id("topics-preview")).to_be_visible()
    expect(dialog.get_by_test_id("topic-camera_info")).to_contain_text("/camera/color/camera_info (chosen")
    expect(dialog.get_by_test_id("topic-camera_info")).to_have_value("")
    dialog.get_by_role("button", name="Close").click()
    for name in ("two_cameras.bag", "depth.bag"):
        (root / name).unlink()
