"""Reads the true boxes and masks beside a recording, for all formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import RigidTransform

from annotator.formats import argoverse
from annotator.formats.boxes_json import PLACES, read_boxes
from annotator.formats.frame_names import read_frames
from annotator.formats.kitti_objects import read_kitti_file
from annotator.formats.kitti_rows import (
    DONT_CARE,
    KittiLabel,
    kitti_row,
    read_object_labels,
    read_tracking_areas,
    read_tracking_labels,
)
from annotator.formats.kitti_tracklets import read_tracklets
from annotator.formats.labelcloud import CLASSES_FILE, LABELS, read_labelcloud_file
from annotator.formats.nuscenes import ANNOTATIONS, is_seen, read_sample_boxes
from annotator.formats.rcv import MANIFEST, RcvDataset, read_rcv
from annotator.formats.reading import read_mask
from annotator.formats.sunrgbd import read_extracted_labels, read_scene_labels
from annotator.geometry.outline import Sight
from annotator.image_bytes import UPRIGHT, as_stored, described, is_turned
from annotator.recordings import Recording
from annotator.recordings.argoverse import ArgoverseLog
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.exports import OpenLabelFolder
from annotator.recordings.kitti import KittiRaw, KittiTracking
from annotator.recordings.look_around import LookAround
from annotator.recordings.nuscenes import NuScenes
from annotator.recordings.sunrgbd import SunRgbdScenes
from annotator.text import normal, spelled
from annotator.types import Box2D, Frame, OrientedBox, Truth
from annotator.types.errors import FormatError, RecordingError
from annotator.workflows.importing.label_set import LabelSet, transformed
from annotator.workflows.importing.readers import of_labelcloud, of_rcv, openlabel_labels

Read = TypeVar("Read")
# Generated recordings have their truth in a separate folder.
TRUTH_FOLDER = "truth"
# In each raw scene of SUN RGB-D.
SCENE_LABELS = "annotation3Dfinal/index.json"
# Longest table without a row: nuScenes' test split has an empty one, and is not labelled.
EMPTY_LIST_BYTES = 8


def load_truth(recording: Recording, index: int, frame: Frame) -> list[Truth]:
    """Returns the labelled objects of a frame in file order; empty if it is labelled as empty, or not at all.

    Args:
        frame: the frame, which has the transform from the labels' coordinates.

    Raises:
        RecordingError: the recording has no labels at all.
        FormatError: its labels are broken, or a box is out of range after the transform to the camera frame.
    """
    file = label_file(recording, recording.keys[index])
    if file is None:
        raise RecordingError(f"{recording.path}: has no true boxes; looked for {_looked_for(recording)}")
    key = recording.keys[index]
    try:
        if isinstance(recording, KittiRaw):
            # in LiDAR coordinates, unlike all other KITTI labels
            truths = _tracked(read_tracklets, file, key, recording.calibration(key).T_camera_lidar)
        elif isinstance(recording, NuScenes):
            truths = _from_samples(file, recording, key, _as_recorded(frame))
        elif isinstance(recording, LookAround) and isinstance(recording.base, NuScenes):
            truths = _seen(_from_samples(file, recording.base, key, _as_recorded(frame)), frame)
        elif isinstance(recording, LookAround):
            truths = _from_annotations(file, key, _as_recorded(frame))
        else:
            truths = _READERS[recording.format](file, key, _as_recorded(frame))
        T = frame.T_camera_recorded
        truths = transformed(truths, T)
        return _seen(truths, frame) if isinstance(recording, NuScenes) and not recording.is_export else truths
    except ValueError as error:
        # a box is out of range after the transform to the camera frame
        raise FormatError(file, f"frame {key}: {error}; correct its boxes or its calibration") from error


def _as_recorded(frame: Frame) -> Frame:
    """The frame with the label files' coordinates relative to the camera frame as the recording's files give it."""
    T, label = frame.T_camera_recorded, frame.T_camera_label
    return frame if T is None or label is None else replace(frame, T_camera_label=T.inv() * label)


def has_truth(recording: Recording) -> bool:
    """Returns True if there are labels beside the recording, at least of some frames."""
    return label_file(recording, recording.keys[0]) is not None


def is_labelled(recording: Recording, key: str) -> bool:
    """Returns False for a frame whose objects were not labelled: one between nuScenes' samples."""
    base = recording.base if isinstance(recording, LookAround) else recording
    return not isinstance(base, NuScenes) or base.sample(key) is not None


def one_file_a_frame(recording: Recording) -> bool:
    """Returns True if each frame has its own label file, so that a broken file affects only its frame."""
    if isinstance(recording, SunRgbdScenes):
        return True
    return any((recording.root / name).is_dir() for name in _PLACES.get(recording.format, ()))


def has_masks(recording: Recording) -> bool:
    """Returns True if there are masks beside the recording, and its points are linked to pixels."""
    return recording.format in _MASKED and mask_folder(recording) is not None


def mask_folder(recording: Recording) -> Path | None:
    """Returns the folder of a recording's masks, or None."""
    folders = (recording.root / TRUTH_FOLDER / "mask", recording.root / "mask")
    return next((folder for folder in folders if folder.is_dir()), None)


def label_file(recording: Recording, key: str) -> Path | None:
    """Returns the path of the file for a frame's labels, or None if the recording has no labels.

    The file may be missing: a KITTI object label folder may lack the files of some frames.
    """
    if isinstance(recording, LookAround):
        # labels of other formats cover only what the camera sees
        return label_file(recording.base, key) if isinstance(recording.base, NuScenes | ArgoverseLog) else None
    if isinstance(recording, SunRgbdScenes):
        labels = recording.scene(key) / SCENE_LABELS
        labelled = labels.is_file() or any((recording.scene(k) / SCENE_LABELS).is_file() for k in recording.keys)
        return labels if labelled else None
    if isinstance(recording, KittiTracking):
        return recording.label_file if recording.label_file.is_file() else None
    if isinstance(recording, OpenLabelFolder):
        return recording.document(key)
    if isinstance(recording, CloudFolder) and not (recording.root / LABELS / CLASSES_FILE).is_file():
        return None
    folder = recording.tables if isinstance(recording, NuScenes) else recording.root
    for name in _PLACES.get(recording.format, ()):
        place = folder / name
        if place.is_file() and not (isinstance(recording, NuScenes) and place.stat().st_size <= EMPTY_LIST_BYTES):
            return place
        if place.is_dir():
            return spelled(place, f"{key}{_SUFFIXES.get(recording.format, '.txt')}")
    return None


def load_mask(recording: Recording, frame: Frame) -> UInt8[np.ndarray, "h w"] | None:
    """Returns the object number of each pixel, from 1 in the order of `load_truth`, 0 = none; None without masks.

    Raises:
        FormatError: the recording has masks, but this one is missing, broken, or of another size.
    """
    folder = mask_folder(recording)
    if folder is None:
        return None
    path = spelled(folder, f"{frame.key}.png")
    mask, size = read_mask(path), frame.rgb.shape[1::-1]
    if frame.exif_orientation != UPRIGHT:
        is_shown = is_turned(frame.exif_orientation, size, mask.shape[::-1])
        if is_shown is None and mask.shape[::-1] == size:
            raise FormatError(
                path,
                f"its image has the {described(frame.exif_orientation)}, and the mask may be for the image as stored "
                "or as shown; save the images without this tag",
            )
        mask = as_stored(mask, frame.exif_orientation) if is_shown else mask
    if mask.shape != frame.rgb.shape[:2]:
        raise FormatError(path, f"the mask is {mask.shape[::-1]} pixels, the image {frame.rgb.shape[1::-1]}")
    return mask


def own_image_box(truth: Truth, number: int, mask: UInt8[np.ndarray, "h w"] | None) -> Box2D | None:
    """Returns a label's own 2D box: the one in its file, or the extent of its mask; None without both.

    Args:
        number: position of the label in `load_truth`.
    """
    if truth.image_box is not None or mask is None:
        return truth.image_box
    rows, columns = np.nonzero(mask == number + 1)
    if len(rows) == 0:
        return None
    return Box2D(truth.label, columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5)


def _from_samples(path: Path, recording: NuScenes, key: str, frame: Frame) -> list[Truth]:
    """Returns the boxes of a frame's sample; none between samples."""
    sample = recording.sample(key)
    if sample is None or frame.T_camera_label is None:
        return []
    boxes = _whole(_samples, path, recording.tables, recording.samples)[sample]
    return transformed(boxes, frame.T_camera_label)


def _from_annotations(path: Path, key: str, frame: Frame) -> list[Truth]:
    """Returns the boxes of a sweep that the image shows."""
    T = frame.T_camera_label
    rows = () if T is None else _whole(argoverse.read_argoverse, path).get(int(key), ())
    return _seen(transformed(rows, T), frame)


def _tracked(
    read: Callable[..., dict[int, list[Truth]]], path: Path, key: str, T: RigidTransform | None
) -> list[Truth]:
    """Returns the boxes of a frame in a file of KITTI's tracks or tracklets, which numbers its frames."""
    return transformed(_whole(read, path).get(frame_number(path, key), ()), T)


def _seen(truths: list[Truth], frame: Frame) -> list[Truth]:
    K, size = frame.camera.matrix, (frame.camera.width_px, frame.camera.height_px)
    return [truth for truth in truths if is_seen(truth.box, K, *size)]


def frame_number(path: Path, key: str) -> int:
    """Returns the number of a frame in the label file of a whole recording.

    Raises:
        FormatError: the key is not a number.
    """
    if not key.isdecimal():
        raise FormatError(
            path, f"numbers its frames, but the key {key!r} is not a number; name the images by their frame numbers"
        )
    return int(key)


def _from_rcv(path: Path, key: str, frame: Frame) -> list[Truth]:
    manifest = path.parent.parent / MANIFEST
    labels = _whole(_rcv, manifest).labels(frame.index)
    return of_rcv(path, key, labels).truths(key, frame)


def _from_openlabel(path: Path, key: str, frame: Frame) -> list[Truth]:
    labels, names = _whole(_openlabel, path)
    return labels.truths(names.get(normal(key), key), frame)


def _from_labelcloud(path: Path, key: str, frame: Frame) -> list[Truth]:
    return of_labelcloud(path, {key: read_labelcloud_file(path)}).truths(key, frame)


def _whole(read: Callable[..., Read], path: Path, *args: object) -> Read:
    """Returns what a reader gives for a whole file, which is not parsed again for every frame until it changes."""
    status = path.stat()
    return _kept(read, path, (status.st_mtime_ns, status.st_size), *args)  # type: ignore[return-value]


@lru_cache(maxsize=16)
def _kept(read: Callable[..., object], path: Path, _version: tuple[int, int], *args: object) -> object:
    return read(path, *args)


def _boxes(path: Path) -> dict[str, list[Truth]]:
    return {normal(key): truths for key, truths in read_boxes(path).items()}


def _samples(_path: Path, tables: Path, samples: frozenset[str]) -> dict[str, tuple[Truth, ...]]:
    """The boxes of the samples of a nuScenes scene, in the global frame."""
    return read_sample_boxes(tables, samples)


def _tracks(path: Path) -> dict[int, list[Truth]]:
    """In label coordinates, since the transform may differ between frames."""
    return read_tracking_labels(path, None)


def _rcv(path: Path) -> RcvDataset:
    return read_rcv(path.parent)


def _openlabel(path: Path) -> tuple[LabelSet, dict[str, str]]:
    """A document, and the frames' names in it, by key."""
    origins = read_frames(path.parent) or read_frames(path.parent.parent)
    return openlabel_labels(path), {key: origin.name for key, origin in origins.items()}


def _looked_for(recording: Recording) -> str:
    return " or ".join(_PLACES.get(recording.format, ())) or f"labels of the format {recording.format}"


_PLACES = {
    "rgbd_folder": PLACES,
    "kitti_object": ("label_2",),
    "kitti_tracking": ("label_02.txt",),
    "kitti_raw": ("tracklet_labels.xml",),
    "nuscenes": (ANNOTATIONS,),
    "argoverse2": (argoverse.ANNOTATIONS,),
    "sunrgbd_extracted": ("label",),
    "sunrgbd_scenes": (SCENE_LABELS,),
    "rcv": (LABELS,),
    "cloud_folder": (LABELS,),
}
# Suffix of the label files of single frames; others have .txt.
_SUFFIXES = {"rcv": ".json", "cloud_folder": ".json"}
_MASKED = frozenset({"rgbd_folder"})
_READERS: dict[str, Callable[[Path, str, Frame], list[Truth]]] = {
    "rgbd_folder": lambda path, key, frame: list(_whole(_boxes, path).get(normal(key), ())),
    "kitti_object": lambda path, key, frame: read_object_labels(path, frame.T_camera_label),
    "kitti_tracking": lambda path, key, frame: _tracked(_tracks, path, key, frame.T_camera_label),
    "argoverse2": _from_annotations,
    "sunrgbd_extracted": lambda path, key, frame: read_extracted_labels(path, frame.T_camera_label),
    "sunrgbd_scenes": lambda path, key, frame: read_scene_labels(path, frame.T_camera_label),
    "rcv": _from_rcv,
    "openlabel": _from_openlabel,
    "cloud_folder": _from_labelcloud,
}


# The only format whose labels have the difficulty fields of KITTI's evaluation.
OBJECT = "kitti_object"
# The labels of this format have DontCare areas, too.
TRACKING = "kitti_tracking"


def true_kitti_rows(recording: Recording, index: int, frame: Frame) -> Sequence[KittiLabel]:
    """Returns the true rows of a frame with DontCare areas: KITTI's own rows if there are any, else made from boxes.

    Raises:
        RecordingError, FormatError: as `load_truth`.
    """
    file = label_file(recording, frame.key)
    if recording.format == OBJECT and file is not None:
        return read_kitti_file(file, scored=False)
    rows = rows_of_truth(((truth.label, truth.box) for truth in load_truth(recording, index, frame)), frame)
    return [*rows, *dont_care_rows(recording, frame.key)]


def dont_care_rows(recording: Recording, key: str) -> list[KittiLabel]:
    """Returns the DontCare (unlabelled) areas of a frame; none if it has no label file.

    Raises:
        FormatError: its label file is broken.
    """
    file = label_file(recording, key) if recording.format in (OBJECT, TRACKING) else None
    # a label folder may lack files of some frames
    if file is None or not file.is_file():
        return []
    if recording.format == TRACKING:
        return list(_whole(read_tracking_areas, file).get(frame_number(file, key), ()))
    return [row for row in read_kitti_file(file, scored=False) if row.label == DONT_CARE]


def rows_of_truth(boxes: Iterable[tuple[str, OrientedBox]], frame: Frame) -> list[KittiLabel]:
    """Returns true boxes (class and box, camera frame) as rows; occlusion is computed from the frame's cloud."""
    sight = Sight(frame.cloud.xyz_m)
    return [kitti_row(label, box, None, frame, sight) for label, box in boxes]
