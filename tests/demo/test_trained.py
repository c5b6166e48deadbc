"""A small run of the demo with training, with a few frames and minimal trainings, produces all results."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator import demo
from annotator.demo import TrainedPlan, run_trained
from annotator.formats.rcv import read_rcv
from annotator.project import BoxRotation, open_project
from annotator.recordings import open_recording
from annotator.synthetic import writer
from annotator.types import DetectorKind, Source
from annotator.types.errors import ConfigError
from annotator.workflows.training.train import TrainPlan

STAGES = ["generate", "label", "train", "propose", "score and export"]


def tiny(plan: TrainedPlan) -> TrainPlan:
    """The demo's trainings with 64 pixels and one epoch."""
    full = TRAINING(plan)
    small = {"image_size_px": 64, "epochs": 1}
    return TrainPlan(full.image.model_copy(update=small), full.view.model_copy(update=small), full.samples)


TRAINING = demo._training


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "label", "rotation"), [("hands", "hand", BoxRotation.FREE)])
def test_the_demo_runs_all_stages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str, label: str, rotation: BoxRotation
) -> None:
    monkeypatch.setattr(demo, "_training", tiny)
    told: dict[str, list[float]] = {}
    plan = TrainedPlan(preset=preset, frames=4, image_pictures=16, view_pictures=32)
    result = run_trained(tmp_path, plan, lambda stage, done, of: told.setdefault(stage, []).append(done / of))

    assert list(result.seconds) == STAGES
    assert all(seconds > 0 for seconds in result.seconds.values())
    assert list(told) == [
        "ray-cast the recording",
        "draw 2D boxes",
        "train the image detector",
        "train the view detector",
        "propose 3D boxes",
        "write the dataset",
    ]
    for stage, done in told.items():
        assert all(0 <= share <= 1 for share in done), stage
        assert done[-1] == 1, stage

    assert (result.drawn.frames, result.drawn.boxes) == (2, 5 * result.drawn.objects)
    assert [each.role for each in result.trained] == [DetectorKind.IMAGE, DetectorKind.VIEW]
    assert (result.annotated.done, result.annotated.failed) == (4, [])
    ((name, scores),) = result.scores.content.model_dump()["classes"].items()
    assert (name, scores["objects"]) == (label, 4), "only the two unlabelled frames are scored"
    assert 0 <= scores["mean_iou"] <= 1

    assert len(open_recording(tmp_path / "recording")) == 4
    dataset = read_rcv(tmp_path / f"3D_{label.upper()}")
    counts = dataset.manifest.counts
    assert (counts.frames, counts.objects) == (result.dataset.frames, result.dataset.objects)
    # only detectors of exported boxes are named; such detectors may propose nothing
    proposed = dataset.manifest.counts.objects_by_source.get(Source.AUTO, 0)
    assert [detector.role for detector in dataset.manifest.detectors] == (["image", "view"] if proposed else [])
    with open_project(tmp_path / "demo") as project:
        assert project.config.classes == (label,)
        assert project.config.settings.rotation is rotation
        assert project.statistics().labels.total == dataset.manifest.counts.objects
        assert project.problems() == []


def test_trainings_have_the_given_lengths() -> None:
    plan = demo._training(TrainedPlan(image_pictures=11, view_pictures=22))
    assert (plan.image.pictures_seen, plan.view.pictures_seen) == (11, 22)


@pytest.mark.parametrize("there", ["recording", "demo", "3D_PERSON"])
def test_existing_folders_are_not_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: str) -> None:
    (tmp_path / there).mkdir()
    (tmp_path / there / "precious").write_text("mine")
    monkeypatch.setattr(
        writer, "_write", lambda *_: pytest.fail("the recording was generated before the folders were checked")
    )
    with pytest.raises(ConfigError, match="exists already; choose another folder"):
        run_trained(tmp_path, TrainedPlan(frames=4), lambda *_: None)
    assert (tmp_path / there / "precious").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == [there]


def test_an_unknown_preset_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown preset 'cats'"):
        run_trained(tmp_path, TrainedPlan(preset="cats"), lambda *_: None)
