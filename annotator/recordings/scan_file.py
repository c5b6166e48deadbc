"""`.bin` scans: rows of 32-bit floats without a header: x, y, z and, in rows of four or more, reflectance.

How many values a row has is never guessed. It is said by an option, by the file's name or place, or by the values of
several scans, if only one number is plausible. Without the option, each scan must agree.

    *.pcd.bin, LIDAR_TOP/*.bin            5, nuScenes: x y z intensity ring
    velodyne/*.bin, velodyne_points/...   4, KITTI: x y z reflectance

What the values say: if rows have C values, those at positions p, p + C, p + 2C ... are of one kind (all x, all
intensities), and those of neighbouring positions are not. So it is measured, for each C from 1 to 16, how much the
position within a row says about a value's sign, its magnitude, and whether it is whole, zero or not a number: their
mutual information in bits. It is highest for the true number and its multiples. Nothing is assumed about the order of
points, the sensor's pose or the unit, but x, y and z must come first.

Beams that fire in turns make every second point alike, so that rows of 3 look like rows of 6. Then the two points of
such a row vary together, unlike coordinates and other columns, and the number is uncertain. The limits are set so that
doubt is refused (16 of 1,000 made-up sets; none was read wrong).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Never

import numpy as np
from jaxtyping import Float32, Float64, Int64

from annotator.frame_limits import read_frame_file
from annotator.recordings.clouds.columns import (
    NO_RETURN,
    REFLECTANCE_SCALES,
    CommonScale,
    RawCloud,
    files_like,
    fractions,
)
from annotator.recordings.listing import file_errors
from annotator.recordings.plausible import LARGEST, are_returns
from annotator.types.errors import FrameError, UnclearError

BYTES_PER_VALUE = 4
FEWEST, MOST = 3, 8
# Longer rows are recognised, so that they are not taken for one of their divisors.
LONGEST = 16
# Of each scan, this many blocks of this many values are examined.
BLOCKS, BLOCK = 8, 1 << 11
# Information that columns of different kinds have at least, bits; few values need more, since chance gives some.
LEAST_BITS, BITS_OF_CHANCE = 0.1, 50.0
# A number of columns explains the values if it has this share of the highest information. Below the second share it
# fails, and between the two it is uncertain.
EXPLAINS, FAILS = 0.93, 0.8
# Coordinates beyond this are implausible, metres or millimetres; so are those below the smallest normal float.
FARTHEST = 1e7
MOST_IMPLAUSIBLE = 0.001
# Of the values of a whole-numbered column, this share is whole.
WHOLE = 0.999
# Two points in one row: two of their coordinates have at least this rank correlation, and similar spreads. Measured on
# some blocks of rows.
LEAST_CORRELATION, LARGEST_RATIO = 0.3, 60.0
ROW_BLOCKS, BLOCK_ROWS = 8, 256
LEAST_ROWS = 50
# Kinds of value: zero, not finite, denormal, then 61 magnitudes (powers of two) by sign and by being whole.
FIRST_EXPONENT, LAST_EXPONENT = 100, 160
KINDS = 3 + 4 * (LAST_EXPONENT - FIRST_EXPONENT + 1)


@dataclass(frozen=True)
class Evidence:
    """What the values of some scans say about their number of columns.

    Attributes:
        columns: the only plausible number, 3 to 8; None if there is none, or more than one.
        candidates: numbers that were not ruled out, longer rows included.
        reason: why `columns` is None; empty otherwise.
    """

    columns: int | None
    candidates: tuple[int, ...]
    reason: str = ""


def weigh_columns(scans: Sequence[bytes]) -> Evidence:
    """Returns what the contents of some `.bin` files of one sensor say about their number of columns."""
    sizes = np.array([len(scan) for scan in scans if scan and len(scan) % BYTES_PER_VALUE == 0])
    counts = np.zeros((LONGEST + 1, LONGEST, KINDS), np.int64)
    for scan in scans:
        _count(scan, counts)
    total = int(counts[1].sum())
    lengths = range(1, LONGEST + 1)
    bits = np.array([_information(counts[length, :length]) for length in lengths])
    # an incomplete file among whole ones does not rule its number out
    fits = {length for length in lengths if (sizes % (BYTES_PER_VALUE * length) == 0).sum() * 2 >= len(sizes)}
    possible = tuple(length for length in range(FEWEST, MOST + 1) if length in fits)
    highest = float(bits.max())
    if total == 0 or highest < LEAST_BITS + BITS_OF_CHANCE / total:
        return Evidence(None, possible, "its columns cannot be told apart by their values")
    share = bits / highest
    best = next(length for length in lengths if share[length - 1] >= EXPLAINS)
    candidates = _without_multiples([length for length in lengths if share[length - 1] > FAILS], share)
    if candidates != [best]:
        return _uncertain(candidates)
    rows = np.concatenate([_rows(scan, best) for scan in scans])
    halved = [length for length in range(2, best) if best % length == 0 and _holds_two_points(rows, length)]
    if halved:
        return _uncertain([*halved, best])
    if not FEWEST <= best <= MOST:
        return Evidence(None, (best,), f"its values look like rows of {best}")
    if best not in fits:
        return Evidence(
            None, (best,), f"its values look like rows of {best}, but its size is not a multiple of {4 * best} bytes"
        )
    problem = _problem(rows)
    return (
        Evidence(None, (), f"read as rows of {best} 32-bit floats, {problem}") if problem else Evidence(best, (best,))
    )


def _values(scan: bytes) -> tuple[Int64[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """Returns the positions and values of a scan's blocks."""
    values = np.frombuffer(scan, "<f4", len(scan) // BYTES_PER_VALUE)
    if len(values) <= BLOCKS * BLOCK:
        return np.arange(len(values)), values
    starts = np.linspace(0, len(values) - BLOCK, BLOCKS).astype(np.int64)
    places = (starts[:, None] + np.arange(BLOCK)).ravel()
    return places, values[places]


def _count(scan: bytes, counts: Int64[np.ndarray, "c r k"]) -> None:
    """Adds the kinds of a scan's values, for each length of row and position within it."""
    places, values = _values(scan)
    kinds = _kinds(values)
    for length in range(1, LONGEST + 1):
        counts[length, :length] += np.bincount(places % length * KINDS + kinds, minlength=length * KINDS).reshape(
            length, KINDS
        )


def _kinds(values: Float32[np.ndarray, "n"]) -> Int64[np.ndarray, "n"]:
    bits = values.view(np.uint32)
    exponent = (bits >> np.uint32(23) & np.uint32(255)).astype(np.int64)
    with np.errstate(invalid="ignore"):
        whole = np.rint(values) == values
    magnitude = np.clip(exponent, FIRST_EXPONENT, LAST_EXPONENT) - FIRST_EXPONENT
    kinds = 3 + 4 * magnitude + 2 * (bits >> np.uint32(31)).astype(np.int64) + whole
    kinds[exponent == 255] = 1
    kinds[exponent == 0] = 2
    kinds[values == 0] = 0
    return np.asarray(kinds)


def _information(counts: Int64[np.ndarray, "r k"]) -> float:
    """Returns the mutual information of position and kind, bits, corrected for chance (Miller and Madow)."""
    return float(_entropy(counts.sum(axis=0, keepdims=True)).mean() - _entropy(counts).mean())


def _entropy(counts: Int64[np.ndarray, "r k"]) -> Float64[np.ndarray, "r"]:
    total = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    p = counts / total
    plain = -(p * np.log2(np.where(p > 0, p, 1.0))).sum(axis=1)
    return np.asarray(plain + ((counts > 0).sum(axis=1) - 1) / (2 * np.log(2) * total[:, 0]))


def _without_multiples(lengths: list[int], share: Float64[np.ndarray, "c"]) -> list[int]:
    """Leaves out multiples of numbers that explain the values: they always do, too."""
    explaining = [length for length in lengths if share[length - 1] >= EXPLAINS]
    return [n for n in lengths if not any(n != other and n % other == 0 for other in explaining)]


def _rows(scan: bytes, columns: int) -> Float32[np.ndarray, "n c"]:
    """Returns some blocks of rows."""
    count = len(scan) // (BYTES_PER_VALUE * columns)
    rows = np.frombuffer(scan, "<f4", count * columns).reshape(count, columns)
    if count <= ROW_BLOCKS * BLOCK_ROWS:
        return rows
    starts = np.linspace(0, count - BLOCK_ROWS, ROW_BLOCKS).astype(np.int64)
    return np.concatenate([rows[start : start + BLOCK_ROWS] for start in starts])


def _problem(rows: Float32[np.ndarray, "n c"]) -> str:
    """Returns why the first three columns cannot be coordinates; empty if they can."""
    whole = []
    for values in rows[:, :3].T:
        values = values[np.isfinite(values) & (values != 0)]
        size = np.abs(values)
        implausible = np.count_nonzero((size > FARTHEST) | (size < np.finfo(np.float32).smallest_normal))
        if implausible > MOST_IMPLAUSIBLE * len(values):
            return "coordinates are implausible"
        whole.append(len(values) > 0 and bool((np.rint(values) == values).mean() > WHOLE))
    if any(whole) and not all(whole):
        return "one of the first three columns has whole numbers, so it is not a coordinate"
    return ""


def _holds_two_points(rows: Float32[np.ndarray, "n c"], length: int) -> bool:
    """True if columns and those `length` further vary together, as the coordinates of two neighbouring points do."""
    together = 0
    for axis in range(min(length, 3)):
        with np.errstate(invalid="ignore"):  # signalling NaNs
            pair = rows[:, [axis, axis + length]].astype(np.float64)
        pair = pair[np.isfinite(pair).all(axis=1) & pair.any(axis=1)]
        if len(pair) < LEAST_ROWS:
            continue
        pair -= np.median(pair, axis=0)
        near, far = sorted(float(np.quantile(values, 0.8)) for values in np.abs(pair).T)
        if far > LARGEST_RATIO * near:
            continue
        ranks = np.argsort(np.argsort(pair, axis=0), axis=0)
        together += bool(np.asarray(np.corrcoef(ranks.T))[0, 1] > LEAST_CORRELATION)
    return together >= 2


def _uncertain(lengths: Sequence[int]) -> Evidence:
    possible = tuple(length for length in lengths if length >= FEWEST)
    return Evidence(None, possible, f"rows of {' and of '.join(map(str, lengths))} values fit")


SCAN_SUFFIX = ".bin"
NUSCENES, KITTI = 5, 4
NUSCENES_SUFFIX, NUSCENES_FOLDER = ".pcd.bin", "LIDAR_TOP"
KITTI_FOLDERS = ("velodyne", "velodyne_points")
# Scans of a folder that are examined together.
SCANS = 8
REMEDY = "copy the scan again from the data set"


@dataclass(frozen=True, eq=False)
class Scans:
    """The `.bin` files of a recording.

    Attributes:
        columns: the option `columns`: values per point of all files, which are not examined then; None = not given.
        scale: of their reflectance.
    """

    columns: int | None = None
    scale: CommonScale = field(default_factory=CommonScale)
    _found: dict[Path, Evidence] = field(default_factory=dict)

    def read(self, path: Path) -> RawCloud:
        """Returns the valid points of a scan.

        Points that are no returns (`are_returns`) are left out, and those whose reflectance is not finite.
        """
        return self.scale.apply(path.parent, self._read(path), lambda: files_like(path), self._read)

    def _read(self, path: Path) -> RawCloud:
        data = scan_bytes(path)
        rows = read_scan_rows(path, data, self._columns(path, data))
        has_reflectance = rows.shape[1] > 3 and _is_reflectance(rows[:, 3])
        rows = valid_rows(path, rows, 4 if has_reflectance else 3)
        xyz_m = rows[:, :3].astype(np.float64)
        return RawCloud(xyz_m, None, *fractions(rows[:, 3])) if has_reflectance else RawCloud(xyz_m)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found by the values of the scans that were read so far."""
        return tuple(
            f"points in {folder.name}/*{SCAN_SUFFIX} have {found.columns} values each, which only their values say; "
            "--columns sets another number"
            # a copy: another thread may be reading the first scan of a folder
            for folder, found in [*self._found.items()]
            if found.columns is not None
        )

    def _columns(self, path: Path, data: bytes) -> int:
        if self.columns is not None:
            return self.columns
        evidence = weigh_columns([data])
        said = said_columns(path)
        if said is not None:
            columns, source = said
            if evidence.columns not in (None, columns):
                raise UnclearError(
                    path,
                    f"{source} says {columns} values per point, but its values look like rows of {evidence.columns}",
                    f"give --columns {evidence.columns} (or {columns} to read it so all the same)",
                )
            return columns
        found = self._of_folder(path, data)
        if found.columns is None:
            _refuse(path, found)
        if evidence.columns not in (None, found.columns):
            raise UnclearError(
                path,
                f"the folder's scans have {found.columns} values per point, but those of this one look like rows of "
                f"{evidence.columns}",
                "put scans of different sensors into different folders, or give --columns",
            )
        return found.columns

    def _of_folder(self, path: Path, data: bytes) -> Evidence:
        """Returns what this and some other scans of its folder say."""
        folder = path.parent
        if folder in self._found:
            return self._found[folder]
        others = sorted(file for file in folder.iterdir() if file.suffix.lower() == SCAN_SUFFIX and file != path)
        chosen = [
            others[i] for i in np.unique(np.linspace(0, len(others) - 1, min(SCANS - 1, len(others))).astype(int))
        ]
        # in a mirror of remote storage, the files of other frames may be empty
        scans = [data]
        for file in chosen:
            # one that cannot be read is reported when its own frame is read
            with suppress(OSError):
                scans += filter(None, [read_frame_file(file)])
        evidence = weigh_columns(scans)
        alone = sorted({columns for scan in scans if (columns := weigh_columns([scan]).columns) is not None})
        if len(alone) > 1:
            evidence = Evidence(
                None, tuple(alone), f"its folder has scans like rows of {' and of '.join(map(str, alone))}"
            )
        if evidence.columns is not None or len(scans) > len(chosen):
            self._found[folder] = evidence
        return evidence


def read_scan_rows(path: Path, data: bytes, columns: int) -> Float32[np.ndarray, "n c"]:
    """Returns the points of a scan's content."""
    if len(data) % (BYTES_PER_VALUE * columns):
        _raise_truncated(path, len(data), BYTES_PER_VALUE * columns, f"{columns} 32-bit floats per point")
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def valid_rows(path: Path, rows: Float32[np.ndarray, "n c"], checked: int) -> Float32[np.ndarray, "m c"]:
    """Returns the points that are returns, and of which the first `checked` values are plausible numbers."""
    # false also for infinity and NaN
    valid = are_returns(rows[:, :3]) & (np.abs(rows[:, 3:checked]) < LARGEST).all(axis=1)
    if not valid.any():
        raise FrameError(path, NO_RETURN, REMEDY)
    return rows[valid]


def scan_bytes(path: Path) -> bytes:
    """Returns the content of a scan."""
    with file_errors(path, "copy it from the data set"):
        data = read_frame_file(path)
    if not data:
        raise FrameError(path, "the file is empty", REMEDY)
    if len(data) % BYTES_PER_VALUE:
        _raise_truncated(path, len(data), BYTES_PER_VALUE, "32-bit floats")
    return data


def said_columns(path: Path) -> tuple[int, str] | None:
    """Returns the number of values per point that a scan's name or place says, and which of them; None if neither."""
    if path.name.lower().endswith(NUSCENES_SUFFIX):
        return NUSCENES, f"its name (*{NUSCENES_SUFFIX}, nuScenes)"
    folders = path.parent.parts[-2:]
    if NUSCENES_FOLDER in folders:
        return NUSCENES, f"its place ({NUSCENES_FOLDER}/, nuScenes)"
    name = next((folder for folder in folders if folder in KITTI_FOLDERS), None)
    return None if name is None else (KITTI, f"its place ({name}/, KITTI)")


def _raise_truncated(path: Path, size: int, unit: int, what: str) -> Never:
    raise FrameError(
        path,
        f"the scan is truncated: {size} bytes are not a multiple of {unit} ({what})",
        REMEDY + ", or remove the frame",
    )


def _is_reflectance(values: Float32[np.ndarray, "n"]) -> bool:
    """False if a row's fourth values are something else: velocities, times, bit patterns."""
    known = values[np.isfinite(values)]
    return len(known) * 2 > len(values) and bool((known >= 0).all() and (known <= REFLECTANCE_SCALES[-1]).all())


def _refuse(path: Path, evidence: Evidence) -> Never:
    possible = ", ".join(map(str, evidence.candidates)) or f"none of {FEWEST} to {MOST}"
    raise UnclearError(
        path,
        f"the number of values per point is not certain: {evidence.reason} (possible: {possible})",
        "give --columns N if its points are rows of N 32-bit floats, x y z first, in metres; else save them as .npy",
    )
