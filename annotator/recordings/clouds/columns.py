"""Converts the named columns of point cloud files to points, colours and reflectances."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from annotator.frame_limits import memory_problem
from annotator.recordings.plausible import are_returns
from annotator.types.errors import FrameError

CLOUD_REMEDY = "save the cloud again, or remove the frame"
NO_RETURN = "every point is NaN or infinite, or (0, 0, 0), which means no return"
COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
PACKED_NAMES = ("rgb", "rgba")
REFLECTANCE_NAMES = ("reflectance", "intensity", "scalar_intensity", "scalar_reflectance", "i")
# Maximum of reflectance values: fractions, 8 bits or 16 bits.
REFLECTANCE_SCALES = (1.0, 255.0, 65535.0)
# Longest number in a text file, characters.
LONGEST_NUMBER = 400


LINE = re.compile(rb"[^\r\n]+")
# Values of text that are parsed together.
VALUES_AT_ONCE = 1 << 17


@dataclass(frozen=True, eq=False)
class RawCloud:
    """The valid points of a file, in the file's own frame.

    Attributes:
        xyz_m: (n, 3), n > 0, finite.
        rgb: colours, or None.
        reflectance: 0..1, or None.
        scale: the value that became 1, if only the values told; None = the file says it, or no reflectance.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None = None
    reflectance: Float32[np.ndarray, "n"] | None = None
    scale: float | None = None

    def select(self, keep: np.ndarray) -> RawCloud:
        """Returns the points of a mask (n,), of which one is true at least."""
        return replace(
            self,
            xyz_m=self.xyz_m[keep],
            rgb=None if self.rgb is None else self.rgb[keep],
            reflectance=None if self.reflectance is None else self.reflectance[keep],
        )

    def with_scale(self, least: float) -> RawCloud:
        """Returns the cloud with at least this scale of reflectance."""
        if self.reflectance is None or self.scale is None or self.scale >= least:
            return self
        return replace(self, reflectance=self.reflectance * np.float32(self.scale / least), scale=least)


def require_points(path: Path, points: int, *, more_bytes: int = 0) -> None:
    """Checks a number of points before memory is allocated for them.

    Raises:
        FrameError: they are too many (`annotator.frame_limits`).
    """
    problem = memory_problem(points=points, more_bytes=more_bytes)
    if problem:
        raise FrameError(path, problem, "raise the limit, or save fewer points")


def from_columns(path: Path, columns: Mapping[str, np.ndarray]) -> RawCloud:
    """Returns the returns among the points of columns of equal length (`are_returns`); column names are lower case.

    Raises:
        FrameError: a column x, y or z is missing, or there is no valid point.
    """
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        present = ", ".join(columns) or "none"
        raise FrameError(path, f"has no column {' '.join(missing)} (its columns: {present})", CLOUD_REMEDY)
    require_points(path, len(columns["x"]))
    xyz_m = np.stack([_real(columns[name]) for name in "xyz"], axis=1)
    valid = are_returns(xyz_m)
    if not valid.any():
        problem = NO_RETURN if len(valid) else "has no points"
        raise FrameError(path, problem, CLOUD_REMEDY)
    rgb, (reflectance, scale) = _colors(columns), _reflectance(columns)
    return RawCloud(xyz_m, rgb, reflectance, scale).select(valid)


def fractions(values: Float[np.ndarray, "n"]) -> tuple[Float32[np.ndarray, "n"], float]:
    """Returns reflectances as 0..1, and their scale: of the usual ones, the first that holds all of them."""
    highest = float(values.max(initial=0.0))
    scale = next((scale for scale in REFLECTANCE_SCALES if highest <= scale), highest)
    return np.clip(values.astype(np.float64) / scale, 0, 1).astype(np.float32), scale


def _colors(columns: Mapping[str, np.ndarray]) -> UInt8[np.ndarray, "n 3"] | None:
    for names in COLOR_NAMES:
        if all(name in columns for name in names):
            return eight_bits(np.stack([columns[name] for name in names], axis=1))
    for name in PACKED_NAMES:
        if name in columns:
            return _unpack(columns[name])
    return None


def _real(values: np.ndarray) -> np.ndarray:
    """Returns the values as doubles; signalling NaNs in damaged files must not raise."""
    with np.errstate(all="ignore"):
        return values.astype(np.float64)


def eight_bits(values: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    """Returns colours as bytes: floats up to 1 are fractions; 16-bit numbers lose their lower byte."""
    if values.dtype == np.uint8:
        return values
    if values.dtype == np.uint16:
        return (values >> 8).astype(np.uint8)
    levels = np.nan_to_num(_real(values), nan=0.0)
    if values.dtype.kind == "f" and levels.max(initial=0.0) <= 1:
        levels = levels * 255
    return np.rint(np.clip(levels, 0, 255)).astype(np.uint8)


def _unpack(packed: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    """Returns the colours of PCD files: 0x00RRGGBB as an integer, or as the float with these bits."""
    with np.errstate(all="ignore"):
        bits = packed.astype(np.float32).view(np.uint32) if packed.dtype.kind == "f" else packed.astype(np.uint32)
    return np.stack([bits >> shift & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def _reflectance(columns: Mapping[str, np.ndarray]) -> tuple[Float32[np.ndarray, "n"] | None, float | None]:
    """Returns reflectances and their scale, if the values tell it."""
    name = next((name for name in REFLECTANCE_NAMES if name in columns), None)
    if name is None:
        return None, None
    values = np.nan_to_num(_real(columns[name]), nan=0.0, posinf=0.0, neginf=0.0)
    if columns[name].dtype in (np.uint8, np.uint16):
        return np.asarray(values / np.iinfo(columns[name].dtype).max).astype(np.float32), None
    return fractions(values)


def text_columns(path: Path, body: bytes, count: int, names: tuple[str, ...], first_line: int) -> dict[str, np.ndarray]:
    """Parses columns stored as text, one row per line.

    Args:
        body: the text; anything after the rows is ignored.
        count: the number of rows.
        first_line: line number of the body's first line in the file, for messages.

    Raises:
        FrameError: too few rows, or a value that is missing or not a number.
    """
    # each value needs two bytes: impossible counts are rejected before memory is allocated
    if count * len(names) * 2 > len(body) + 1:
        raise FrameError(path, f"declares {count} points, too many for its {len(body)} bytes", CLOUD_REMEDY)
    require_points(path, count, more_bytes=count * len(names) * 8)
    table = np.empty((count, len(names)))
    rows, filled, at_once = _text_rows(path, body, names, first_line), 0, max(VALUES_AT_ONCE // len(names), 1)
    while part := list(islice(rows, min(at_once, count - filled))):
        try:
            table[filled : filled + len(part)] = np.array(part).astype(np.float64)
        except ValueError as error:
            raise FrameError(path, f"a value is not a number ({error})", CLOUD_REMEDY) from error
        filled += len(part)
    if filled < count:
        raise FrameError(path, f"declares {count} points but has {filled}", CLOUD_REMEDY)
    return {name: table[:, column] for column, name in enumerate(names)}


def _text_rows(path: Path, body: bytes, names: tuple[str, ...], first_line: int) -> Iterator[list[bytes]]:
    """Yields the values of each line that is not blank."""
    for line in LINE.finditer(body):
        values = line[0].split()
        problem = ""
        if values and len(values) < len(names):
            problem = f"has {len(values)} values instead of {len(names)}"
        # a numpy array of strings reserves the longest length for every element
        elif values and max(map(len, values)) > LONGEST_NUMBER:
            problem = f"has a value of more than {LONGEST_NUMBER} characters"
        if problem:
            number = first_line + len(body[: line.start()].splitlines())
            raise FrameError(path, f"line {number} {problem}", CLOUD_REMEDY)
        if values:
            yield values[: len(names)]


def binary_columns(path: Path, data: bytes, offset: int, count: int, dtype: np.dtype) -> dict[str, np.ndarray]:
    """Returns columns stored as packed rows of `dtype` at `offset`.

    Raises:
        FrameError: the file is too short.
    """
    present = max(len(data) - offset, 0)
    if count * dtype.itemsize > present:
        raise FrameError(
            path,
            f"declares {count} points of {dtype.itemsize} bytes, but only {present} bytes of points follow",
            CLOUD_REMEDY,
        )
    rows = np.frombuffer(data, dtype, count, offset)
    # fields with several values per point (a normal, a histogram) are not needed
    return {name: rows[name] for name in dtype.names or () if rows[name].ndim == 1}
