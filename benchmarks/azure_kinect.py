"""Compares our Azure Kinect geometry with results of the camera's SDK, and times the reading of a frame.

python -m benchmarks.azure_kinect RECORDING.mkv ROWS.csv [--repeats 30] [--json]

Each row is a depth pixel with its depth and the SDK's results: the point in the depth camera's frame and in the colour
camera's frame (millimetres), and the colour pixel. Each of our stages starts from our result of the previous stage.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from annotator.geometry.projection import project, undistort_px
from annotator.recordings import open_recording
from annotator.recordings.kinect.calibration import MM_PER_M
from annotator.recordings.kinect.mkv_recording import AzureKinect
from annotator.types.errors import ConfigError, FormatError
from benchmarks.report import Options, Table, guarded, program, require, seconds_of

PIXEL, DEPTH = ("u_depth_px", "v_depth_px"), ("depth_mm",)
IN_DEPTH, IN_COLOR, COLOR_PIXEL = ("x_d", "y_d", "z_d"), ("x_c", "y_c", "z_c"), ("u_color_px", "v_color_px")


@dataclass
class Arguments(Options):
    recording: tyro.conf.Positional[Path]
    """The .mkv file."""
    rows: tyro.conf.Positional[Path]
    """The CSV file with the SDK's numbers."""
    repeats: int = 0
    """How often the first frame, with its coloured cloud, is read for the timing; 0 = no timing."""


def read_rows(path: Path) -> dict[str, np.ndarray]:
    """The columns of the CSV file, by name."""
    names = (*PIXEL, *DEPTH, *IN_DEPTH, *IN_COLOR, *COLOR_PIXEL)
    values: list[list[float]] = []
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            missing = [name for name in names if name not in (reader.fieldnames or ())]
            if missing:
                raise FormatError(path, f"has no column {', '.join(missing)}", 1)
            for row in reader:
                try:
                    values.append([float(row[name]) for name in names])
                except (TypeError, ValueError) as error:
                    problem = f"a value is missing or not a number ({error})"
                    raise FormatError(path, problem, reader.line_num) from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FormatError(path, f"cannot be read ({error})") from error
    if not values:
        raise FormatError(path, "has no rows")
    return dict(zip(names, np.array(values).T, strict=True))


def compare(recording: AzureKinect, rows: dict[str, np.ndarray]) -> tuple[float, float]:
    """Largest errors: of a point, millimetres; of a colour pixel, pixels (NaN if only the SDK finds one)."""

    def columns(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([rows[name] for name in names], axis=1)

    calibration = recording.calibration
    in_image = columns(PIXEL)
    rays = np.column_stack([undistort_px(calibration.depth, in_image), np.ones(len(in_image))])
    in_depth = rays * (rows["depth_mm"] / MM_PER_M)[:, None]
    in_color = calibration.T_color_depth.apply(in_depth)
    px = project(calibration.color, in_color)
    distances_mm = [
        np.linalg.norm(ours * MM_PER_M - columns(names), axis=1)
        for ours, names in ((in_depth, IN_DEPTH), (in_color, IN_COLOR))
    ]
    return float(np.max(distances_mm)), float(np.linalg.norm(px - columns(COLOR_PIXEL), axis=1).max())


def run(args: Arguments) -> dict[str, Any]:
    require(args, 0, 1_000_000, "repeats")
    recording = open_recording(args.recording)
    if not isinstance(recording, AzureKinect):
        raise ConfigError(f"{args.recording}: has the format {recording.format}; give an Azure Kinect's .mkv file")
    rows = read_rows(args.rows)
    max_point_mm, max_px = compare(recording, rows)
    result: dict[str, object] = {"rows": len(rows["depth_mm"]), "max_point_mm": max_point_mm, "max_px": max_px}
    if args.repeats:
        recording.frame(0)  # the work that is done once per recording
        seconds = [seconds_of(lambda: recording.frame(0)) for _ in range(args.repeats)]
        result["frame_ms"] = float(np.median(seconds) * 1e3)
    return result


def tables(args: Arguments, result: dict[str, Any]) -> list[Table]:
    heads = ("rows", "largest distance of a point, mm", "of a colour pixel, px", *["frame, ms"][: args.repeats])
    cells = [f"{value:.5f}" if isinstance(value, float) else value for value in result.values()]
    return [Table(*heads, rows=[cells])]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
