"""Settings of training and of RCV for the paper's tables: the paper's, or annotator's defaults."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from pydantic import JsonValue

from annotator.detection.config import Augmentation, TrainingConfig
from annotator.rcv.config import Strategy, ViewConfig
from annotator.workflows.training.train import IMAGE_DEFAULTS, VIEW_DEFAULTS

# Thousands of wide images with small objects; the defaults are for a few dozen.
IMAGE = IMAGE_DEFAULTS.model_copy(update={"image_size_px": 256})


class Dataset(StrEnum):
    """The two benchmarks of the paper."""

    KITTI = "kitti"
    SUNRGBD = "sunrgbd"


class Preset(StrEnum):
    """PAPER: YOLOv5x6 at 640 px for both detectors (Tab. I), axes from normals (II.D). PRODUCT: our defaults."""

    PAPER = "paper"
    PRODUCT = "product"


class Classes(StrEnum):
    """SUN RGB-D's ten classes: those of the paper's Tab. II, or those of VoteNet's mAP@0.25."""

    PAPER = "paper"
    VOTENET = "votenet"


# YOLOv5's default recipe (hyp.scratch-low.yaml, 300 epochs), which the paper uses unchanged (III).
YOLOV5 = TrainingConfig(
    model="yolov5x6",
    image_size_px=640,
    epochs=300,
    optimizer="SGD",
    learning_rate=0.01,
    final_learning_rate=0.01,
    momentum=0.937,
    weight_decay=0.0005,
    warmup_epochs=3.0,
    augmentation=Augmentation(
        flip_horizontal=0.5, shift=0.1, scale=0.5, hue=0.015, saturation=0.7, brightness=0.4, mosaic=1.0
    ),
)

KITTI_CLASSES = ("Car", "Pedestrian", "Cyclist")
SUNRGBD_CLASSES = {
    # in the order of the table's columns
    Classes.PAPER: ("sink", "bed", "lamp", "chair", "desk", "dresser", "night_stand", "sofa", "table", "cabinet"),
    Classes.VOTENET: (
        *("bed", "table", "sofa", "chair", "toilet"),
        *("desk", "dresser", "night_stand", "bookshelf", "bathtub"),
    ),
}


@dataclass(frozen=True)
class Trainings:
    """Training settings of both detectors; None keeps the preset's value.

    Attributes:
        preset: the settings to start from.
        model: name of an ultralytics detection model for both detectors.
        epochs, image_epochs: epochs of the pseudo-view detector and of the image detector.
        size, image_size: side of their images, pixels.
    """

    preset: Preset
    model: str | None = None
    epochs: int | None = None
    image_epochs: int | None = None
    size: int | None = None
    image_size: int | None = None

    @property
    def image(self) -> TrainingConfig:
        """Training settings of the image detector."""
        start = YOLOV5 if self.preset is Preset.PAPER else IMAGE
        return _with(start, self.model, self.image_epochs, self.image_size)

    @property
    def view(self) -> TrainingConfig:
        """Training settings of the pseudo-view detector."""
        start = YOLOV5 if self.preset is Preset.PAPER else VIEW_DEFAULTS
        return _with(start, self.model, self.epochs, self.size)

    @property
    def view_px(self) -> int:
        """Longer side of a rendered pseudo-view, pixels; with the paper's settings that of the network's input."""
        return self.view.image_size_px if self.preset is Preset.PAPER else ViewConfig().size_px


def rcv_options(dataset: Dataset, axes: Strategy | None, preset: Preset) -> dict[str, JsonValue]:
    """The recursion's settings that differ from the project's.

    The paper keeps the coarse box of the first step on SUN RGB-D, but not on KITTI (II.B).
    """
    strategy = axes or (Strategy.NORMALS if preset is Preset.PAPER else Strategy.CONSENSUS)
    return {"strategy": strategy.value, "coarse_box": dataset is Dataset.SUNRGBD}


def classes_of(dataset: Dataset, classes: Classes) -> tuple[str, ...]:
    """The classes to train on and to evaluate."""
    return KITTI_CLASSES if dataset is Dataset.KITTI else SUNRGBD_CLASSES[classes]


def _with(start: TrainingConfig, model: str | None, epochs: int | None, size: int | None) -> TrainingConfig:
    """The settings, with each value that is not None replaced.

    Raises:
        ValidationError: a number out of its range.
    """
    options = {"model": model, "epochs": epochs, "image_size_px": size}
    changes = {name: value for name, value in options.items() if value is not None}
    return TrainingConfig.model_validate({**start.model_dump(), **changes})
