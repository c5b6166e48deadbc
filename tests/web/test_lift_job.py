"""The job that proposes 3D boxes from 2D boxes on the images, and where the page names the detector that measures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import pytest
from drawing import Scene
from room_api import ROOM

from annotator.detection import pretrained
from annotator.detection.pretrained import TITLE
from annotator.project import WriteContext
from annotator.project.event_types import ImageBoxesSet
from annotator.rcv.config import AGNOSTIC_LABELS
from annotator.types import Box2D, BoxKind, DetectorKind
from annotator.types.errors import ConfigError
from annotator.web.jobs import work
from annotator.web.jobs.job_context import JobContext, JobStoppedError
from annotator.web.jobs.messages import Progress, WorkerMessage
from annotator.web.jobs.records import LiftRequest
from annotator.web.schemas import Box2DJson
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.types import Detector, Image
    from annotator.workflows.detectors import Detectors


class AnyClass:
    """As a base detector: the boxes of another detector without their classes."""

    labels = tuple(AGNOSTIC_LABELS.values())
    fingerprint = "any class"

    def __init__(self, detector: Detector) -> None:
        self._detector = detector

    def detect(self, images: list[Image]) -> list[list[Box2D]]:
        return [[replace(box, label="whole") for box in boxes] for boxes in self._detector.detect(images)]


@pytest.fixture
def base(knowing: Callable[..., Detectors]) -> ReadyDetector:
    return ReadyDetector(AnyClass(knowing("people").view), BoxKind.BOX, Lock(), True, pretrained.NAME)


def test_the_job_proposes_3d_boxes_and_says_what_measured_them(
    live: Live, generated: Path, tmp_path: Path, base: ReadyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work, "require_view", lambda _: base)
    project = live.context.project("room")
    sent: list[WorkerMessage] = []
    job = JobContext(project, tmp_path, "Ada", sent.append, lambda: False)
    with pytest.raises(ConfigError, match="no frame has boxes on its image but no 3D box"):
        work.lift_work(job, LiftRequest(kind="lift"))
    scene, stored = Scene.of(generated / "people", 0, ["person"]), project.frames.of()[0]
    boxes = tuple(Box2DJson(**scene.image_box(number)).box() for number in range(len(scene.objects)))
    drawn = ImageBoxesSet(boxes=boxes, box_kind=BoxKind.SILHOUETTE)
    project.log.append(stored.id, [drawn], WriteContext(stored.revision, "Ada"))
    assert live.client.get(f"{ROOM}/models").json()["material"]["to_lift"] == 1
    stopped = JobContext(project, tmp_path, "Ada", sent.append, lambda: True)
    with pytest.raises(JobStoppedError):
        work.lift_work(stopped, LiftRequest(kind="lift"))
    outcome = work.lift_work(job, LiftRequest(kind="lift"))
    assert outcome.result["proposals"] > 0 and outcome.result["frames"] == 1
    assert outcome.message.endswith(f"proposals in 1 frame, measured by: {TITLE}")
    assert any(isinstance(message, Progress) and message.total == 1.0 for message in sent)
    assert live.client.get(f"{ROOM}/models").json()["material"]["to_lift"] == 0
    labels = live.client.get(f"{ROOM}/frames/{stored.id}").json()["labels"]
    assert {label["measured_by"] for label in labels} == {TITLE}


def test_the_project_and_its_statistics_name_the_base_detector_until_it_has_its_own(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def named() -> tuple[str | None, str | None]:
        statistics = live.client.get(f"{ROOM}/statistics").json()
        return live.client.get(ROOM).json()["detectors"]["stand_in"], statistics["view_detector"]

    assert named() == (None, None)
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "detector.safetensors").write_bytes(b"weights")
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "base")
    assert named() == (TITLE, TITLE)
    project = live.context.project("room")
    weights = project.path / "models" / "own.pt"
    weights.parent.mkdir(exist_ok=True)
    weights.write_bytes(b"w")
    kind = {"labels": ["person"], "box_kind": BoxKind.BOX, "metrics": {}, "fingerprint": "own"}
    project.models.register(DetectorKind.VIEW, weights, **kind)
    assert named() == (None, "this project's view detector")


def test_a_fit_in_review_names_the_detector(
    live: Live, generated: Path, base: ReadyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready = Readiness("ready", base)
    monkeypatch.setattr(live.context.caches.detectors, "readiness", lambda project, role, wait_s=None: ready)
    image_box = Scene.of(generated / "people", 0, ["person"]).image_box(0)
    found = live.client.post(f"{ROOM}/frames/1/fit", json={"image_box": image_box}).json()
    assert found["box"] is not None and found["measured_by"] == TITLE
    again = live.client.post(f"{ROOM}/frames/1/refit", json={"box": found["box"], "label": "person"}).json()
    assert (again["method"], again["measured_by"]) == ("rcv", TITLE)
