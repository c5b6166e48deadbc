"""Label mode: views are sent without waiting for the view detector; suggestions are a separate request."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import pytest
from drawing import Scene

from annotator.types import BoxKind, DetectorKind
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.workflows.detectors import Detectors

STEPS = "/api/projects/room/frames/1/label/steps"


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


def test_the_detector_is_called_only_for_suggestions(
    live: Live, generated: Path, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    detector = CountingDetector(knowing("people", kind=BoxKind.SILHOUETTE).view)
    ready = Readiness("ready", ReadyDetector(detector, BoxKind.SILHOUETTE, Lock()))
    monkeypatch.setattr(live.context.caches.detectors, "readiness", lambda project, role, wait_s=None: ready)
    scene = Scene.of(generated / "people", 0, ["person"])
    body = {"image_box": scene.image_box(0), "boxes": []}
    views = live.client.post(STEPS, json={**body, "suggest": False}).json()
    assert detector.calls == 0 and views["detector"] == "ready"
    assert views["steps"][0]["suggested"] == [None, None]
    (suggested,) = live.client.post(STEPS, json={**body, "suggest": True}).json()["steps"]
    assert detector.calls == 1
    assert [view["id"] for view in suggested["views"]] == [view["id"] for view in views["steps"][0]["views"]]
    assert None not in suggested["suggested"]
    second = live.client.post(STEPS, json={**body, "boxes": suggested["suggested"]}).json()
    assert detector.calls == 2, "views with drawn boxes need no suggestion"
    assert None not in second["steps"][1]["suggested"]


def test_a_failed_detector_is_reported_with_its_problem(live: Live, generated: Path, tmp_path: Path) -> None:
    weights = tmp_path / "broken" / "best.pt"
    weights.parent.mkdir()
    weights.write_bytes(b"no weights")
    project = live.context.project("room")
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
