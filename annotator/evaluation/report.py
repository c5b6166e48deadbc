"""The report of an evaluation: a JSON object, a table, and curves to draw."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, RootModel

from annotator.evaluation.kitti import DIFFICULTIES, SAMPLES, KittiCurve, KittiResult, Metric
from annotator.evaluation.oriented import OrientedClass, OrientedResult, PrecisionRecall, SunRgbdResult

Row = tuple[str | int | float | None, ...]


@dataclass(frozen=True, eq=False)
class Line:
    """One curve: precision (for AOS, orientation similarity) over recall, both 0..1."""

    name: str
    recall: Float64[np.ndarray, "n"]
    precision: Float64[np.ndarray, "n"]


@dataclass(frozen=True)
class Diagram:
    """The curves of one diagram; `name` is used as a file name."""

    name: str
    title: str
    y_label: str
    lines: Sequence[Line]


@dataclass(frozen=True)
class Report:
    """The report of one evaluation.

    Attributes:
        content: the JSON object.
        columns, rows: the table; the user interface rounds numbers and leaves None and NaN empty.
        diagrams: the diagrams.
        notes: remarks needed to interpret the numbers.
    """

    content: BaseModel
    columns: Sequence[str]
    rows: Sequence[Row]
    diagrams: Sequence[Diagram]
    notes: Sequence[str] = ()


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class KittiAp(_Record):
    """Average precision at easy, moderate and hard, percent."""

    R11: tuple[float, float, float]
    R40: tuple[float, float, float]


KittiContent = RootModel[dict[str, dict[Metric, KittiAp]]]


class SunRgbdAp(_Record):
    """Average precision at one IoU threshold, 0..1; null without classes."""

    mAP: float | None
    AP: dict[str, float]


SunRgbdContent = RootModel[dict[str, SunRgbdAp]]


class OrientedClassContent(_Record):
    """The content of `OrientedClass`; null for values that could not be measured."""

    AP: dict[str, float]
    mean_iou: float
    rotation_error_rad: float | None
    size_error: float | None
    center_error_m: float | None
    objects: int
    detections: int
    matched: int


class OrientedContent(_Record):
    """Mean average precision at each IoU threshold, 0..1, and the classes."""

    mAP: dict[str, float | None]
    classes: dict[str, OrientedClassContent]


def kitti_report(result: KittiResult) -> Report:
    """R11 and R40, percent; one diagram per class and metric."""
    content = {
        label: {
            metric: KittiAp(R11=_three(curves, "r11"), R40=_three(curves, "r40"))
            for metric, curves in by_metric.items()
        }
        for label, by_metric in result.curves.items()
    }
    rows: list[Row] = [
        (label, m.value, *ap.R11, *ap.R40) for label, by_metric in content.items() for m, ap in by_metric.items()
    ]
    heads = [f"{name} {level}" for name in ("R11", "R40") for level in DIFFICULTIES]
    diagrams = [
        _kitti_diagram(label, m, curves)
        for label, by_metric in result.curves.items()
        for m, curves in by_metric.items()
    ]
    return Report(KittiContent(content), ["class", "metric", *heads], rows, diagrams)


def sunrgbd_report(result: SunRgbdResult) -> Report:
    """AP and final recall at each threshold; one diagram per threshold."""
    content = {
        f"{threshold:g}": SunRgbdAp(mAP=_or_none(result.mean(threshold)), AP={c: v.area for c, v in by_class.items()})
        for threshold, by_class in result.curves.items()
    }
    thresholds = list(result.curves)
    heads = [f"{what} {threshold:g}" for what in ("AP", "recall") for threshold in thresholds]
    rows: list[Row] = [
        (
            label,
            count,
            result.detections[label],
            *(result.curves[threshold][label].area for threshold in thresholds),
            *(result.curves[threshold][label].final_recall for threshold in thresholds),
        )
        for label, count in result.objects.items()
    ]
    rows.append(("mean", None, None, *map(result.mean, thresholds), *(None for _ in thresholds)))
    diagrams = [
        Diagram(f"iou_{threshold:g}", f"IoU above {threshold:g}", "precision", _lines(by_class))
        for threshold, by_class in result.curves.items()
    ]
    return Report(SunRgbdContent(content), ["class", "objects", "detections", *heads], rows, diagrams)


def oriented_report(result: OrientedResult) -> Report:
    """AP, mean IoU and pose errors (degrees and percent in the table); one diagram per class."""
    thresholds = list(next(iter(result.classes.values())).curves) if result.classes else []
    content = OrientedContent(
        mAP={f"{threshold:g}": _or_none(result.mean(threshold)) for threshold in thresholds},
        classes={label: _oriented_class(one) for label, one in result.classes.items()},
    )
    heads = [f"AP {threshold:g}" for threshold in thresholds]
    rows: list[Row] = [
        (
            label,
            one.objects,
            one.detections,
            *(one.curves[threshold].area for threshold in thresholds),
            one.mean_iou,
            float(np.degrees(one.rotation_error_rad)),
            100.0 * one.size_error,
            one.center_error_m,
        )
        for label, one in result.classes.items()
    ]
    rows.append(("mean", None, None, *map(result.mean, thresholds), None, None, None, None))
    diagrams = [
        Diagram(label, label, "precision", _lines({f"IoU above {t:g}": curve for t, curve in one.curves.items()}))
        for label, one in result.classes.items()
    ]
    columns = ["class", "objects", "detections", *heads, "mean IoU", "rotation deg", "size %", "centre m"]
    return Report(content, columns, rows, diagrams)


def _three(curves: Iterable[KittiCurve], name: str) -> tuple[float, float, float]:
    easy, moderate, hard = (float(getattr(curve, name)) for curve in curves)
    return easy, moderate, hard


def _kitti_diagram(label: str, metric: Metric, curves: Iterable[KittiCurve]) -> Diagram:
    at = np.linspace(0.0, 1.0, SAMPLES)
    y_label = "orientation similarity" if metric is Metric.AOS else "precision"
    lines = [
        Line(f"{level} (R40 {curve.r40:.2f})", at, curve.samples)
        for level, curve in zip(DIFFICULTIES, curves, strict=True)
    ]
    return Diagram(f"{label}_{metric.value}", f"{label}, {metric.value}", y_label, lines)


def _lines(curves: Mapping[str, PrecisionRecall]) -> list[Line]:
    return [Line(f"{name} (AP {c.area:.3f})", c.recall, c.precision) for name, c in curves.items()]


def _oriented_class(one: OrientedClass) -> OrientedClassContent:
    return OrientedClassContent(
        AP={f"{threshold:g}": curve.area for threshold, curve in one.curves.items()},
        mean_iou=one.mean_iou,
        rotation_error_rad=_or_none(one.rotation_error_rad),
        size_error=_or_none(one.size_error),
        center_error_m=_or_none(one.center_error_m),
        objects=one.objects,
        detections=one.detections,
        matched=one.matched,
    )


def _or_none(value: float) -> float | None:
    """The value, or None for NaN and infinity, which JSON cannot represent."""
    return value if np.isfinite(value) else None
