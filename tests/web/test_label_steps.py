"""The views of Label mode come without the view detector; suggestions are asked for by themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import pytest
from drawing import Scene

from annotator.project import Role
from annotator.types import BoxKind
from annotator.workflows.detectors_ready import Readiness, ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.workflows.detectors import Detectors

STEPS = "/api/projects/room/frames/1/label/steps"


class Counting:
    """A detector that counts how often it is asked."""

    labels = ("person",)
    fingerprint = "counting"

    def __init__(self, detector: Any) -> None:
        self.detector = detector
        self.calls = 0

    def detect(self, images: Any) -> Any:
        self.calls += 1
        return self.detector.detect(images)


def test_only_who_wants_suggestions_waits_for_them(
    live: Live, generated: Path, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    detector = Counting(knowing("people", kind=BoxKind.SILHOUETTE).view)
    ready = Readiness("ready", ReadyDetector(detector, BoxKind.SILHOUETTE, Lock()))
    monkeypatch.setattr(live.context.annotation.detectors, "look", lambda project, role, wait_s=None: ready)
    scene = Scene.of(generated / "people", 0, ["person"])
    body = {"image_box": scene.image_box(0), "boxes": []}
    views = live.client.post(STEPS, json={**body, "suggest": False}).json()
    assert detector.calls == 0 and views["detector"] == "ready"
    assert views["steps"][0]["suggested"] == [None, None]
    told = live.client.post(STEPS, json={**body, "suggest": True}).json()
    assert detector.calls == 1
    assert [view["id"] for view in told["steps"][0]["views"]] == [view["id"] for view in views["steps"][0]["views"]]
    assert None not in told["steps"][0]["suggested"]
    second = live.client.post(STEPS, json={**body, "boxes": told["steps"][0]["suggested"]}).json()
    assert detector.calls == 2, "nothing is suggested on views whose boxes are drawn"
    assert None not in second["steps"][1]["suggested"]


def test_a_detector_that_failed_says_why(live: Live, generated: Path, tmp_path: Path) -> None:
    weights = tmp_path / "broken" / "best.pt"
    weights.parent.mkdir()
    weights.write_bytes(b"no weights")
    project = live.context.project("room")
    for role in Role:
        project.models.register(
            role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=f"broken {role.value}"
        )
    live.context.annotation.detectors.look(project, Role.VIEW)
    body = {"image_box": Scene.of(generated / "people", 0, ["person"]).image_box(0), "boxes": []}
    for suggest in (False, True):
        found = live.client.post(STEPS, json={**body, "suggest": suggest}).json()
        assert found["detector"] == "failed" and "model.json: no such file" in found["problem"]
        assert len(found["steps"][0]["views"]) == 2
    told = live.client.get("/api/projects/room/frames/1/label/suggestions").json()
    assert told["boxes"] == [] and "model.json: no such file" in told["problem"]
    # and so do the tools of Review
    box = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "quaternion": [0.9, 0.1, 0.4, 0.1]}
    frame = "/api/projects/room/frames/1"
    for tool, asked in (("refit", {"box": box, "label": "person"}), ("fit", {"image_box": body["image_box"]})):
        note = live.client.post(f"{frame}/{tool}", json=asked).json()["note"]
        assert "no pseudo-view detector: " in note and "model.json: no such file" in note
        assert str(tmp_path) not in note
