"""The loop benchmark with perfect detectors instead of trainings."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.project import BoxRotation, Project, open_project
from annotator.rcv.config import RcvConfig
from annotator.rcv.propose import FrameProposals
from annotator.recordings import open_recording
from annotator.types import BoxKind, DetectorKind, Frame
from annotator.types.errors import AnnotatorError, ConfigError
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.training.samples import gather
from benchmarks import loop
from benchmarks.loop import Arguments, Scores, run

KEYS = {"frames", "share_with_proposal", "mask_recall", "mask_precision", "mean_iou", "ap25", "ap50", "boxes_2d"}


class TrainingStandIn:
    """A stand-in for the training that registers models; its detectors are perfect on the original recording."""

    def __init__(self, folder: Path, label: str | None = None) -> None:
        self.recording = open_recording(folder)
        self.label = label
        self.trainings = 0
        self.killed = False

    def train(self, project: Project, plan: Any, progress: Any) -> list[Any]:
        self.trainings += 1
        if self.killed:
            raise KeyboardInterrupt
        weights = project.models_folder / "weights.pt"
        weights.write_bytes(b"")
        kind, classes = gather(project).kind, project.config.classes
        for role in DetectorKind:
            project.models.register(role, weights, labels=classes, box_kind=kind, metrics={}, fingerprint=role)
        return []

    def detectors(self, project: Project, backend: str = "auto") -> Detectors:
        model = project.models.active(DetectorKind.VIEW)
        assert model is not None
        perfect = PerfectDetector(self.scenes, model.box_kind, min_points=50)
        return Detectors(perfect, perfect, model.box_kind)

    @property
    def scenes(self) -> list[Scene]:
        scenes = []
        for index in range(1, len(self.recording), 2):
            frame = self.recording.frame(index)
            truths = load_truth(self.recording, index, frame)
            scenes.append(Scene.of(frame, [replace(t, label=self.label or t.label) for t in truths]))
        return scenes


@pytest.fixture
def untrained(generated: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., TrainingStandIn]:
    """Replaces the trainings by a `TrainingStandIn`."""

    def put(label: str | None = None) -> TrainingStandIn:
        stand_in = TrainingStandIn(generated / "people", label)
        monkeypatch.setattr(loop, "train", stand_in.train)
        monkeypatch.setattr(loop, "active_detectors", stand_in.detectors)
        return stand_in

    return put


def test_the_report_contains_all_scores(generated: Path, untrained: Callable[..., TrainingStandIn]) -> None:
    untrained()
    result = run(Arguments(generated / "people"))
    assert set(result) == KEYS | {"operator", "whole_boxes", "box_kind", "axes", "backend", "seconds"}
    assert (result["frames"], result["share_with_proposal"], result["operator"]) == (2, 1.0, "box")
    assert result["boxes_2d"] == 3 * 3 * 5
    assert float(str(result["mean_iou"])) > 0.8


def test_without_true_boxes_only_mask_scores_are_computed(
    own_copy: Callable[[str], Path], untrained: Callable[..., TrainingStandIn]
) -> None:
    """Labelled by silhouettes and scored by the masks; scores that need true boxes are NaN."""
    folder = own_copy("people")
    (folder / "truth" / "boxes.json").unlink()
    untrained("thing")
    result = run(Arguments(folder, label="thing"))
    assert (result["frames"], result["operator"]) == (2, "silhouette")
    assert all(math.isnan(float(str(result[key]))) for key in ("mean_iou", "ap25", "ap50"))
    assert float(str(result["mask_recall"])) > 0.8
    assert float(str(result["mask_precision"])) > 0.5  # a box also contains some floor
    with pytest.raises(ConfigError, match="needs true boxes"):
        run(Arguments(folder, operator=BoxKind.BOX))


def test_an_unreadable_test_frame_counts_as_one_without_a_proposal(
    own_copy: Callable[[str], Path], untrained: Callable[..., TrainingStandIn], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = own_copy("people")
    depth = folder / "depth" / "000001.png"
    depth.write_bytes(depth.read_bytes()[:1000])
    untrained()
    result = run(Arguments(folder))
    assert (result["frames"], result["share_with_proposal"]) == (2, 0.5)
    assert "000001.png" in "".join(capsys.readouterr().err.split())


def test_a_kept_project_is_reused_or_refused(
    generated: Path, tmp_path: Path, untrained: Callable[..., TrainingStandIn], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After an interrupted training, frames are not labelled again; later runs reuse the project or refuse it."""
    folder, kept = generated / "people", tmp_path / "kept"
    stand_in = untrained()
    stand_in.killed = True
    with pytest.raises(KeyboardInterrupt):
        run(Arguments(folder, operator=BoxKind.SILHOUETTE, free=True, project=kept))
    stand_in.killed = False
    with open_project(kept / "loop") as project:
        before = project.statistics()
        assert project.config.settings.rotation is BoxRotation.FREE

    def fail(*_: object) -> None:
        pytest.fail("labelled again")

    monkeypatch.setattr(loop, "simulate_recording", fail)
    asked: list[tuple[BoxRotation, BoxKind]] = []

    def nothing(
        frames: list[Frame], detectors: Detectors, config: RcvConfig, rotation: BoxRotation
    ) -> list[FrameProposals]:
        asked.append((rotation, detectors.box_kind))
        return [FrameProposals(frame.key, (), ()) for frame in frames]

    monkeypatch.setattr(loop, "propose_frames", nothing)
    for _ in range(2):
        result = run(Arguments(folder, project=kept))
        assert result["operator"] == "silhouette"
        assert result["boxes_2d"] == before.image_boxes.boxes + before.view_boxes.boxes
    # enough of the offered whole boxes were confirmed, so these are what the detector measures
    assert set(asked) == {(BoxRotation.FREE, BoxKind.BOX)}
    assert (result["whole_boxes"], result["box_kind"]) == (9, "box")
    assert stand_in.trainings == 2
    for wrong, message in (
        ({"operator": BoxKind.BOX}, "labelled by the operator silhouette, not box"),
        ({"upright": True}, "has the rotation free, not upright"),
        ({"label": "robot"}, "has the classes person, not 'robot'"),
    ):
        with pytest.raises(ConfigError, match=message):
            run(Arguments(folder, project=kept, **wrong))
    run(Arguments(folder, project=kept, operator=BoxKind.SILHOUETTE, free=True))


def test_a_label_is_for_masks_alone(generated: Path) -> None:
    with pytest.raises(ConfigError, match="--label is only for recordings with masks"):
        run(Arguments(generated / "people", label="person"))


def test_a_recording_without_boxes_and_masks_is_an_error(generated: Path, own_copy: Callable[[str], Path]) -> None:
    folder = own_copy("hands")
    for path in (folder / "truth").rglob("*"):
        if path.is_file():
            path.unlink()
    (folder / "truth" / "mask").rmdir()
    with pytest.raises(AnnotatorError, match="neither true boxes nor masks"):
        run(Arguments(generated / "people", folder))


def test_false_proposals_reduce_average_precision(own_copy: Callable[[str], Path]) -> None:
    """The same proposals on a frame without objects: average precision falls, the other scores do not change."""
    folder = own_copy("people")
    file = folder / "truth" / "boxes.json"
    content = json.loads(file.read_text())
    recording = open_recording(folder)
    frame = recording.frame(0)
    scene = Scene.of(frame, load_truth(recording, 0, frame))
    perfect = PerfectDetector([scene], min_points=50)
    (proposed,) = loop.propose_frames([frame], Detectors(perfect, perfect), RcvConfig(), BoxRotation.AUTO)
    assert len(proposed.proposals) == 3
    file.write_text(json.dumps({**content, recording.keys[1]: []}))
    other = replace(frame, key=recording.keys[1], index=1)
    alone, both = Scores(recording, ["person"]), Scores(recording, ["person"])
    alone.add(0, frame, proposed)
    both.add(1, other, proposed)
    both.add(0, frame, proposed)
    without, with_false = alone.summary(), both.summary()
    assert (without["frames"], without["ap25"]) == (1, 1.0)
    assert with_false["ap25"] == pytest.approx(0.5, abs=0.01)  # equal scores: the three false ones come first
    same = KEYS - {"ap25", "ap50", "boxes_2d"}
    assert {key: with_false[key] for key in same} == {key: without[key] for key in same}
