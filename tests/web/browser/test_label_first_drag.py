"""Label mode with detectors: one drag on the image, dashed boxes on the views, Enter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import answers_drag
from label_bench import EDGES, Bench

from annotator.detection import pretrained
from annotator.geometry.iou import iou_3d
from annotator.types import Box2D, BoxKind, DetectorKind, Suggestion
from annotator.workflows.detectors import AGNOSTIC

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from playwright.sync_api import Request

    from annotator.workflows.detectors import Detectors


class TwoKinds:
    """A class-agnostic detector with a small box for the visible part, and a large one for the whole object."""

    labels, fingerprint = AGNOSTIC, "two kinds"

    def detect(self, images: Sequence[Any]) -> list[list[Box2D]]:
        found = []
        for image in images:
            height, width = image.rgb.shape[:2]
            found.append(
                [
                    Box2D(label, share * width, share * height, (1 - share) * width, (1 - share) * height, 0.9)
                    for label, share in zip(AGNOSTIC, (0.1, 0.3), strict=True)
                ]
            )
        return found


def test_another_kind_of_boxes_brings_its_own_suggestions(bench: Bench, teach: Callable[..., None]) -> None:
    teach(class_agnostic=True, view=TwoKinds())
    page = bench.page
    first = bench.draw_on_image(0)["steps"][0]["suggested"]
    dashed = page.locator(".views .box.suggested")
    expect(dashed.first).to_be_visible()
    bench.saved()
    with page.expect_response("**/label/steps") as answer:
        page.keyboard.press("b")
    second = answer.value.json()["steps"][0]["suggested"]
    assert answer.value.request.post_data_json["box_kind"] == "box"
    edges = [[[box[edge] for edge in EDGES] for box in boxes] for boxes in (first, second)]
    assert edges[0] != edges[1]
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "1")
    bench.saved()
    assert bench.state["image_boxes"]["box_kind"] == "box"


def test_one_drag_and_enter_make_a_label(
    bench: Bench, knowing: Callable[..., Detectors], teach: Callable[..., None]
) -> None:
    perfect = knowing("people", kind=BoxKind.SILHOUETTE).view
    teach(name=pretrained.NAME, view=perfect)
    page = bench.page
    posts: list[str] = []

    def record(request: Request) -> None:
        if request.method == "POST":
            posts.append(request.url.rsplit("/", 1)[-1])

    page.on("request", record)
    drawn = bench.draw_on_image(0)
    dashed = page.locator(".views .box.suggested")
    expect(dashed).to_have_count(4)
    outline = page.get_by_test_id("image-editor").get_by_test_id("editor-overlay")
    expect(outline).to_have_count(1)
    hint = page.get_by_test_id("hint")
    expect(hint).to_contain_text("Enter accepts")
    assert hint.evaluate("e => e.scrollHeight <= e.clientHeight + 1 && e.scrollWidth <= e.clientWidth"), "it is not cut"
    expect(page.get_by_test_id("views-source")).to_contain_text(pretrained.TITLE)
    page.remove_listener("request", record)
    assert posts == ["object"], "one request a drag"
    assert bench.labels == []
    page.keyboard.press("Enter")
    row = page.get_by_test_id("object")
    expect(row).to_have_attribute("data-boxes", "5")
    expect(dashed).to_have_count(0)
    bench.saved()
    (label,) = bench.labels
    assert label.suggestion == Suggestion(pretrained.TITLE, perfect.fingerprint)
    np.testing.assert_allclose(label.box.center_m, drawn["box"]["center"], atol=1e-9)
    assert iou_3d(label.box, bench.scene.objects[0].box) > 0.5
    assert bench.live.client.get(f"{bench.api}/statistics").json()["effort"]["actions_a_box"] == 2
    # undo returns to the dashed boxes, then to the empty image
    page.keyboard.press("Control+z")
    expect(dashed).to_have_count(4)
    expect(row).to_have_attribute("data-boxes", "1")
    assert bench.labels == []
    page.keyboard.press("Control+z")
    expect(row).to_have_count(0)
    page.keyboard.press("Control+Shift+z")
    page.keyboard.press("Control+Shift+z")
    expect(row).to_have_attribute("data-uid", label.uid)
    bench.saved()
    # the dashed boxes follow a corrected one
    page.keyboard.press("Escape")
    drawn = bench.draw_on_image(1)
    expect(dashed).to_have_count(4)
    (front, *_), (suggested, *_) = drawn["steps"][0]["views"], drawn["steps"][0]["suggested"]
    bench.wait_for_view(0, front)
    with page.expect_response(answers_drag(1)) as answer:
        bench.pull(0, (0.3, 1.0), (0.3, 0.5))  # the lower edge, to the middle
    following = answer.value.json()["drawn"]
    expect(dashed).to_have_count(3)
    bench.saved()
    assert following["box"]["size"][2] < 0.75 * drawn["box"]["size"][2]
    # a correction on the second step confirms the first one
    bench.wait_for_view(3, following["steps"][1]["views"][1])
    with page.expect_response(answers_drag(3)):
        bench.pull(3, (1.0, 0.3), (0.9, 0.3))
    expect(dashed).to_have_count(1)
    page.get_by_test_id("accept-all").click()
    expect(row.last).to_have_attribute("data-boxes", "5")
    bench.saved()
    label = bench.labels[1]
    assert label.suggestion == Suggestion(pretrained.TITLE, perfect.fingerprint, corrected=True)
    stored = [box for _, box in bench.state["objects"][1]["views"]]
    assert abs(stored[0]["y_max"] - (suggested["y_min"] + suggested["y_max"]) / 2) < 3


class BlockedDetector:
    """A detector that blocks while `may_answer` is not set."""

    labels = ("person",)
    fingerprint = "blocked"

    def __init__(self, detector: Any) -> None:
        self.detector = detector
        self.may_answer = Event()

    def detect(self, images: Any) -> Any:
        assert self.may_answer.wait(60)
        return self.detector.detect(images)


def test_detected_image_boxes_are_accepted_and_a_box_drawn_while_the_detector_runs_is_kept(
    bench: Bench, knowing: Callable[..., Detectors], teach: Callable[..., None]
) -> None:
    page, perfect = bench.page, knowing("people", kind=BoxKind.SILHOUETTE)
    blocked = BlockedDetector(perfect.view)
    blocked.may_answer.set()
    teach(image=perfect.image, view=blocked)
    expect(page.get_by_test_id("image-editor").locator(".box.suggested")).to_have_count(3)
    with page.expect_response(answers_drag(0)) as answer:
        page.keyboard.press("Enter")
    drawn = answer.value.json()["drawn"]
    dashed = page.locator(".views .box.suggested")
    expect(dashed).to_have_count(4)
    blocked.may_answer.clear()
    try:
        # two drags before the first is answered
        before = list(zip(drawn["steps"][0]["views"], drawn["steps"][0]["suggested"], strict=True))
        for place, (view, _) in enumerate(before):
            bench.wait_for_view(place, view)
            bench.pull(place, (0.5, 0.3), (0.4, 0.3))
        expect(page.get_by_test_id("hint")).to_contain_text("Looking for")
    finally:
        blocked.may_answer.set()
    expect(dashed).to_have_count(2)
    bench.saved()
    for (_, kept), (_, box) in zip(bench.state["objects"][0]["views"], before, strict=True):
        assert kept["x_min"] < box["x_min"] - 1 and abs(kept["y_min"] - box["y_min"]) < 2
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "5")
    bench.saved()
    assert len(bench.labels) == 1


def test_a_detector_that_cannot_be_loaded_is_reported_once(bench: Bench) -> None:
    weights = bench.project.models_folder / "broken" / "best.pt"
    weights.parent.mkdir()
    weights.write_bytes(b"no weights")
    bench.project.models.register(
        DetectorKind.VIEW, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint="broken"
    )
    bench.draw_on_image(0)
    told = bench.page.get_by_test_id("toast-warn").filter(has_text="the view detector cannot be loaded")
    expect(told).to_have_count(1)
    told.get_by_role("button").click()
    views = bench.draw_on_image(1)["steps"][0]["views"]
    bench.wait_for_view(1, views[1])
    bench.saved()
    expect(told).to_have_count(0)
