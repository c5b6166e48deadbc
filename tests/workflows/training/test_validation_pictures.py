"""Validation pictures with a detector's boxes, and the stored curves of a training."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from view_detectors import Fixed

from annotator.detection.dataset import TrainingSample, write_dataset
from annotator.types import Box2D, BoxKind
from annotator.types.errors import DetectionError
from annotator.workflows.training.model_report import PICTURES, _curves, validation_pictures, write_validation_pictures

# with a low score, too
DETECTOR = Fixed(
    (Box2D("person", 10.0, 20.0, 40.0, 60.0, 0.9), Box2D("person", 60.0, 5.0, 75.0, 15.0, 0.1)), labels=("person",)
)


@pytest.mark.parametrize("groups", [1, 4, 30])
def test_validation_pictures_are_written_beside_the_model(tmp_path: Path, groups: int) -> None:
    grey = np.full((80, 100, 3), 100, np.uint8)
    samples = [
        TrainingSample(grey, (Box2D("person", 10.0, 20.0, 40.0, 60.0),), str(number), "drawn")
        for number in range(groups)
    ]
    manifest = write_dataset(
        tmp_path / "set", samples, ("person",), lambda group: 0 < int(group) <= groups // 2, BoxKind.BOX
    )
    model = tmp_path / "model"
    model.mkdir()
    for _ in range(2):  # the second call replaces the first pictures
        paths = write_validation_pictures(tmp_path / "set", manifest, DETECTOR, model)
    assert len(paths) == min(manifest.images[manifest.measured_on], PICTURES)
    assert paths == validation_pictures(model)
    assert [path.name for path in model.iterdir()] == ["validation"]
    picture = cv2.imread(str(paths[0])).astype(int)
    scale = picture.shape[1] / 100
    assert max(picture.shape) == 448
    at = lambda x, y: picture[round((y + 0.5) * scale - 0.5), round((x + 0.5) * scale - 0.5)]  # noqa: E731
    assert np.ptp(at(10, 40)) > 60, "the box's edge is coloured"
    assert np.ptp(at(25, 40)) < 30
    assert np.ptp(at(60, 10)) < 30, "boxes with low scores are not drawn"


def test_a_missing_picture_is_an_error(tmp_path: Path) -> None:
    sample = TrainingSample(np.zeros((80, 100, 3), np.uint8), (Box2D("person", 10.0, 20.0, 40.0, 60.0),), "a", "drawn")
    manifest = write_dataset(tmp_path / "set", [sample], ("person",), "b".__eq__, BoxKind.BOX)
    for path in (tmp_path / "set" / "images").rglob("*.*"):
        path.unlink()
    with pytest.raises(DetectionError, match="cannot be read"):
        write_validation_pictures(tmp_path / "set", manifest, DETECTOR, tmp_path)


def test_curves_are_read_without_nan_values(tmp_path: Path) -> None:
    assert _curves(tmp_path / "none.csv") == ()
    head = "epoch,time,train/box_loss,metrics/mAP50(B),lr/pg0"
    (tmp_path / "curves.csv").write_text(f"{head}\n1,2.5,0.5,nan,0.1\n2,5,0.25,0.75,0.1\n")
    points = _curves(tmp_path / "curves.csv")
    assert [(point.epoch, point.metrics) for point in points] == [
        (1, {"box_loss": 0.5}),
        (2, {"box_loss": 0.25, "map50": 0.75}),
    ]
