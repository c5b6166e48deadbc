"""Compares our KITTI conventions with reference numbers: corners, projection, 2D boxes, alpha, LiDAR coordinates."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError

from annotator.formats.kitti_rows import derived_box, heading, label_box, observation_angle, parse_label_line
from annotator.geometry.oriented_box import box_corners
from annotator.geometry.projection import project
from annotator.recordings.kitti.calibration import KittiCalibration, read_calibration
from annotator.types import OrientedBox
from annotator.types.errors import FormatError

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
    """The largest differences of one label.

    Attributes:
        label: frame, line and class.
        what: name of the quantity in pixels that differs most.
        px: its difference, pixels.
        corner_m: largest difference of the corners, metres.
        center_lidar_m: difference of the centre in LiDAR coordinates, metres.
        angle_rad: largest difference of alpha and heading, radians.
    """

    label: str
    what: str
    px: float
    corner_m: float
    center_lidar_m: float
    angle_rad: float


def convention_differences(path: Path) -> Iterator[ConventionDifference]:
    """The differences of every label in the file.

    Raises:
        FormatError: the file does not have the expected content.
    """
    try:
        entries = TypeAdapter(list[Entry]).validate_python(json.loads(path.read_text(encoding="utf-8"))["labels"])
    except (OSError, ValueError, KeyError, TypeError, ValidationError) as error:
        raise FormatError(path, f"is not a list of labels with expected results ({error})") from error
    for entry in entries:
        row = parse_label_line(entry.label, path)
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
