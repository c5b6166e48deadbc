"""The loop benchmark around its trainings, with detectors that know the truth in place of trained ones."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.project import BoxRotation, Project, Role, open_project
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.propose import FrameProposals
from annotator.recordings import open_recording
from annotator.types import BoxKind, Frame
from annotator.types.errors import AnnotatorError, ConfigError
from annotator.workflows.detectors import Detectors
from annotator.workflows.samples import gather
from annotator.workflows.truth import load_truth
from benchmarks import loop
from benchmarks.loop import Arguments, propose_batch, run
from benchmarks.loop_scores import Scores

KEYS = {"frames", "share_with_proposal", "mask_recall", "mask_precision", "mean_iou", "ap25", "ap50", "boxes_2d"}


class Knowing:
    """Knows the frames of a recording as it was; trains nothing, but registers models like a training."""

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
        for role in Role:
            project.models.register(role, weights, labels=classes, box_kind=kind, metrics={}, fingerprint=role)
        return []

    def detectors(self, project: Project, backend: str = "auto") -> Detectors:
        model = project.models.active(Role.VIEW)
        assert model is not None
        perfect = PerfectDetector(self.scenes, model.box_kind, min_points=50)
        return Detectors(perfect, perfect, model.box_kind)

    @property
    def scenes(self) -> list[Scene]:
        made = []
        for index in range(1, len(self.recording), 2):
            frame = self.recording.frame(index)
            truths = load_truth(self.recording, index, frame)
            made.append(Scene.of(frame, [replace(t, label=self.label or t.label) for t in truths]))
        return made


@pytest.fixture
def untrained(generated: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Knowing]:
    """Puts a `Knowing` in place of the trainings."""

    def put(label: str | None = None) -> Knowing:
        knowing = Knowing(generated / "people", label)
        monkeypatch.setattr(loop, "train", knowing.train)
        monkeypatch.setattr(loop, "active_detectors", knowing.detectors)
        return knowing

    return put


def test_the_report(generated: Path, untrained: Callable[..., Knowing]) -> None:
    untrained()
    result = run(Arguments(generated / "people"))
    assert set(result) == KEYS | {"operator", "axes", "backend", "seconds"}
    assert (result["frames"], result["share_with_proposal"], result["operator"]) == (2, 1.0, "box")
    assert result["boxes_2d"] == 3 * 3 * 5
    assert float(str(result["mean_iou"])) > 0.8


def test_masks_alone(own_copy: Callable[[str], Path], untrained: Callable[..., Knowing]) -> None:
    """Labelled by silhouettes and scored by the masks; nothing can be said about true boxes."""
    folder = own_copy("people")
    (folder / "truth" / "boxes.json").unlink()
    untrained("thing")
    result = run(Arguments(folder, label="thing"))
    assert (result["frames"], result["operator"]) == (2, "silhouette")
    assert all(math.isnan(float(str(result[key]))) for key in ("mean_iou", "ap25", "ap50"))
    assert float(str(result["mask_recall"])) > 0.8
    assert float(str(result["mask_precision"])) > 0.5  # a box holds some floor, too
    with pytest.raises(ConfigError, match="needs true boxes"):
        run(Arguments(folder, operator=BoxKind.BOX))


def test_a_broken_test_frame_is_one_without_a_proposal(
    own_copy: Callable[[str], Path], untrained: Callable[..., Knowing], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = own_copy("people")
    depth = folder / "depth" / "000001.png"
    depth.write_bytes(depth.read_bytes()[:1000])
    untrained()
    result = run(Arguments(folder))
    assert (result["frames"], result["share_with_proposal"]) == (2, 0.5)
    assert "000001.png" in "".join(capsys.readouterr().err.split())


def test_a_kept_project_stays_what_it_is(
    generated: Path, tmp_path: Path, untrained: Callable[..., Knowing], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that was ended in training labels no second time; the next ones use what is there, or refuse."""
    folder, kept = generated / "people", tmp_path / "kept"
    knowing = untrained()
    knowing.killed = True
    with pytest.raises(KeyboardInterrupt):
        run(Arguments(folder, operator=BoxKind.SILHOUETTE, free=True, project=kept))
    knowing.killed = False
    with open_project(kept / "loop") as project:
        before = project.statistics()
        assert project.config.settings.rotation is BoxRotation.FREE

    def fail(*_: object) -> None:
        pytest.fail("labelled again")

    monkeypatch.setattr(loop, "simulate_recording", fail)
    asked: list[RcvConfig] = []

    def nothing(frames: list[Frame], image: Any, view: Any, config: RcvConfig, compute: Any) -> list[FrameProposals]:
        asked.append(config)
        return [FrameProposals(frame.key, (), ()) for frame in frames]

    monkeypatch.setattr(loop, "propose", nothing)
    for _ in range(2):
        result = run(Arguments(folder, project=kept))
        assert result["operator"] == "silhouette"
        assert result["boxes_2d"] == before.image_boxes.boxes + before.view_boxes.boxes
    assert {(c.orientation, c.box_kind) for c in asked} == {(Orientation.FREE, BoxKind.SILHOUETTE)}
    assert knowing.trainings == 2
    for wrong, message in (
        ({"operator": BoxKind.BOX}, "labelled by the operator silhouette, not box"),
        ({"upright": True}, "keeps the rotation free, not upright"),
        ({"label": "robot"}, "has the classes person, not 'robot'"),
    ):
        with pytest.raises(ConfigError, match=message):
            run(Arguments(folder, project=kept, **wrong))
    run(Arguments(folder, project=kept, operator=BoxKind.SILHOUETTE, free=True))


def test_arguments_that_exclude_each_other(generated: Path) -> None:
    with pytest.raises(ConfigError, match="exclude each other"):
        run(Arguments(generated / "people", upright=True, free=True))
    with pytest.raises(ConfigError, match="--label is for masks alone"):
        run(Arguments(generated / "people", label="person"))


def test_nothing_to_score(generated: Path, own_copy: Callable[[str], Path]) -> None:
    folder = own_copy("hands")
    for path in (folder / "truth").rglob("*"):
        if path.is_file():
            path.unlink()
    (folder / "truth" / "mask").rmdir()
    with pytest.raises(AnnotatorError, match="neither true boxes nor masks"):
        run(Arguments(generated / "people", folder))


def test_frames_of_one_batch_turn_as_each_may(generated: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = open_recording(generated / "people").frame(0)
    asked: dict[Orientation, int] = {}

    def note(frames: list[Frame], image: Any, view: Any, config: RcvConfig, compute: Any) -> list[FrameProposals]:
        asked[config.orientation] = len(frames)
        return [FrameProposals(frame.key, (), ()) for frame in frames]

    monkeypatch.setattr(loop, "propose", note)
    frames = {
        4: replace(frame, key="a", up=np.array([0.0, -1.0, 0.0])),
        5: replace(frame, key="b", up=None),
        7: replace(frame, key="c", up=np.array([0.0, -1.0, 0.0])),
    }
    perfect = PerfectDetector([])
    found = propose_batch(frames, Detectors(perfect, perfect), RcvConfig(), BoxRotation.AUTO)
    assert asked == {Orientation.UPRIGHT: 2, Orientation.FREE: 1}
    assert {index: result.key for index, result in found.items()} == {4: "a", 5: "b", 7: "c"}


def test_what_is_proposed_where_nothing_is_costs_precision(own_copy: Callable[[str], Path]) -> None:
    """The same proposals on a frame without truth: average precision falls, the rest is as it was."""
    folder = own_copy("people")
    file = folder / "truth" / "boxes.json"
    content = json.loads(file.read_text())
    recording = open_recording(folder)
    frame = recording.frame(0)
    scene = Scene.of(frame, load_truth(recording, 0, frame))
    perfect = PerfectDetector([scene], min_points=50)
    (found,) = propose_batch({0: frame}, Detectors(perfect, perfect), RcvConfig(), BoxRotation.AUTO).values()
    assert len(found.proposals) == 3
    file.write_text(json.dumps({**content, recording.keys[1]: []}))
    other = replace(frame, key=recording.keys[1], index=1)
    alone, both = Scores(recording, ["person"]), Scores(recording, ["person"])
    alone.add(0, frame, found)
    both.add(1, other, found)
    both.add(0, frame, found)
    without, with_false = alone.summary(), both.summary()
    assert (without["frames"], without["ap25"]) == (1, 1.0)
    assert with_false["ap25"] == pytest.approx(0.5, abs=0.01)  # equal scores: the three false ones come first
    same = KEYS - {"ap25", "ap50", "boxes_2d"}
    assert {key: with_false[key] for key in same} == {key: without[key] for key in same}
