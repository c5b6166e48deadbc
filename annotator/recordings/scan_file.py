"""`.bin` scans: rows of 32-bit floats without a header: x, y, z and, in rows of four or more, reflectance.

How many values a row has is never guessed. It is said by an option, by the file's name or place, or by its values, if
only one number is plausible. Without the option, the values must not contradict.

    *.pcd.bin, LIDAR_TOP/*.bin            5, nuScenes: x y z intensity ring
    velodyne/*.bin, velodyne_points/...   4, KITTI: x y z reflectance

What the values say: if rows have C values, those at positions p, p + C, p + 2C ... are of one kind (all x, all
intensities), and those of neighbouring positions are not. So it is measured, for each C from 1 to 16, how much the
position within a row says about a value's sign, its magnitude, and whether it is whole, zero or not a number: their
mutual information in bits. It is highest for the true number and its multiples. Nothing is assumed about the order of
points, the sensor's pose or the unit, but x, y and z must come first.

Beams that fire in turns make every second point alike, so that rows of 3 look like rows of 6: rows of 6 and 8 are read
with the option only. The limits are set so that doubt is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from annotator.frame_limits import read_frame_file
from annotator.recordings.clouds.columns import REFLECTANCE_SCALES, CommonScale, RawCloud, files_like, from_columns
from annotator.recordings.listing import file_errors
from annotator.types.errors import UnclearError

BYTES_PER_VALUE = 4
# Longer rows than are read are recognised, so that they are not taken for one of their divisors.
LONGEST = 16
# Numbers of columns that values can tell.
TOLD = (3, 4, 5, 7)
# Of each scan, so many values are examined.
EXAMINED = 1 << 14
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
# Kinds of value: zero, not finite, denormal, then 61 magnitudes (powers of two) by sign and by being whole.
FIRST_EXPONENT, LAST_EXPONENT = 100, 160
KINDS = 3 + 4 * (LAST_EXPONENT - FIRST_EXPONENT + 1)


def weigh_columns(scan: bytes) -> int | None:
    """Returns the number of columns that explains the content of a `.bin` file; None in doubt."""
    values = np.frombuffer(scan, "<f4", len(scan) // BYTES_PER_VALUE)
    places = np.arange(len(values))
    if len(values) > EXAMINED:
        places = np.random.default_rng(0).integers(0, len(values), EXAMINED)
    kinds, lengths = _kinds(values[places]), range(1, LONGEST + 1)
    bits = np.array([_information(places % length, kinds, length) for length in lengths])
    if not len(places) or bits.max() < LEAST_BITS + BITS_OF_CHANCE / len(places):
        return None
    share = dict(zip(lengths, bits / bits.max(), strict=True))
    best = next(length for length in lengths if share[length] >= EXPLAINS)
    # multiples of a number that explains the values always do, too
    doubted = any(share[length] > FAILS for length in lengths if length % best)
    return None if doubted or not _are_points(values[: len(values) // best * best].reshape(-1, best)) else best


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


def _information(columns: Int64[np.ndarray, "n"], kinds: Int64[np.ndarray, "n"], length: int) -> float:
    """Returns the mutual information of column and kind, bits, corrected for chance (Miller and Madow)."""
    counts = np.bincount(columns * KINDS + kinds, minlength=length * KINDS).reshape(length, KINDS)
    return float(_entropy(counts.sum(axis=0, keepdims=True)).mean() - _entropy(counts).mean())


def _entropy(counts: Int64[np.ndarray, "r k"]) -> Float64[np.ndarray, "r"]:
    total = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    p = counts / total
    plain = -(p * np.log2(np.where(p > 0, p, 1.0))).sum(axis=1)
    return np.asarray(plain + ((counts > 0).sum(axis=1) - 1) / (2 * np.log(2) * total[:, 0]))


def _are_points(rows: Float32[np.ndarray, "n c"]) -> bool:
    """False if the first three columns cannot be coordinates: implausible ones, or whole numbers in some of them."""
    whole = []
    for values in rows[:, :3].T:
        values = values[np.isfinite(values) & (values != 0)]
        size = np.abs(values)
        implausible = np.count_nonzero((size > FARTHEST) | (size < np.finfo(np.float32).smallest_normal))
        if implausible > MOST_IMPLAUSIBLE * len(values):
            return False
        whole.append(len(values) > 0 and bool((np.rint(values) == values).mean() > WHOLE))
    return all(whole) or not any(whole)


SCAN_SUFFIX = ".bin"
NUSCENES, KITTI = 5, 4
NUSCENES_SUFFIX, NUSCENES_FOLDER = ".pcd.bin", "LIDAR_TOP"
KITTI_FOLDERS = ("velodyne", "velodyne_points")


@dataclass(frozen=True, eq=False)
class Scans:
    """The `.bin` files of a recording; with the option `columns`, they are not examined."""

    columns: int | None = None
    scale: CommonScale = field(default_factory=CommonScale)
    _found: dict[Path, int] = field(default_factory=dict)

    def read(self, path: Path) -> RawCloud:
        """Returns the valid points of a scan, with the scale of reflectance of its folder's first ones."""
        return self.scale.apply(path.parent, self.read_alone(path), lambda: files_like(path), self.read_alone)

    def read_alone(self, path: Path) -> RawCloud:
        """Returns the valid points of a scan, whose own values say the scale of reflectance."""
        with file_errors(path, "copy the scan again from the data set, or remove the frame"):
            data = read_frame_file(path)
            if not data:
                raise ValueError("the file is empty")
            columns = self._columns(path, data)
            if len(data) % (BYTES_PER_VALUE * columns):
                unit = f"{BYTES_PER_VALUE * columns} ({columns} 32-bit floats per point)"
                raise ValueError(f"the scan is truncated: {len(data)} bytes are not a multiple of {unit}")
            rows = np.frombuffer(data, "<f4").reshape(-1, columns)
            named = 4 if columns > 3 and _is_reflectance(rows[:, 3]) else 3
            return from_columns(dict(zip(("x", "y", "z", "reflectance")[:named], rows.T, strict=False)))

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found by the values of the scans that were read so far."""
        return tuple(
            f"points in {folder.name}/*{SCAN_SUFFIX} have {columns} values each, which only their values say; "
            "--columns sets another number"
            # a copy: another thread may be reading a scan
            for folder, columns in [*self._found.items()]
        )

    def _columns(self, path: Path, data: bytes) -> int:
        if self.columns is not None:
            return self.columns
        own, said = weigh_columns(data), said_columns(path)
        if said is not None:
            columns, source = said
            if own not in (None, columns):
                raise UnclearError(
                    path,
                    f"{source} says {columns} values per point, but its values look like rows of {own}",
                    f"give --columns {own} (or {columns} to read it so all the same)",
                )
            return columns
        if own not in TOLD:
            raise UnclearError(
                path,
                "the number of values per point is not certain" + (f": rows of {own} fit" if own else ""),
                "give --columns N if its points are rows of N 32-bit floats, x y z first, in metres; else save them as "
                ".npy",
            )
        self._found[path.parent] = own
        return own


def said_columns(path: Path) -> tuple[int, str] | None:
    """Returns the number of values per point that a scan's name or place says, and which of them; None if neither."""
    if path.name.lower().endswith(NUSCENES_SUFFIX):
        return NUSCENES, f"its name (*{NUSCENES_SUFFIX}, nuScenes)"
    folders = path.parent.parts[-2:]
    if NUSCENES_FOLDER in folders:
        return NUSCENES, f"its place ({NUSCENES_FOLDER}/, nuScenes)"
    name = next((folder for folder in folders if folder in KITTI_FOLDERS), None)
    return None if name is None else (KITTI, f"its place ({name}/, KITTI)")


def _is_reflectance(values: Float32[np.ndarray, "n"]) -> bool:
    """False if a row's fourth values are something else: velocities, times, bit patterns."""
    known = values[np.isfinite(values)]
    return len(known) * 2 > len(values) and bool((known >= 0).all() and (known <= REFLECTANCE_SCALES[-1]).all())
