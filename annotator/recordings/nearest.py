"""What to say about a path that no reader recognises: the nearest format, and recordings below and above the path."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from annotator.types.errors import RecordingError
from annotator.types.messages import nearest

# What each format's folder must have; `|` separates alternatives. Optional files are left out.
PARTS: dict[str, tuple[str, ...]] = {
    "an RGB-D folder": ("color/|rgb/", "depth/", "camera_*.json"),
    "a TUM RGB-D recording": ("rgb.txt", "depth.txt", "rgb/", "depth/"),
    "a Stray Scanner recording": ("rgb.mp4", "odometry.csv", "camera_matrix.csv", "depth/"),
    "a KITTI object folder": ("image_2/", "velodyne/", "calib/"),
    "a KITTI tracking folder of one sequence": ("image_02/", "velodyne/", "calib.txt"),
    "a KITTI raw drive": ("image_02/data/", "velodyne_points/data/"),
    "nuScenes": ("v1.0-*", "samples/", "sweeps/"),
    "a log of Argoverse 2": ("sensors/lidar/", "calibration/", "city_SE3_egovehicle.feather"),
    "SUN RGB-D as VoteNet extracts it": ("image/", "calib/", "depth/*.mat|points/*.npz"),
    "a scene of SUN RGB-D": ("image/", "depth/", "extrinsics/", "intrinsics.txt"),
    "an export in the format rcv": ("dataset.json", "labels/", "images/", "clouds/"),
    "an export in the format openlabel": ("images/", "clouds/", "frames.csv"),
}
# Exports in most formats have this file, so it alone shows none.
COMMON = {"frames.csv"}
MOST_NAMED = 2
# How far, and for how long, recordings below a folder are searched.
MOST_LEVELS, MOST_FOLDERS, MOST_SECONDS, MOST_HINTS = 3, 400, 2.0, 5
# How far above a file or folder the recording that it belongs to may be.
MOST_ABOVE = 3
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar", ".bz2", ".xz")
BOXES = "boxes.json"
VIDEOS = (".mp4", ".avi", ".mov", ".webm")

Detect = Callable[[Path], str | None]


def nearest_formats(path: Path) -> list[str]:
    """Returns sentences such as "it looks like a KITTI object folder: calib/ is missing", the nearest format first."""
    near: list[tuple[float, str]] = []
    for root in (path, path / "training"):
        for name, parts in PARTS.items():
            missing = [part for part in parts if not any(_exists(root, each) for each in part.split("|"))]
            if set(parts) - set(missing) - COMMON:
                words = " and ".join(part.replace("|", " or ") for part in missing)
                problem = f": {words} {'is' if len(missing) == 1 else 'are'} missing"
                place = "it" if root == path else "training/"
                text = f"{place} looks like {name}{problem if missing else ', but its files are not as in that format'}"
                near.append((len(missing) / len(parts), text))
    least = min((share for share, _ in near), default=1.0)
    return [text for share, text in near if share == least][:MOST_NAMED]


def _exists(root: Path, part: str) -> bool:
    if "*" in part:
        return next(root.glob(part), None) is not None
    return (root / part).is_dir() if part.endswith("/") else (root / part).is_file()


@dataclass
class Below:
    """What a search below a folder has found.

    Attributes:
        recordings: the first recordings, as relative paths.
        problems: the errors of some that cannot be opened.
        is_partial: the search ended before all folders were seen.
    """

    recordings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    is_partial: bool = False


def recordings_below(path: Path, detect: Detect, file_suffixes: tuple[str, ...]) -> Below:
    """Searches a folder for recordings, some levels down.

    Args:
        detect: returns the format of a path, or None.
        file_suffixes: of single files that are recordings.
    """
    below = Below()
    waiting, seen, end = deque([(path, 1)]), 0, time.monotonic() + MOST_SECONDS
    while waiting:
        folder, level = waiting.popleft()
        for child in _children(folder, file_suffixes):
            if len(below.recordings) == MOST_HINTS:
                return below
            seen += 1
            if seen > MOST_FOLDERS or time.monotonic() > end:
                below.is_partial = True
                return below
            try:
                is_recording = detect(child) is not None
            except RecordingError as error:
                below.problems.append(str(error))
                continue
            if is_recording:
                below.recordings.append(child.relative_to(path).as_posix())
            elif level < MOST_LEVELS and child.is_dir():
                waiting.append((child, level + 1))
    return below


def _children(folder: Path, file_suffixes: tuple[str, ...]) -> Iterator[Path]:
    try:
        children = sorted(folder.iterdir())
    except OSError:
        return
    for child in children:
        if not child.name.startswith(".") and (child.suffix.lower() in file_suffixes or child.is_dir()):
            yield child


def recording_above(path: Path, detect: Detect) -> Path | None:
    """Returns the recording that a file or folder is a part of; None if there is none near.

    A folder of clouds may be a part of another recording, and only its files are its parts.
    """
    clouds = None
    for level, folder in enumerate(list(path.absolute().parents)[:MOST_ABOVE]):
        try:
            name = detect(folder)
        except RecordingError:
            continue
        # any folder with a scene of SUN RGB-D in it is a recording of scenes
        if name == "sunrgbd_scenes" and not (folder / "intrinsics.txt").is_file():
            continue
        if name == "cloud_folder":
            clouds = clouds or (folder if level == 0 and path.is_file() else None)
        elif name is not None:
            return folder
    return clouds


def missing_part(path: Path) -> str:
    """Returns why a path is missing, such as "no such file or folder (/data has no kiti; did you mean kitti?)"."""
    whole = path.absolute()
    there = next((folder for folder in whole.parents if folder.is_dir()), None)
    if there is None:
        return "no such file or folder"
    part = whole.relative_to(there).parts[0]
    try:
        near = nearest(part, [child.name for child in there.iterdir()])
    except OSError:
        near = None
    return f"no such file or folder ({there} has no {part}" + ("" if near is None else f"; did you mean {near}?") + ")"


def kind_of_file(path: Path) -> list[str]:
    """Returns what to do with a file that is no recording, by its suffix; empty if unknown."""
    suffix = path.suffix.lower()
    if path.name == BOXES:
        return ["it holds boxes; give the recording's folder, which may have it in truth/"]
    if suffix in ARCHIVES:
        return ["it is an archive; unpack it, and give the folder"]
    if suffix in VIDEOS:
        return ["it is a video, which has no depth; give a recording with depth images or point clouds"]
    return []
