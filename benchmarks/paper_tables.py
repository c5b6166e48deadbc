"""Tables that compare our figures with the paper's (Gui & Luximon, RA-L 2023)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from enum import StrEnum

from pydantic import JsonValue

from annotator.detection.config import TrainingConfig
from annotator.evaluation.kitti import DIFFICULTIES, Metric
from annotator.rcv.config import Strategy
from annotator.workflows.training.train import IMAGE_DEFAULTS
from benchmarks.report import Table

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
    recipe={
        "optimizer": "SGD",
        "momentum": 0.937,
        "warmup_epochs": 3.0,
        "mosaic": 1.0,
        "close_mosaic": 10,
        "scale": 0.5,
        "hsv_s": 0.7,
        "hsv_v": 0.4,
    },
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


def rcv_options(dataset: Dataset, axes: Strategy | None, preset: Preset) -> dict[str, JsonValue]:
    """The recursion's settings that differ from the project's.

    The paper keeps the coarse box of the first step on SUN RGB-D, but not on KITTI (II.B).
    """
    strategy = axes or (Strategy.NORMALS if preset is Preset.PAPER else Strategy.CONSENSUS)
    return {"strategy": strategy.value, "coarse_box": dataset is Dataset.SUNRGBD}


def classes_of(dataset: Dataset, classes: Classes) -> tuple[str, ...]:
    """The classes to train on and to evaluate."""
    return KITTI_CLASSES if dataset is Dataset.KITTI else SUNRGBD_CLASSES[classes]


KITTI_SOURCE = "Tab. III, AP R40 at IoU 0.5, KITTI test set"
# By share of the training data, class and metric (3D, bird's-eye view): AP of easy, moderate, hard; percent.
KittiRows = Mapping[float, Mapping[str, Mapping[str, tuple[float, float, float]]]]
KITTI_ROWS: KittiRows = {
    0.8: {
        "Pedestrian": {"3d": (40.19, 31.89, 28.32), "bev": (52.26, 42.93, 37.34)},
        "Cyclist": {"3d": (20.02, 13.93, 12.48), "bev": (28.51, 21.82, 18.94)},
    },
    0.5: {
        "Pedestrian": {"3d": (40.85, 31.60, 27.96), "bev": (51.14, 44.11, 38.39)},
        "Cyclist": {"3d": (16.66, 13.17, 11.18), "bev": (21.70, 17.70, 15.28)},
    },
    0.25: {
        "Pedestrian": {"3d": (37.50, 30.24, 26.72), "bev": (50.08, 43.52, 38.03)},
        "Cyclist": {"3d": (13.69, 11.22, 9.45), "bev": (19.55, 15.80, 13.60)},
    },
}
SUNRGBD_SOURCE = "Tab. II, AP at IoU 0.15, SUN RGB-D validation set"
# Percent; the classes in the order of `SUNRGBD_CLASSES`.
SUNRGBD_ROW = (65.44, 76.32, 22.48, 70.66, 18.06, 32.02, 56.19, 58.71, 42.85, 6.80)
SUNRGBD_MAP = 44.95
SUNRGBD_THRESHOLDS = ("0.15", "0.25", "0.5")

Ap = Mapping[str, Mapping[str, Mapping[str, Sequence[float]]] | None]
"""KITTI: class, metric, R11 or R40, then easy, moderate, hard; percent. None for a class without truth."""


def kitti_rows(fraction: float) -> KittiRows:
    """The paper's row for this share of the training data; all its rows if the paper has no row for this share."""
    return {share: row for share, row in KITTI_ROWS.items() if share == fraction} or KITTI_ROWS


def paper_of_kitti(fraction: float) -> dict[str, JsonValue]:
    """The paper's row for this share of the training data, or all its rows."""
    rows = kitti_rows(fraction)
    return {
        "table": KITTI_SOURCE,
        "rows": {
            f"{share:g}": {label: {metric: list(ap) for metric, ap in aps.items()} for label, aps in row.items()}
            for share, row in rows.items()
        },
    }


def paper_of_sunrgbd() -> dict[str, JsonValue]:
    """The paper's row, percent."""
    names = SUNRGBD_CLASSES[Classes.PAPER]
    return {"table": SUNRGBD_SOURCE, "AP": dict(zip(names, SUNRGBD_ROW, strict=True)), "mAP": SUNRGBD_MAP}


def kitti_ap(
    report: Mapping[str, JsonValue], classes: Sequence[str], true_classes: Collection[str]
) -> dict[str, JsonValue]:
    """AP of all our classes, percent; 0 for a class without detections, None for a class without true objects.

    `report` has by class, then metric, {"R11": [easy, moderate, hard], "R40": ...}.
    """
    zeros: dict[str, JsonValue] = {
        metric.value: {recalls: [0.0] * len(DIFFICULTIES) for recalls in ("R11", "R40")} for metric in Metric
    }
    return {label: report.get(label, zeros) if label in true_classes else None for label in classes}


def kitti_table(ours: Ap, fraction: float) -> Table:
    """One row per class and metric with our figures, each followed by the paper's R40 if the paper has one."""
    heads = [f"{recall} {level}" for recall in ("R11", "R40") for level in DIFFICULTIES]
    table = Table("class", "metric", "source", *heads)
    rows = kitti_rows(fraction)
    for label, metrics in ours.items():
        if metrics is None:
            table.add(label, "", "no true objects", *[""] * len(heads))
            continue
        for metric, ap in metrics.items():
            table.add(label, metric, "ours", *ap["R11"], *ap["R40"])
            for share, row in rows.items():
                if metric in row.get(label, {}):
                    table.add(label, metric, f"paper, {share:.0%}, test set", "", "", "", *row[label][metric])
    return table


def sunrgbd_ap(report: Mapping[str, Mapping[str, Mapping[str, float]]], classes: Sequence[str]) -> dict[str, JsonValue]:
    """AP of our classes at each threshold, percent, and the mean over the classes with true objects.

    `report` has by threshold {"AP": {class: 0..1}}; other classes are ignored.
    """
    by_threshold: dict[str, JsonValue] = {}
    for threshold in SUNRGBD_THRESHOLDS:
        by_class = {label: 100.0 * ap for label, ap in report[threshold]["AP"].items() if label in classes}
        mean = sum(by_class.values()) / len(by_class) if by_class else None
        by_threshold[threshold] = {"mAP": mean, "AP": {label: by_class.get(label) for label in classes}}
    return by_threshold


def sunrgbd_table(ours: Mapping[str, Mapping[str, JsonValue]], classes: Sequence[str]) -> Table:
    """One row with our figures per threshold, and the paper's row."""
    table = Table("source", "IoU", *classes, "mAP")
    for threshold, figures in ours.items():
        ap = figures["AP"]
        assert isinstance(ap, dict)  # built by `sunrgbd_ap`
        table.add("ours", threshold, *(ap[label] for label in classes), figures["mAP"])
    paper = dict(zip(SUNRGBD_CLASSES[Classes.PAPER], SUNRGBD_ROW, strict=True))
    mean = SUNRGBD_MAP if set(classes) == set(paper) else None
    table.add("paper", "0.15", *(paper.get(label) for label in classes), mean)
    return table
