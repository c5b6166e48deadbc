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
from annotator.rcv.teach import TaughtObject, TaughtView, teach_agnostic_views
from annotator.synthetic.snapshots import snapshot
from annotator.types import BoxKind
from annotator.workflows.training.base_detector import BASE_TRAINING, views_of

ROOT = Path(__file__).resolve().parents[3]
WHOLE, SEEN = AGNOSTIC_LABELS[BoxKind.BOX], AGNOSTIC_LABELS[BoxKind.SILHOUETTE]


def agnostic_views(seed: int, draws: int = 8) -> list[TaughtView]:
    shot = snapshot(seed)
    objects = [TaughtObject(item.label, item.box, item.points) for item in shot.objects]
    return teach_agnostic_views(
        shot.frame, objects, range(len(objects)), draws, RcvConfig(), None, np.random.default_rng(0)
    )


def test_a_view_has_one_object_with_two_boxes_or_none() -> None:
    taught = [view for seed in range(3, 6) for view in agnostic_views(seed)]
    labels = [tuple(box.label for box in view.boxes) for view in taught]
    assert labels.count((WHOLE, SEEN)) > 0.8 * len(labels)
    assert labels.count(()) > 0  # crops that miss their object
    assert set(labels) <= {(WHOLE, SEEN), (WHOLE,), (SEEN,), ()}


def test_equal_seeds_give_equal_training_images() -> None:
    one, two = (views_of(range(3), 2, BASE_TRAINING.image_size_px) for _ in range(2))
    assert len(one) > 10
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a.load(), b.load())
        assert (a.boxes, a.group) == (b.boxes, b.group)
    assert {sample.group for sample in one} == {f"snapshot/{seed}" for seed in range(3)}
    assert {max(sample.load().shape) for sample in one} == {BASE_TRAINING.image_size_px}


@pytest.mark.slow
def test_the_script_trains_and_installs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "train_base.py"))
    monkeypatch.setattr("annotator.detection.pretrained.FOLDER", tmp_path / "package")
    plan = {"frames": 3, "draws": 2, "pictures": 64, "size": 32, "install": True}
    script["run"](tmp_path / "work", **plan)
    files = sorted(path.name for path in (tmp_path / "package").iterdir())
    assert files == ["detector.safetensors", "manifest.json", "model.json"]
    trained, weights = read_trained(tmp_path / "package"), (tmp_path / "package" / "detector.safetensors").read_bytes()
    assert (trained.classes, trained.weights.read_bytes()) == ((WHOLE, SEEN), weights)
    manifest = json.loads((tmp_path / "package" / "manifest.json").read_text())
    assert (manifest["frames"], manifest["weights_sha256"]) == (3, hashlib.sha256(weights).hexdigest())
    # finished work is not repeated
    script["run"](tmp_path / "work", **plan)
    assert json.loads((tmp_path / "package" / "manifest.json").read_text()) == manifest
    assert capsys.readouterr().out.count("detector.safetensors: map50=") == 2
