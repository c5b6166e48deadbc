"""The report of an evaluation: a JSON object, a table, and curves, which may be drawn as PNG files.

The only module that uses matplotlib, which is imported on first use.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, RootModel

from annotator.evaluation.boxes import SUNRGBD_THRESHOLDS, OrientedClass, OrientedResult, PrecisionRecall
from annotator.evaluation.kitti import DIFFICULTIES, SAMPLES, KittiCurve, KittiResult, Metric
from annotator.files import write_atomic
from annotator.types.errors import FormatError

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


Content = RootModel[dict[str, Any]]


def kitti_report(result: KittiResult) -> Report:
    """R11 and R40, percent; one diagram per class and metric."""
    content = {
        label: {
            metric: {"R11": [curve.r11 for curve in curves], "R40": [curve.r40 for curve in curves]}
            for metric, curves in by_metric.items()
        }
        for label, by_metric in result.items()
    }
    rows: list[Row] = [
        (label, m.value, *ap["R11"], *ap["R40"]) for label, by_metric in content.items() for m, ap in by_metric.items()
    ]
    heads = [f"{name} {level}" for name in ("R11", "R40") for level in DIFFICULTIES]
    diagrams = [
        _kitti_diagram(label, m, curves) for label, by_metric in result.items() for m, curves in by_metric.items()
    ]
    return Report(Content(content), ["class", "metric", *heads], rows, diagrams)


def sunrgbd_report(result: OrientedResult) -> Report:
    """AP, 0..1, and final recall at each threshold; null without classes; one diagram per threshold."""
    by_threshold = {
        threshold: {label: one.curves[threshold] for label, one in result.classes.items()}
        for threshold in SUNRGBD_THRESHOLDS
    }
    content = {
        f"{threshold:g}": {"mAP": _or_none(result.mean(threshold)), "AP": {c: v.area for c, v in curves.items()}}
        for threshold, curves in by_threshold.items()
    }
    heads = [f"{what} {threshold:g}" for what in ("AP", "recall") for threshold in by_threshold]
    rows: list[Row] = [
        (label, one.objects, one.detections, *(c.area for c in curves), *(c.final_recall for c in curves))
        for label, one in result.classes.items()
        for curves in (one.curves.values(),)
    ]
    rows.append(("mean", None, None, *map(result.mean, by_threshold), *(None for _ in by_threshold)))
    diagrams = [
        Diagram(f"iou_{threshold:g}", f"IoU above {threshold:g}", "precision", _lines(curves))
        for threshold, curves in by_threshold.items()
    ]
    return Report(Content(content), ["class", "objects", "detections", *heads], rows, diagrams)


def oriented_report(result: OrientedResult) -> Report:
    """AP, mean IoU and pose errors (degrees and percent in the table); one diagram per class."""
    thresholds = list(next(iter(result.classes.values())).curves) if result.classes else []
    content = {
        "mAP": {f"{threshold:g}": _or_none(result.mean(threshold)) for threshold in thresholds},
        "classes": {label: _oriented_class(one) for label, one in result.classes.items()},
    }
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
    return Report(Content(content), columns, rows, diagrams)


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


def _oriented_class(one: OrientedClass) -> dict[str, Any]:
    names = ("mean_iou", "rotation_error_rad", "size_error", "center_error_m")
    areas = {f"{threshold:g}": curve.area for threshold, curve in one.curves.items()}
    counts = {"objects": one.objects, "detections": one.detections, "matched": one.matched}
    return {"AP": areas, **{name: _or_none(getattr(one, name)) for name in names}, **counts}


def _or_none(value: float) -> float | None:
    """The value, or None for NaN and infinity, which JSON cannot represent."""
    return value if np.isfinite(value) else None


INCHES = (6.4, 4.8)
DPI = 120


def draw_curves(diagrams: Sequence[Diagram], folder: Path) -> list[Path]:
    """Writes one PNG per diagram into a folder, which is created if missing; existing files are replaced.

    Returns:
        the files, in the order of the diagrams.

    Raises:
        FormatError: the folder or a file cannot be written.
    """
    written: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for diagram in diagrams:
            # class names may contain characters that are invalid in file names
            path = folder / (re.sub(r"[^\w.-]+", "_", diagram.name).lstrip(".") + ".png")
            if path in written:
                path = path.with_stem(f"{path.stem}-{len(written)}")
            write_atomic(path, _png(diagram))
            written.append(path)
    except OSError as error:
        raise FormatError(folder, f"the curves cannot be written ({error.strerror})") from error
    return written


def _png(diagram: Diagram) -> bytes:
    # not pyplot, which needs a display
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=INCHES, dpi=DPI, layout="constrained")
    axes = figure.add_subplot(xlim=(0.0, 1.0), ylim=(0.0, 1.02), xlabel="recall", ylabel=diagram.y_label)
    axes.set_title(diagram.title)
    axes.grid(alpha=0.3)
    for line in diagram.lines:
        axes.plot(line.recall, line.precision, label=line.name)
    if diagram.lines:
        axes.legend(loc="lower left", fontsize="small")
    content = io.BytesIO()
    FigureCanvasAgg(figure).print_png(content)
    return content.getvalue()
