"""Converts the named columns of point cloud files to points, colours and reflectances."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from annotator.frame_limits import memory_problem
from annotator.recordings.clouds.colors import point_colors, split_colors
from annotator.recordings.plausible import are_returns
from annotator.text import to_number
from annotator.types.errors import FrameError

CLOUD_REMEDY = "save the cloud again, or remove the frame"
NO_RETURN = "every point is NaN or infinite, or (0, 0, 0), which means no return"
REFLECTANCE_NAMES = ("reflectance", "intensity", "scalar_intensity", "scalar_reflectance", "i")
# Maximum of reflectance values: fractions, 8 bits or 16 bits.
REFLECTANCE_SCALES = (1.0, 255.0, 65535.0)
# Share of the points that may be at the limit of one coordinate's type.
MOST_SATURATED = 0.01
# Longest number in a text file, characters.
LONGEST_NUMBER = 400


LINE = re.compile(rb"[^\r\n]+")
HEXADECIMAL = re.compile(rb"(?:0[xX]|#)[0-9a-fA-F]{1,8}")
# Windows writes -1.#IND or nan(ind), rounded also 1.#R; infinity (1.#INF) is no measurement either.
NOT_A_NUMBER = re.compile(rb"[-+]?(?:1\.#\w+|nan\(\w*\))", re.IGNORECASE)
# Values of text that are parsed together.
VALUES_AT_ONCE = 1 << 17


Scales = tuple[float, float]


@dataclass(frozen=True, eq=False)
class RawCloud:
    """The valid points of a file, in the file's own frame.

    Attributes:
        xyz_m: (n, 3), n > 0, finite.
        rgb: colours, or None.
        reflectance: 0..1, or None.
        scale: the reflectance that became 1, if only the values told; None = the file says it, or no reflectance.
        color_scale: the same for colours: the value that became 255.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None = None
    reflectance: Float32[np.ndarray, "n"] | None = None
    scale: float | None = None
    color_scale: float | None = None

    @property
    def scales(self) -> Scales:
        """Both scales; 0 = said by the file, or not there."""
        return self.scale or 0.0, self.color_scale or 0.0

    def select(self, keep: np.ndarray) -> RawCloud:
        """Returns the points of a mask (n,), of which one is true at least."""
        return replace(
            self,
            xyz_m=self.xyz_m[keep],
            rgb=None if self.rgb is None else self.rgb[keep],
            reflectance=None if self.reflectance is None else self.reflectance[keep],
        )

    def with_scales(self, least: Scales) -> RawCloud:
        """Returns the cloud with at least these scales of reflectance and colours."""
        cloud = self
        if self.reflectance is not None and self.scale is not None and self.scale < least[0]:
            share = np.float32(self.scale / least[0])
            cloud = replace(cloud, reflectance=self.reflectance * share, scale=least[0])
        if self.rgb is not None and self.color_scale is not None and self.color_scale < least[1]:
            rgb = np.rint(self.rgb * (self.color_scale / least[1])).astype(np.uint8)
            cloud = replace(cloud, rgb=rgb, color_scale=least[1])
        return cloud


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
    valid = are_returns(xyz_m) & ~at_limits(path, [columns[name] for name in "xyz"])
    if not valid.any():
        problem = NO_RETURN if len(valid) else "has no points"
        raise FrameError(path, problem, CLOUD_REMEDY)
    colors, (reflectance, scale) = point_colors(columns), _reflectance(columns)
    rgb, color_scale = (None, None) if colors is None else colors
    return RawCloud(xyz_m, rgb, reflectance, scale, color_scale).select(valid)


def at_limits(path: Path, xyz: Sequence[np.ndarray]) -> Bool[np.ndarray, "n"]:
    """Returns which points are no measurements: a coordinate, as it is stored, is at a limit of its type.

    Raises:
        FrameError: they are all points, or many along one axis only: what was measured did not fit the type.
    """
    stored = [_at_limit(values) for values in xyz]
    if not any(limited.any() for limited in stored):
        return stored[0]
    # all three: what NaN became, or a driver's "no return"
    some, every = np.any(stored, axis=0), np.all(stored, axis=0)
    for name, values, limited in zip("xyz", xyz, stored, strict=True):
        single = np.count_nonzero(limited & ~every)
        if single > MOST_SATURATED * len(some) or (len(some) and every.all()):
            problem = (
                f"{name} is at the limit of {values.dtype.name} in {np.count_nonzero(limited)} of {len(some)} points"
            )
            remedy = "save it with an offset near the points, or in larger steps"
            raise FrameError(path, f"its coordinates are saturated: {problem}", remedy)
    return some


def _at_limit(values: np.ndarray) -> Bool[np.ndarray, "n"]:
    """Bytes use their whole range, and the limits of longer floats are beyond `LARGEST`."""
    dtype = values.dtype
    if dtype != np.float16 and (dtype.kind not in "iu" or dtype.itemsize == 1):
        return np.zeros(len(values), bool)
    limits = np.finfo(np.float16) if dtype.kind == "f" else np.iinfo(dtype)
    highest = values == limits.max
    return highest if dtype.kind == "u" else highest | (values == limits.min)


def fractions(values: Float[np.ndarray, "n"]) -> tuple[Float32[np.ndarray, "n"] | None, float | None]:
    """Returns reflectances as 0..1, and their scale: of the usual ones, the first that holds all of them.

    None if all are the highest number of 8 or 16 bits, which says nothing: they are a filling, or saturated.
    """
    highest = float(values.max(initial=0.0))
    if len(values) > 1 and highest in REFLECTANCE_SCALES[1:] and float(values.min()) == highest:
        return None, None
    scale = next((scale for scale in REFLECTANCE_SCALES if highest <= scale), highest)
    return np.clip(values.astype(np.float64) / scale, 0, 1).astype(np.float32), scale


def _real(values: np.ndarray) -> np.ndarray:
    """Returns the values as doubles; signalling NaNs in damaged files must not raise."""
    with np.errstate(all="ignore"):
        return values.astype(np.float64)


def _reflectance(columns: Mapping[str, np.ndarray]) -> tuple[Float32[np.ndarray, "n"] | None, float | None]:
    """Returns reflectances and their scale, if the values tell it."""
    name = next((name for name in REFLECTANCE_NAMES if name in columns), None)
    if name is None:
        return None, None
    values = np.nan_to_num(_real(columns[name]), nan=0.0, posinf=0.0, neginf=0.0)
    found, scale = fractions(values)
    if found is not None and columns[name].dtype == np.uint8:
        return np.asarray(values / REFLECTANCE_SCALES[1]).astype(np.float32), None
    return found, scale


def text_columns(
    path: Path,
    body: bytes,
    count: int,
    names: tuple[str, ...],
    first_line: int,
    pick: Callable[[list[bytes]], list[bytes]] | None = None,
) -> dict[str, np.ndarray]:
    """Parses columns stored as text, one row per line.

    Args:
        body: the text; anything after the rows is ignored.
        count: the number of rows.
        first_line: line number of the body's first line in the file, for messages.
        pick: returns the values of `names` among those of a line; None = they are its first.

    Raises:
        FrameError: too few rows, or a value that is missing or not a number.
    """
    # each value needs two bytes: impossible counts are rejected before memory is allocated
    if count * len(names) * 2 > len(body) + 1:
        raise FrameError(path, f"declares {count} points, too many for its {len(body)} bytes", CLOUD_REMEDY)
    require_points(path, count, more_bytes=count * len(names) * 8)
    table = np.empty((count, len(names)))
    rows, filled, at_once = _text_rows(path, body, names, first_line, pick), 0, max(VALUES_AT_ONCE // len(names), 1)
    while part := list(islice(rows, min(at_once, count - filled))):
        table[filled : filled + len(part)] = _numbers(path, np.array(part), filled)
        filled += len(part)
    if filled < count:
        raise FrameError(path, f"declares {count} points but has {filled}", CLOUD_REMEDY)
    return {name: table[:, column] for column, name in enumerate(names)}


def _numbers(path: Path, texts: np.ndarray, above: int) -> Float64[np.ndarray, "n c"]:
    """Returns the numbers of a table of texts that has `above` rows before it."""
    # numpy would accept 1_000, which `to_number` refuses
    if b"_" not in texts.tobytes():
        with suppress(ValueError):
            return np.asarray(texts.astype(np.float64))
    return np.array([[_number(path, text, row) for text in texts_of] for row, texts_of in enumerate(texts, above)])


def _number(path: Path, text: bytes, row: int) -> float:
    """Returns a number as programs write it: decimal, hexadecimal (colours), or one of the names of NaN."""
    if HEXADECIMAL.fullmatch(text):
        return float(int(text.lstrip(b"#"), 16))
    if NOT_A_NUMBER.fullmatch(text):
        return np.nan
    try:
        return to_number(text.decode("utf-8", "replace"))
    except ValueError as error:
        raise FrameError(path, f"point {row + 1}: {error}", CLOUD_REMEDY) from None


def typed(values: Float64[np.ndarray, "n"], dtype: np.dtype) -> np.ndarray:
    """Returns a column of text in the type that its header declares; as it is if its values do not fit the type.

    Floats stay doubles: whole numbers beyond 24 bits (packed colours) would lose digits.
    """
    if dtype.kind == "f":
        return values
    known = values[np.isfinite(values)]
    limits = np.iinfo(dtype)
    if len(known) < len(values) or not (np.rint(values) == values).all():
        return values
    # other writers put the bits of unsigned numbers into signed types, or the numbers themselves
    if dtype.kind == "i" and known.max(initial=0) > limits.max and known.min(initial=0) >= 0:
        dtype = np.dtype(f"u{dtype.itemsize}")
        limits = np.iinfo(dtype)
    fits = known.min(initial=0) >= limits.min and known.max(initial=0) <= limits.max
    return values.astype(dtype) if fits else values


def _text_rows(
    path: Path,
    body: bytes,
    names: tuple[str, ...],
    first_line: int,
    pick: Callable[[list[bytes]], list[bytes]] | None,
) -> Iterator[list[bytes]]:
    """Yields the values of each line that is not blank."""
    for line in LINE.finditer(body):
        values = line[0].split()
        if pick is not None and values:
            values = pick(values) or [b""]
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
    return field_columns(np.frombuffer(data, dtype, count, offset))


def field_columns(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the fields of a table by their names in lower case; of those with several values, only colours."""
    columns: dict[str, np.ndarray] = {}
    for name in rows.dtype.names or ():
        if rows[name].dtype.kind not in "fiu":
            continue
        if rows[name].ndim == 1:
            columns[name.lower()] = rows[name]
        elif rows[name].ndim == 2:
            columns |= split_colors(name.lower(), rows[name])
    return columns
