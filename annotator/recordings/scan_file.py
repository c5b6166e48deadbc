"""`.bin` scans: rows of 32-bit floats without a header: x, y, z and, in rows of four or more, reflectance.

How many values a row has is never guessed. It is said by an option, by the file's name or place, or by the values of
several scans, if only one number is plausible (`scan_columns`). Without the option, each scan must agree.

    *.pcd.bin, LIDAR_TOP/*.bin            5, nuScenes: x y z intensity ring
    velodyne/*.bin, velodyne_points/...   4, KITTI: x y z reflectance
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Never

import numpy as np
from jaxtyping import Float32

from annotator.frame_limits import read_frame_file
from annotator.recordings.clouds.columns import (
    NO_RETURN,
    REFLECTANCE_SCALES,
    CommonScale,
    RawCloud,
    files_like,
    fractions,
)
from annotator.recordings.plausible import LARGEST, are_returns
from annotator.recordings.scan_columns import BYTES_PER_VALUE, FEWEST, MOST, Evidence, weigh_columns
from annotator.types.errors import FrameError, UnclearError

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

        Raises:
            UnclearError: the number of values per point is not certain.
            FrameError: the file is missing, empty, truncated, or has no valid point.
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
        scans = [data, *filter(None, map(_content, chosen))]
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
    """Returns the points of a scan's content.

    Raises:
        FrameError: it is truncated.
    """
    if len(data) % (BYTES_PER_VALUE * columns):
        _raise_truncated(path, len(data), BYTES_PER_VALUE * columns, f"{columns} 32-bit floats per point")
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def valid_rows(path: Path, rows: Float32[np.ndarray, "n c"], checked: int) -> Float32[np.ndarray, "m c"]:
    """Returns the points that are returns, and of which the first `checked` values are plausible numbers.

    Raises:
        FrameError: there are none.
    """
    # false also for infinity and NaN
    valid = are_returns(rows[:, :3]) & (np.abs(rows[:, 3:checked]) < LARGEST).all(axis=1)
    if not valid.any():
        raise FrameError(path, NO_RETURN, REMEDY)
    return rows[valid]


def scan_bytes(path: Path) -> bytes:
    """Returns the content of a scan.

    Raises:
        FrameError: the file is missing, empty, or no list of 32-bit floats.
    """
    try:
        data = read_frame_file(path)
    except OSError as error:
        raise FrameError(path, f"the scan cannot be read ({error.strerror})", "copy it from the data set") from error
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


def _content(path: Path) -> bytes:
    """Returns a file's content; empty if it cannot be read, which is reported when its own frame is read."""
    try:
        return read_frame_file(path)
    except OSError:
        return b""


def _refuse(path: Path, evidence: Evidence) -> Never:
    possible = ", ".join(map(str, evidence.candidates)) or f"none of {FEWEST} to {MOST}"
    raise UnclearError(
        path,
        f"the number of values per point is not certain: {evidence.reason} (possible: {possible})",
        "give --columns N if its points are rows of N 32-bit floats, x y z first, in metres; else save them as .npy",
    )
