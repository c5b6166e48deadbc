"""Compares our evaluation with that of the official evaluators, on a folder with reference inputs and results.

python -m benchmarks.golden DIR [--json]

Reports the largest difference of each part and where it occurs: KITTI's average precision in percentage points (all
`devkit` rows), SUN RGB-D's mean average precision (0..1), the IoU of freely rotated boxes (relative; for boxes that
only touch, the intersection as a share of the smaller box), KITTI's conventions (pixels of projected corners and 2D
boxes). A part is null if its files are not in the folder.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro
from pydantic import BaseModel, TypeAdapter, ValidationError

from annotator.evaluation.boxes import evaluate_oriented
from annotator.evaluation.kitti import (
    DIFFICULTIES,
    NEIGHBOURS,
    OFFICIAL,
    RELAXED,
    KittiResult,
    Metric,
    evaluate_kitti,
)
from annotator.formats.box_files import read_upright_boxes
from annotator.formats.kitti_folders import read_kitti_folder
from annotator.formats.kitti_rows import derived_box, heading, label_box, observation_angle, parse_row
from annotator.geometry.iou import intersection_volume_pairs
from annotator.geometry.oriented_box import box_corners
from annotator.geometry.projection import project
from annotator.recordings.kitti import KittiCalibration, read_calibration
from annotator.types import OrientedBox
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.evaluate import frame_tables, kitti_rows
from benchmarks.report import Options, Table, guarded, program

# The reference's corners in our order: bottom at +l +w, +l -w, -l -w, -l +w, then the top.
CORNERS = (2, 1, 0, 3, 6, 5, 4, 7)


class Expected(BaseModel):
    """The reference's results for a label."""

    corners_rect: list[tuple[float, float, float]]
    corner_uv: list[tuple[float, float]] | None
    box_unclipped: tuple[float, float, float, float]
    box_clipped: tuple[float, float, float, float]
    alpha: float
    center_velo: tuple[float, float, float]
    heading_velo: float


class Entry(BaseModel):
    """A label row with the calibration of its frame."""

    frame: str
    line: int
    label: str
    image_size: tuple[int, int]
    P2: list[float]
    R0_rect: list[float]
    Tr_velo_to_cam: list[float]
    expected: Expected


@dataclass(frozen=True)
class ConventionDifference:
    """The largest differences of one label, and the name of the quantity in pixels that differs most."""

    label: str
    what: str
    px: float
    corner_m: float
    center_lidar_m: float
    angle_rad: float


def convention_differences(path: Path) -> Iterator[ConventionDifference]:
    """The differences of every label in the file."""
    try:
        entries = TypeAdapter(list[Entry]).validate_python(json.loads(path.read_text(encoding="utf-8"))["labels"])
    except (OSError, ValueError, KeyError, TypeError, ValidationError) as error:
        raise FormatError(path, f"is not a list of labels with expected results ({error})") from error
    for entry in entries:
        row = parse_row(entry.label.split(), path, 1)
        box, calibration = label_box(row), _calibration(entry)
        px = _pixels(entry, box, calibration)
        what = max(px, key=lambda name: np.nan_to_num(px[name], nan=np.inf))
        expected, xyz = entry.expected, box_corners(box)[list(CORNERS)]
        center, heading_lidar = _in_lidar(box, calibration)
        alpha = observation_angle(row.rotation_y, row.x, row.z)
        angles = (alpha - expected.alpha, heading(box) - row.rotation_y, heading_lidar - expected.heading_velo)
        yield ConventionDifference(
            label=f"{entry.frame} line {entry.line} {row.label}",
            what=what,
            px=px[what],
            corner_m=float(np.abs(xyz - np.array(expected.corners_rect)).max()),
            center_lidar_m=float(np.abs(center - np.array(expected.center_velo)).max()),
            angle_rad=max(abs(float(np.angle(np.exp(1j * angle)))) for angle in angles),
        )


def _pixels(entry: Entry, box: OrientedBox, calibration: KittiCalibration) -> dict[str, float]:
    """The largest difference of each quantity in pixels, by name."""
    camera, T = calibration.camera(*entry.image_size), calibration.T_camera_label
    derived = derived_box(camera, box, T)
    if derived is None:
        return {"box": float("nan")}
    differences = {
        "box_unclipped": _largest(derived.unclipped, entry.expected.box_unclipped),
        "box_clipped": _largest(derived.clipped, entry.expected.box_clipped),
    }
    if entry.expected.corner_uv is not None:
        uv = project(camera, T.apply(box_corners(box)[list(CORNERS)]))
        differences["corner_uv"] = _largest(uv, entry.expected.corner_uv)
    return differences


def _largest(ours: object, expected: object) -> float:
    return float(np.abs(np.asarray(ours, np.float64) - np.asarray(expected, np.float64)).max())


def _calibration(entry: Entry) -> KittiCalibration:
    """The calibration, written to a file and read like that of a recording."""
    lines = [
        f"{name}: {' '.join(map(repr, values))}"
        for name, values in (("P2", entry.P2), ("R0_rect", entry.R0_rect), ("Tr_velo_to_cam", entry.Tr_velo_to_cam))
    ]
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{entry.frame}.txt"
        path.write_text("\n".join(lines) + "\n")
        return read_calibration(path)


def _in_lidar(box: OrientedBox, calibration: KittiCalibration) -> tuple[np.ndarray, float]:
    """Centre (metres) and heading (radians) in LiDAR coordinates."""
    turn, shift = calibration.T_rect_lidar[:, :3], calibration.T_rect_lidar[:, 3]
    center, along = np.linalg.solve(turn, np.stack([box.center_m - shift, box.rotation[:, 0]], axis=1)).T
    return center, float(np.arctan2(along[1], along[0]))


KITTI, KITTI_SETS = "expected_kitti.csv", "expected_kitti.json"
SUNRGBD, SUNRGBD_TRUTH, SUNRGBD_FOUND = "expected_sunrgbd.csv", "sunrgbd_gt.csv", "sunrgbd_det.csv"
PAIRS, CONVENTIONS = "iou3d_pairs.csv", "kitti_conventions.json"

# The official devkit, and the devkit with looser overlap thresholds. Rows of other evaluators are ignored.
EVALUATORS: Mapping[str, Mapping[str, float]] = {"devkit": OFFICIAL, "devkit_relaxed": RELAXED}
METRICS = {"2d": Metric.BBOX, "bev": Metric.BEV, "3d": Metric.BOX_3D, "aos": Metric.AOS}
# Boxes whose intersection is below this share of the smaller box only touch.
CONTACT = 1e-12


@dataclass
class Arguments(Options):
    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of reference inputs and the official evaluators' results."""


@dataclass(frozen=True)
class Difference:
    """Name of a compared number, and its absolute or relative difference from the reference."""

    what: str
    amount: float


def run(args: Arguments) -> dict[str, Any]:
    """The largest difference of each part, where it occurs, and the number of compared values."""
    result: dict[str, Any] = {}
    worst: dict[str, str | None] = {}
    compared: dict[str, int] = {}
    for part, (compare, *files) in PARTS.items():
        has_files = all((args.folder / name).exists() for name in files)
        differences = list(compare(args.folder)) if has_files else []
        # NaN counts as the largest difference
        largest = max(differences, key=lambda entry: np.nan_to_num(entry.amount, nan=np.inf), default=None)
        result[part] = None if largest is None else largest.amount
        worst[part] = None if largest is None else largest.what
        compared[part] = len(differences)
    if not any(compared.values()):
        looked_for = ", ".join(files[0] for _, *files in PARTS.values())
        raise ConfigError(f"{args.folder}: has no reference numbers; looked for {looked_for}")
    return {**result, "worst": worst, "compared": compared}


def kitti_differences(folder: Path) -> Iterator[Difference]:
    """Average precision, percentage points, of every row of `EVALUATORS`."""
    rows = [row for row in _table(folder / KITTI) if row["evaluator"] in EVALUATORS]
    # files of sets with other names than the default
    sets = json.loads((folder / KITTI_SETS).read_text())["sets"] if (folder / KITTI_SETS).exists() else {}
    for name in dict.fromkeys(row["set"] for row in rows):
        files = sets.get(name, {"det_zip": f"kitti_{name}_det.zip", "gt_zip": f"kitti_{name}_gt.zip"})
        detections = read_kitti_folder(folder / files["det_zip"], scored=True)
        truth = read_kitti_folder(folder / files["gt_zip"], scored=False)
        keys = sorted(truth)
        tables = [kitti_rows([side.get(key, ()) for key in keys]) for side in (detections, truth)]
        for evaluator, overlap in EVALUATORS.items():
            reference = [row for row in rows if (row["set"], row["evaluator"]) == (name, evaluator)]
            if reference:
                yield from _kitti_rows(reference, evaluate_kitti(tables[0], tables[1], overlap))


def _kitti_rows(rows: list[dict[str, str]], result: KittiResult) -> Iterator[Difference]:
    names = {label.lower(): label for label in NEIGHBOURS}
    for row in rows:
        label, metric = names[row["class"].lower()], METRICS[row["metric"]]
        what = " ".join(row[key] for key in ("set", "evaluator", "class", "metric", "difficulty"))
        curves = result.get(label, {}).get(metric)
        curve = None if curves is None else curves[DIFFICULTIES.index(row["difficulty"])]
        for points in ("R11", "R40"):
            ours = float("nan") if curve is None else (curve.r11 if points == "R11" else curve.r40)
            yield Difference(f"{what} {points}", abs(ours - float(row[f"AP_{points}"])))


def sunrgbd_differences(folder: Path) -> Iterator[Difference]:
    """Average precision of each class, and their mean, at each threshold; 0..1."""
    rows = _table(folder / SUNRGBD)
    thresholds = sorted({float(row["iou"]) for row in rows})
    detections, truth = frame_tables(
        read_upright_boxes(folder / SUNRGBD_FOUND, scored=True), read_upright_boxes(folder / SUNRGBD_TRUTH)
    )
    result = evaluate_oriented(detections, truth, thresholds)
    for row in rows:
        threshold, label = float(row["iou"]), row["class"]
        if label.startswith("ALL"):
            ours = result.mean(threshold)
        else:
            one = result.classes.get(label)
            ours = float("nan") if one is None else one.curves[threshold].area
        yield Difference(f"{row['class']} at {row['iou']}", abs(ours - float(row["AP"])))


def iou_differences(folder: Path) -> Iterator[Difference]:
    """Relative error of each pair's IoU; for boxes that only touch, the intersection's share of the smaller box."""
    rows = _table(folder / PAIRS)
    sides = [
        (
            _columns(rows, *(f"{side}_c{k}" for k in "xyz")),
            _columns(rows, *(f"{side}_r{i}{j}" for i in range(3) for j in range(3))).reshape(-1, 3, 3),
            _columns(rows, *(f"{side}_s{k}" for k in "xyz")),
        )
        for side in "ab"
    ]
    shared = intersection_volume_pairs(*sides[0], *sides[1])
    volumes = np.stack([side[2].prod(axis=1) for side in sides])
    iou, smaller = shared / (volumes.sum(axis=0) - shared), volumes.min(axis=0)
    for row, ours, inner, least in zip(rows, iou.tolist(), shared.tolist(), smaller.tolist(), strict=True):
        true_iou, contact = float(row["iou"]), float(row["intersection"]) < CONTACT * least
        amount = inner / least if contact else abs(ours - true_iou) / true_iou
        yield Difference(f"pair {row['id']} ({row['kind']})", amount)


def convention_pixels(folder: Path) -> Iterator[Difference]:
    """Projected corners and 2D boxes, pixels."""
    for difference in convention_differences(folder / CONVENTIONS):
        yield Difference(f"{difference.label}: {difference.what}", difference.px)


def _table(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FormatError(path, f"cannot be read ({error})") from error


def _columns(rows: list[dict[str, str]], *names: str) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in rows])


# The name of each part in the result: the function that compares it, and its files.
PARTS: dict[str, tuple[Any, ...]] = {
    "kitti_max_ap": (kitti_differences, KITTI),
    "sunrgbd_max_map": (sunrgbd_differences, SUNRGBD, SUNRGBD_TRUTH, SUNRGBD_FOUND),
    "iou_max_rel": (iou_differences, PAIRS),
    "conventions_max_px": (convention_pixels, CONVENTIONS),
}


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    table = Table("part", "largest difference", "where", "numbers compared")
    for part in PARTS:
        shown = "no such files" if result[part] is None else f"{result[part]:.2e}"
        table.add(part, shown, result["worst"][part], result["compared"][part])
    return [table]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
