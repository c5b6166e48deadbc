"""A box drawn on the image in Review: the object that the server finds in it, and the origin of its label."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from drawing import Scene

from annotator.geometry.iou import iou_3d
from annotator.types import BoxKind, DetectorKind
from annotator.web.schemas import Box3DJson
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.workflows.detectors import Detectors

FRAME = "/api/projects/room/frames/1"


@pytest.fixture
def scene(generated: Path) -> Scene:
    return Scene.of(generated / "people", 0, ("person",))


@pytest.fixture
def taught(live: Live, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch) -> Live:
    """A server whose project has a view detector with ground-truth detections."""
    ready = Readiness("ready", ReadyDetector(knowing("people", kind=BoxKind.BOX).view, BoxKind.BOX, Lock()))
    answer = lambda project, role, wait_s=None: ready if role is DetectorKind.VIEW else Readiness("none")  # noqa: E731
    monkeypatch.setattr(live.context.caches.detectors, "readiness", answer)
    return live


def fit(live: Live, image_box: dict[str, Any]) -> dict[str, Any]:
    answer = live.client.post(f"{FRAME}/fit", json={"image_box": image_box})
    assert answer.status_code == 200, answer.text
    fitted: dict[str, Any] = answer.json()
    return fitted


def test_a_drawn_box_is_fitted_and_its_label_counts_as_drawn(taught: Live, scene: Scene) -> None:
    image_box = {**scene.image_box(0), "score": 0.0}  # a drawn box has no detector confidence
    found = fit(taught, image_box)
    box = Box3DJson(**found["box"]).box()
    assert iou_3d(box, scene.objects[0].box) > 0.8
    assert found["note"] is None and found["points"] > 100 and len(found["outline"]) > 0
    assert 0 < found["quality"]["image_agreement"] <= 1
    assert taught.client.get(FRAME).json()["labels"] == []  # nothing is stored yet

    created = {"kind": "create", "label": "person", "box": found["box"], "image_box": image_box}
    created["suggestion"] = found["suggestion"]
    body = {"revision": 0, "changes": [created], "effort": {"actions": 2, "seconds": 4.0}}
    answer = taught.client.post(f"{FRAME}/changes", json=body)
    assert answer.status_code == 200, answer.text
    (label,) = answer.json()["labels"]
    assert (label["state"], label["author"]) == ("accepted", "Ada")
    assert label["suggestion"] == found["suggestion"]
    assert (label["suggestion"]["detector"], label["suggestion"]["corrected"]) == (
        "this project's view detector",
        False,
    )
    np.testing.assert_allclose(label["box"]["center"], found["box"]["center"], atol=1e-9)
    stored = taught.context.project("room").labels.get(label["uid"])
    assert stored.image_box is not None and stored.image_box.xyxy == tuple(
        image_box[edge] for edge in ("x_min", "y_min", "x_max", "y_max")
    )
    effort = taught.client.get("/api/projects/room/statistics").json()["effort"]["by_origin"]
    assert effort["from nothing"] == {"boxes": 1, "seconds_a_box": 4.0, "actions_a_box": 2.0}


@pytest.mark.parametrize(
    ("box", "label", "reason", "is_sparse"),
    [
        ((0.0, 0.0, 3.0, 3.0), "person", "fewer than 5 points lie in this box", True),
        ((0.0, 0.0, 3.0, 3.0), "chair", "fewer than 5 points lie in this box", True),
        ((60.0, 2.0, 110.0, 40.0), "person", "found no object", False),
        ((60.0, 2.0, 110.0, 40.0), "chair", "was not trained on chair", False),
    ],
)
def test_without_an_object_there_is_a_reason(
    taught: Live, box: tuple[float, ...], label: str, reason: str, is_sparse: bool
) -> None:
    found = fit(taught, {"label": label, **dict(zip(("x_min", "y_min", "x_max", "y_max"), box, strict=True))})
    assert found["box"] is None and found["outline"] == []
    assert reason in found["note"]
    assert found["too_few_points"] is is_sparse, "whether there are views to draw on"


def test_without_a_detector_the_answer_says_so(live: Live, scene: Scene) -> None:
    found = fit(live, scene.image_box(0))
    assert (found["note"], found["too_few_points"]) == ("there is no pseudo-view detector yet", False)
    corner = fit(live, {"label": "person", "x_min": 0.0, "y_min": 0.0, "x_max": 3.0, "y_max": 3.0})
    assert (corner["note"], corner["too_few_points"]) == ("fewer than 5 points lie in this box", True)
