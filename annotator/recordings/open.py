"""Opens the recording at a path, in any supported format: the table of readers, and what to say where none fits.

A new format needs one module, and a line in `READERS`.
"""

from __future__ import annotations

import shlex
from contextlib import suppress
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from annotator.recordings.listing import path_errors
from annotator.recordings.look_around import Scanned, look_around
from annotator.recordings.recording import ReaderOptions, Recording, option_flag
from annotator.types.errors import ConfigError, RecordingError, UnknownFormatError
from annotator.types.messages import nearest

# Exports in most formats have this file, so it alone shows none.
COMMON = {"frames.csv"}
MOST_NAMED = 2
# How far recordings below a folder are searched, how many folders of a level, and how many are named.
MOST_LEVELS, MOST_FOLDERS, MOST_HINTS = 3, 200, 5
# How far above a file or folder the recording that it belongs to may be.
MOST_ABOVE = 3
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar", ".bz2", ".xz")
VIDEOS = (".mp4", ".avi", ".mov", ".webm")
# What to do with files that are no recordings, by their suffixes.
ADVICE = {
    **dict.fromkeys(ARCHIVES, "it is an archive; unpack it, and give the folder"),
    **dict.fromkeys(VIDEOS, "it is a video, which has no depth; give a recording with depth images or point clouds"),
}
BOXES, OF_BOXES = "boxes.json", "it holds boxes; give the recording's folder, which may have it in truth/"


def nearest_formats(path: Path) -> list[str]:
    """Returns sentences such as "it looks like a KITTI object folder: calib/ is missing", the nearest format first."""
    near: list[tuple[float, str]] = []
    for root in (path, path / "training"):
        for _, title, parts, *_ in READERS.values():
            missing = [part for part in parts if not any(_has(root, each) for each in part.split("|"))]
            if set(parts) - set(missing) - COMMON:
                words = " and ".join(map(_words, missing))
                problem = f": {words} {'is' if len(missing) == 1 else 'are'} missing"
                place = "it" if root == path else "training/"
                text = (
                    f"{place} looks like {title}{problem if missing else ', but its files are not as in that format'}"
                )
                near.append((len(missing) / len(parts), text))
    least = min((share for share, _ in near), default=1.0)
    return [text for share, text in near if share == least][:MOST_NAMED]


def _words(part: str) -> str:
    return part.replace("|", " or ")


def _has(root: Path, part: str) -> bool:
    if "*" in part:
        return next(root.glob(part), None) is not None
    return (root / part).is_dir() if part.endswith("/") else (root / part).is_file()


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


class Reader(NamedTuple):
    """How a format is opened; functions as module:name below `annotator.recordings`.

    Attributes:
        opens: takes the path [and the options], returns a Recording; None if the path is not of this format.
        title: its name in a sentence.
        parts: what a recording must have, for messages; `|` separates alternatives, and optional files are left out.
        options: those of `ReaderOptions` that it takes; with any, it is called with the options.
        recognises: a faster check of a path, for formats that are slow to open.
    """

    opens: str
    title: str
    parts: tuple[str, ...]
    options: tuple[str, ...] = ()
    recognises: str | None = None

    def open(self, path: Path, options: ReaderOptions) -> Recording | None:
        opened: Recording | None = _load(self.opens)(path, *([options] if self.options else []))
        return opened

    def is_at(self, path: Path) -> bool:
        return bool(_load(self.recognises)(path)) if self.recognises else self.open(path, NO_OPTIONS) is not None


OF_BAGS = ("image", "points", "depth", "camera_info", "depth_info", "tf_frame", "no_motion", "tolerance_s", "origin")
# Tried in this order; the first reader that recognises a path opens it.
READERS: dict[str, Reader] = {
    "stray_scanner": Reader("phones.stray_scanner:open_stray_scanner", "a Stray Scanner recording",
                            ("rgb.mp4", "odometry.csv", "camera_matrix.csv", "depth/"), ("min_confidence",)),
    "record3d": Reader("phones.record3d:open_record3d", "a Record3D recording", ("a .r3d file|metadata", "rgbd/"),
                       ("min_confidence",), "phones.record3d:is_record3d"),
    # before rgbd_folder, whose names differ only by the lists of images
    "tum_rgbd": Reader("tum_rgbd:open_tum_rgbd", "a TUM RGB-D recording", ("rgb.txt", "depth.txt", "rgb/", "depth/"),
                       ("tolerance_s",)),
    "rgbd_folder": Reader("rgbd_folder:open_rgbd_folder", "an RGB-D folder",
                          ("color/|rgb/", "depth/", "camera_*.json")),
    "kitti_object": Reader("kitti:open_kitti_object", "a KITTI object folder", ("image_2/", "velodyne/", "calib/"),
                           ("columns",)),
    "kitti_tracking": Reader("kitti:open_kitti_tracking", "a KITTI tracking folder of one sequence",
                             ("image_02/|image_2/", "velodyne/", "calib.txt"), ("columns", "scene")),
    "kitti_raw": Reader("kitti:open_kitti_raw", "a KITTI raw drive", ("image_02/data/", "velodyne_points/data/"),
                        ("columns",)),
    "azure_kinect": Reader("kinect.mkv_recording:open_azure_kinect", "an Azure Kinect recording",
                           ("an .mkv file with tracks COLOR and DEPTH and an attached calibration",), (),
                           "kinect.mkv_recording:is_azure_kinect"),
    "ros_bag": Reader("ros.recording:open_ros_bag", "a bag",
                      ("a .bag, .mcap or .db3 file, or a folder of ROS 2 with such files",), OF_BAGS,
                      "ros.bag:is_bag"),
    "nuscenes": Reader("nuscenes:open_nuscenes", "nuScenes", ("v1.0-*", "samples/", "sweeps/"),
                       ("scene", "camera", "tolerance_s"), "nuscenes:table_folders"),
    "argoverse2": Reader("argoverse:open_argoverse2", "a log of Argoverse 2",
                         ("sensors/lidar/", "calibration/", "city_SE3_egovehicle.feather"), ("camera", "tolerance_s"),
                         "argoverse:is_argoverse2"),
    "sunrgbd_extracted": Reader("sunrgbd:open_sunrgbd_extracted", "SUN RGB-D as VoteNet extracts it",
                                ("image/", "calib/", "depth/*.mat|points/*.npz")),
    "sunrgbd_scenes": Reader("sunrgbd:open_sunrgbd_scenes", "a scene of SUN RGB-D",
                             ("image/", "depth/", "extrinsics/", "intrinsics.txt")),
    "rcv": Reader("exports:open_rcv", "an export in the format rcv",
                  ("dataset.json", "labels/", "images/", "clouds/")),
    "openlabel": Reader("exports:open_openlabel", "an export in the format openlabel",
                        ("images/", "clouds/", "frames.csv")),
    # last, because other formats contain cloud files, too
    "cloud_folder": Reader("clouds.cloud_folder:open_cloud_folder", "a folder of point clouds",
                           ("files .ply, .pcd, .npy, .npz, .las, .laz or .bin, here or in points/",),
                           ("columns", "origin")),
}  # fmt: skip


# Suffixes of single files that are recordings.
FILE_SUFFIXES = (".mkv", ".r3d", ".bag", ".mcap", ".db3")
MOST_PROBLEMS = 2
NO_OPTIONS = ReaderOptions()


def open_recording(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Opens the recording at `path`; its frames are listed but not read.

    Raises:
        ConfigError: an option that the reader does not take.
        UnknownFormatError: no reader recognises the path.
        RecordingError: the recording has no frames, or the path cannot be read.
    """
    # the virtual cameras are those of the LiDAR, and no camera of the recording itself
    own = options.model_copy(update={"look_around": None, "camera": None}) if options.look_around else options
    for name, reader in READERS.items():
        with path_errors(path):
            result = reader.open(path, own)
        if result is not None:
            _require_taken(path, name, own)
            return look_around(_scanned(path, name, result), options) if options.look_around else result
    with path_errors(path):
        message = _explain(path)
    looked_for = [f"{name}: {kind}" for name, kind in zip(READERS, kinds(), strict=True)]
    raise UnknownFormatError(message, tuple(looked_for) if path.exists() else ())


def kinds() -> tuple[str, ...]:
    """What a recording of each format must have, such as "a KITTI object folder: image_2/, velodyne/, calib/"."""
    return tuple(f"{reader.title}: {', '.join(map(_words, reader.parts))}" for reader in READERS.values())


def detect_format(path: Path) -> str | None:
    """Returns the name of the format at `path`; None if no reader recognises it. Errors are as of `open_recording`."""
    for name, reader in READERS.items():
        with path_errors(path):
            if reader.is_at(path):
                return name
    return None


def _require_taken(path: Path, name: str, options: ReaderOptions) -> None:
    taken = READERS[name].options
    surplus = [option_flag(option) for option in options.given() if option not in taken]
    if surplus:
        possible = ", ".join(map(option_flag, taken)) or "no options"
        raise ConfigError(f"{path}: is read as {name}, which takes {possible}, not {', '.join(surplus)}")


def _scanned(path: Path, name: str, recording: Recording) -> Scanned:
    if not isinstance(recording, Scanned):
        raise ConfigError(
            f"{path}: is read as {name}, without scans of a LiDAR, and takes no {option_flag('look_around')}; scans of "
            "KITTI, nuScenes, Argoverse 2, bags and folders of point clouds do"
        )
    return recording


def _load(target: str) -> Any:
    module, _, function = target.partition(":")
    return getattr(import_module(f"annotator.recordings.{module}"), function)


def _explain(path: Path) -> str:
    if not path.exists():
        return f"{path}: {missing_part(path)}; give the path of a recording"
    is_folder = path.is_dir()
    kind = "folder" if is_folder else "file"
    advice = OF_BOXES if path.name == BOXES else ADVICE.get(path.suffix.lower())
    near = nearest_formats(path) if is_folder else [advice] if advice else []
    parts = [f"{path}: no known recording format in this {kind}", *near]
    below = _recordings_below(path) if is_folder else []
    if below:
        parts += below
    elif (above := _recording_above(path)) is not None:
        parts.append(f"it is a part of the recording {above}; give that path")
    elif is_folder and not near and next(path.glob("*.txt"), None) is not None:
        parts.append("it holds text files; if they are labels, give the folder that also has their images and clouds")
    elif not near:
        parts.append(f"`annotator inspect {shlex.quote(str(path))}` lists what each format needs")
    return "; ".join(parts)


def _recordings_below(path: Path) -> list[str]:
    """Says which recordings are in a folder, some levels down."""
    found, problems, folders = list[str](), list[str](), [path]
    for _ in range(MOST_LEVELS):
        deeper = []
        for child in islice((child for folder in folders for child in _children(folder)), MOST_FOLDERS):
            try:
                if detect_format(child) is not None:
                    found.append(child.relative_to(path).as_posix())
                elif child.is_dir():
                    deeper.append(child)
            except RecordingError as error:
                problems.append(str(error))
        folders = deeper
    if found:
        return ["it contains recordings; give the path of one of them: " + ", ".join(found[:MOST_HINTS])]
    return ["it contains recordings that cannot be opened: " + "; ".join(problems[:MOST_PROBLEMS])] if problems else []


def _children(folder: Path) -> list[Path]:
    with suppress(OSError):
        shown = (child for child in sorted(folder.iterdir()) if not child.name.startswith("."))
        return [child for child in shown if child.suffix.lower() in FILE_SUFFIXES or child.is_dir()]
    return []


def _recording_above(path: Path) -> Path | None:
    """Returns the recording that a file or folder is a part of; None if there is none near.

    A folder of clouds may be a part of another recording, and only its files are its parts.
    """
    clouds = None
    for folder in list(path.absolute().parents)[:MOST_ABOVE]:
        with suppress(RecordingError):
            name = detect_format(folder)
            if name == "cloud_folder":
                clouds = clouds or (folder if folder == path.absolute().parent and path.is_file() else None)
            # any folder with a scene of SUN RGB-D in it is a recording of scenes
            elif name is not None and (name != "sunrgbd_scenes" or (folder / "intrinsics.txt").is_file()):
                return folder
    return clouds
