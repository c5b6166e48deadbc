"""The true boxes and masks that came with a recording, whatever its format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.formats.boxes_json import read_boxes
from annotator.formats.kitti import read_object_labels, read_tracking_labels
from annotator.formats.kitti_tracklets import read_tracklets
from annotator.formats.masks import read_mask
from annotator.formats.sunrgbd_labels import read_extracted_labels, read_scene_labels
from annotator.recordings import Recording
from annotator.recordings.kitti_raw import KittiRaw
from annotator.recordings.sunrgbd_scenes import SunRgbdScenes
from annotator.types import Frame, Truth
from annotator.types.errors import FormatError, RecordingError

# Generated recordings keep their truth apart from what a sensor would give.
TRUTH_FOLDER = "truth"
# Each raw scene of SUN RGB-D has its own.
SCENE_LABELS = "annotation3Dfinal/index.json"


def load_truth(recording: Recording, index: int, frame: Frame) -> list[Truth]:
    """The labelled objects of one frame, in file order; empty where the labels say that there are none.

    Args:
        recording: where the labels lie.
        index: the frame's number in the recording.
        frame: the frame itself, for the frame of reference of its labels.

    Raises:
        RecordingError: the recording has no labels at all.
        FormatError: its labels are broken, or the way to the camera takes a box out of reach.
    """
    file = label_file(recording, recording.keys[index])
    if file is None:
        raise RecordingError(f"{recording.path}: has no true boxes; looked for {_looked_for(recording)}")
    key = recording.keys[index]
    try:
        if isinstance(recording, KittiRaw):
            return _from_tracklets(file, recording, key)
        return _READERS[recording.format](file, key, frame)
    except ValueError as error:
        # the way to the camera takes a box out of reach
        raise FormatError(file, f"frame {key}: {error}; correct its boxes or its calibration") from error


def has_truth(recording: Recording) -> bool:
    """True where the recording has labels of its own, if only of some frames."""
    return label_file(recording, recording.keys[0]) is not None


def one_file_a_frame(recording: Recording) -> bool:
    """True where each frame's labels stand in a file of their own, so that one may be broken and the others not."""
    if isinstance(recording, SunRgbdScenes):
        return True
    return any((recording.root / name).is_dir() for name in _PLACES.get(recording.format, ()))


def has_masks(recording: Recording) -> bool:
    """True where the recording has masks of its own, and clouds whose points know their pixels."""
    return recording.format in _MASKED and mask_folder(recording) is not None


def mask_folder(recording: Recording) -> Path | None:
    """Where the masks of a recording lie, or None without any."""
    folders = (recording.root / TRUTH_FOLDER / "mask", recording.root / "mask")
    return next((folder for folder in folders if folder.is_dir()), None)


def label_file(recording: Recording, key: str) -> Path | None:
    """The file that would hold the labels of a frame, or None where the recording has no labels.

    KITTI object labels are one file a frame: a folder of labels that lacks this frame's still counts.
    """
    if isinstance(recording, SunRgbdScenes):
        labels = recording.scene(key) / SCENE_LABELS
        labelled = labels.is_file() or any((recording.scene(k) / SCENE_LABELS).is_file() for k in recording.keys)
        return labels if labelled else None
    for name in _PLACES.get(recording.format, ()):
        place = recording.root / name
        if place.is_file():
            return place
        if place.is_dir():
            return place / f"{key}.txt"
    return None


def load_mask(recording: Recording, frame: Frame) -> UInt8[np.ndarray, "h w"] | None:
    """The object numbers of a frame's pixels, from 1 in the order of `load_truth`, 0 = none; None without masks.

    Raises:
        FormatError: the recording has masks, but this one is missing, broken, or of another size.
    """
    folder = mask_folder(recording)
    if folder is None:
        return None
    path = folder / f"{frame.key}.png"
    mask = read_mask(path)
    if mask.shape != frame.rgb.shape[:2]:
        raise FormatError(path, f"the mask is {mask.shape[::-1]} pixels, the image {frame.rgb.shape[1::-1]}")
    return mask


def _from_boxes_json(path: Path, key: str, frame: Frame) -> list[Truth]:
    return list(_boxes(path, *file_version(path)).get(key, ()))


def _from_label_2(path: Path, key: str, frame: Frame) -> list[Truth]:
    return read_object_labels(path, frame.T_camera_label)


def _from_label_02(path: Path, key: str, frame: Frame) -> list[Truth]:
    T = frame.T_camera_label
    found = _tracks(path, *file_version(path)).get(frame_number(path, key), ())
    return [truth if T is None else replace(truth, box=truth.box.transformed(T)) for truth in found]


def _from_tracklets(path: Path, recording: KittiRaw, key: str) -> list[Truth]:
    """In the LiDAR's frame, unlike all other labels of KITTI's."""
    T = recording.calibration(key).T_camera_lidar
    found = _tracklets(path, *file_version(path)).get(frame_number(path, key), ())
    return [replace(truth, box=truth.box.transformed(T)) for truth in found]


def frame_number(path: Path, key: str) -> int:
    """The number of a frame, by which a file of labels of a whole recording knows it.

    Raises:
        FormatError: the key is no number; names the file.
    """
    if not key.isdecimal():
        raise FormatError(path, f"counts frames by number, and {key!r} is none; name the images by their frame numbers")
    return int(key)


def _from_extracted(path: Path, key: str, frame: Frame) -> list[Truth]:
    return read_extracted_labels(path, frame.T_camera_label)


def _from_scene(path: Path, key: str, frame: Frame) -> list[Truth]:
    return read_scene_labels(path, frame.T_camera_label)


def file_version(path: Path) -> tuple[int, int]:
    """Changes whenever a file does: what was read of it is kept until then."""
    known = path.stat()
    return known.st_mtime_ns, known.st_size


@lru_cache(maxsize=4)
def _boxes(path: Path, changed_ns: int, size: int) -> dict[str, list[Truth]]:
    """The whole file, kept: it would be parsed again for every frame otherwise."""
    return read_boxes(path)


@lru_cache(maxsize=4)
def _tracks(path: Path, changed_ns: int, size: int) -> dict[int, list[Truth]]:
    """The same for tracking labels, in the labels' own frame: the transform may differ from frame to frame."""
    return read_tracking_labels(path, None)


@lru_cache(maxsize=4)
def _tracklets(path: Path, changed_ns: int, size: int) -> dict[int, list[Truth]]:
    """The same for a raw drive's tracklets, in the LiDAR's frame."""
    return read_tracklets(path)


def _looked_for(recording: Recording) -> str:
    return " or ".join(_PLACES.get(recording.format, ())) or f"labels of the format {recording.format}"


_PLACES = {
    "rgbd_folder": (f"{TRUTH_FOLDER}/boxes.json", "boxes.json"),
    "kitti_object": ("label_2",),
    "kitti_tracking": ("label_02.txt",),
    "kitti_raw": ("tracklet_labels.xml",),
    "sunrgbd_extracted": ("label",),
    "sunrgbd_scenes": (SCENE_LABELS,),
}
_MASKED = frozenset({"rgbd_folder"})
_READERS: dict[str, Callable[[Path, str, Frame], list[Truth]]] = {
    "rgbd_folder": _from_boxes_json,
    "kitti_object": _from_label_2,
    "kitti_tracking": _from_label_02,
    "sunrgbd_extracted": _from_extracted,
    "sunrgbd_scenes": _from_scene,
}
