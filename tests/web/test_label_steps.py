"""Label mode: one request stores a drag and answers with the views, suggestions and 3D box that follow from it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from drawing import Scene

from annotator.project.boxes import png
from annotator.types import BoxKind, DetectorKind
from annotator.workflows.workbench import frame_cache
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.workflows.detectors import Detectors

STEPS, SAVE = (f"/api/projects/room/frames/1/label/{name}" for name in ("steps", "object"))


class CountingDetector:
    """A detector that counts its calls."""

    labels = ("person",)
    fingerprint = "counting"

    def __init__(self, detector: Any) -> None:
        self.detector = detector
        self.calls = 0

    def detect(self, images: Any) -> Any:
        self.calls += 1
        return self.detector.detect(images)


@pytest.fixture
def counting(live: Live, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch) -> CountingDetector:
    """The view detector of the project."""
    detector = CountingDetector(knowing("people", kind=BoxKind.SILHOUETTE).view)
    ready = Readiness("ready", ReadyDetector(detector, BoxKind.SILHOUETTE, Lock()))
    monkeypatch.setattr(live.context.caches.detectors, "readiness", lambda project, role, wait_s=None: ready)
    return detector


def test_steps_without_suggestions_do_not_call_the_detector(
    live: Live, generated: Path, counting: CountingDetector
) -> None:
    body = {"image_box": Scene.of(generated / "people", 0, ["person"]).image_box(0), "boxes": []}
    views = live.client.post(STEPS, json={**body, "suggest": False}).json()
    assert counting.calls == 0 and views["detector"] == "ready"
    assert [step["suggested"] for step in views["steps"]] == [[None, None]]


def test_one_request_stores_a_drag_and_answers_with_all_that_follows(
    live: Live, generated: Path, counting: CountingDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded: list[int] = []
    monkeypatch.setattr(frame_cache, "png", lambda rgb: encoded.append(1) or png(rgb))
    scene = Scene.of(generated / "people", 0, ["person"])
    image_box = scene.image_box(0)
    body = {"revision": 0, "image_boxes": [image_box], "object": {"image_box": image_box, "boxes": []}}
    saved = live.client.post(SAVE, json=body)
    assert saved.status_code == 200, saved.text
    answer, drawn = saved.json(), saved.json()["drawn"]
    assert answer["uid"] is None and answer["state"]["image_boxes"]["boxes"] == [image_box]
    suggested = [box for step in drawn["steps"] for box in step["suggested"]]
    assert len(suggested) == 4 and None not in suggested
    assert drawn["box"] is not None and drawn["measured_by"] == "this project's view detector"
    calls = counting.calls
    # Enter: the suggestions become the object's boxes, and its label is the box that was shown
    boxes, axes = suggested, drawn["steps"][1]["views"][0]["axes"]
    accepted = {**body, "revision": 1, "object": {"image_box": image_box, "boxes": boxes, "axes": axes}}
    finished = live.client.post(SAVE, json=accepted)
    assert finished.status_code == 200, finished.text
    (label,) = finished.json()["state"]["labels"]
    assert label["uid"] == finished.json()["uid"] is not None
    for part in ("center", "size"):
        np.testing.assert_allclose(label["box"][part], drawn["box"][part], atol=1e-9)
    ids = [view["id"] for step in drawn["steps"] for view in step["views"]]
    assert [view["id"] for step in finished.json()["drawn"]["steps"] for view in step["views"]] == ids
    assert counting.calls == calls, "nothing is left to suggest"
    assert len(encoded) == 4, "each picture is encoded once"


def test_axes_must_be_those_of_a_view(live: Live, generated: Path) -> None:
    image_box = Scene.of(generated / "people", 0, ["person"]).image_box(0)
    skewed = [[1, 0, 0], [0.5, 1, 0], [0, 0, 1]]
    answer = live.client.post(STEPS, json={"image_box": image_box, "boxes": [], "axes": skewed})
    assert answer.status_code == 422 and "must be a rotation matrix" in answer.text


def test_a_failed_detector_is_reported_with_its_problem(live: Live, generated: Path, tmp_path: Path) -> None:
    project = live.context.project("room")
    weights = project.models_folder / "broken" / "best.pt"
    weights.parent.mkdir()
    weights.write_bytes(b"no weights")
    for role in DetectorKind:
        project.models.register(
            role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=f"broken {role.value}"
        )
    live.context.caches.detectors.readiness(project, DetectorKind.VIEW)
    body = {"image_box": Scene.of(generated / "people", 0, ["person"]).image_box(0), "boxes": []}
    for suggest in (False, True):
        found = live.client.post(STEPS, json={**body, "suggest": suggest}).json()
        assert found["detector"] == "failed" and "model.json: no such file" in found["problem"]
        assert len(found["steps"][0]["views"]) == 2
    suggestions = live.client.get("/api/projects/room/frames/1/label/suggestions").json()
    assert suggestions["boxes"] == [] and "model.json: no such file" in suggestions["problem"]
    # the same in Review
    box = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "quaternion": [0.9, 0.1, 0.4, 0.1]}
    frame = "/api/projects/room/frames/1"
    for tool, request in (("refit", {"box": box, "label": "person"}), ("fit", {"image_box": body["image_box"]})):
        note = live.client.post(f"{frame}/{tool}", json=request).json()["note"]
        assert "no pseudo-view detector: " in note and "model.json: no such file" in note
        assert str(tmp_path) not in note
