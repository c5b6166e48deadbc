"""The base detector's training: views of generated objects, with what is seen of each and its whole extent."""

from __future__ import annotations

import hashlib
import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from annotator.detection.trained import read_trained
from annotator.rcv.config import AGNOSTIC_LABELS, RcvConfig
from annotator.rcv.teach import TaughtObject, TaughtView, teach_views
from annotator.synthetic.snapshots import snapshot
from annotator.types import BoxKind
from annotator.types.errors import ConfigError
from annotator.workflows.training.base_detector import BASE_TRAINING, BasePlan, install_base, samples, train_base

ROOT = Path(__file__).resolve().parents[3]
WHOLE, SEEN = AGNOSTIC_LABELS[BoxKind.BOX], AGNOSTIC_LABELS[BoxKind.SILHOUETTE]
PLAN = BasePlan(frames=3, draws=2)


def views_of(seed: int, draws: int = 8) -> list[TaughtView]:
    shot = snapshot(seed)
    objects = [TaughtObject(item.label, item.box, item.points) for item in shot.objects]
    return teach_views(shot.frame, objects, None, draws, RcvConfig(), None, np.random.default_rng(0))


def test_a_view_has_one_object_with_two_boxes_or_none() -> None:
    taught = [view for seed in range(3, 6) for view in views_of(seed)]
    labels = [tuple(box.label for box in view.boxes) for view in taught]
    assert labels.count((WHOLE, SEEN)) > 0.8 * len(labels)
    assert labels.count(()) > 0  # crops that miss their object
    assert set(labels) <= {(WHOLE, SEEN), (WHOLE,), (SEEN,), ()}


def test_equal_plans_give_equal_training_images() -> None:
    one, two = list(samples(PLAN)), list(samples(PLAN))
    assert len(one) > 10
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a.load(), b.load())
        assert (a.boxes, a.group) == (b.boxes, b.group)
    assert {sample.group for sample in one} == {f"snapshot/{seed}" for seed in range(PLAN.frames)}
    assert {max(sample.load().shape) for sample in one} == {BASE_TRAINING.image_size_px}


@pytest.mark.slow
def test_a_base_detector_is_trained_and_put_into_a_package(tmp_path: Path) -> None:
    config = BASE_TRAINING.model_copy(update={"pictures_seen": 64, "image_size_px": 32})
    plan = PLAN.model_copy(update={"config": config})
    trained = train_base(tmp_path / "work", plan)
    assert trained.classes == (WHOLE, SEEN)
    manifest = install_base(tmp_path / "work", tmp_path / "package")
    files = sorted(path.name for path in (tmp_path / "package").iterdir())
    assert files == ["detector.safetensors", "manifest.json", "model.json"]
    weights = (tmp_path / "package" / "detector.safetensors").read_bytes()
    assert manifest.weights_sha256 == hashlib.sha256(weights).hexdigest()
    assert json.loads((tmp_path / "package" / "manifest.json").read_text())["views"] == manifest.views
    assert read_trained(tmp_path / "package").weights.read_bytes() == weights
    # finished work is not repeated
    assert train_base(tmp_path / "work", plan) == trained
    with pytest.raises(ConfigError, match="belongs to a training with other settings; use another folder"):
        train_base(tmp_path / "work", plan.model_copy(update={"frames": 4}))


@pytest.mark.slow
def test_the_script_trains_and_installs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "train_base.py"))
    monkeypatch.setattr("annotator.detection.pretrained.FOLDER", tmp_path / "package")
    script["run"](tmp_path / "work", frames=2, draws=1, pictures=32, size=32, install=True)
    printed = capsys.readouterr().out
    assert "detector.safetensors: map50=" in printed
    assert json.loads(printed[printed.index("{") :])["frames"] == 2
    assert (tmp_path / "package" / "detector.safetensors").is_file()
