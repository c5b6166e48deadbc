"""Reads the true boxes and masks beside a recording, for all formats."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import RigidTransform

from annotator.formats import argoverse
from annotator.formats.box_files import NAME, PLACES, each_entries, entry_truth
from annotator.formats.frame_names import DatasetNames
from annotator.formats.kitti_folders import read_kitti_file
from annotator.formats.kitti_rows import DONT_CARE, KittiLabel, kitti_row, read_rows, row_truth
from annotator.formats.kitti_tracklets import read_tracklets
from annotator.formats.labelcloud import CLASSES_FILE, LABELS, read_labelcloud_file
from annotator.formats.nuscenes import ANNOTATIONS, is_seen, read_sample_boxes
from annotator.formats.rcv import MANIFEST, RcvDataset, read_rcv
from annotator.formats.reading import Angles, read_mask, reported, text_rows
from annotator.formats.sunrgbd import extracted_truth, read_scene_labels
from annotator.formats.table import BoxFormat
from annotator.geometry.outline import Sight
from annotator.image_bytes import UPRIGHT, as_stored, described, is_turned
from annotator.project import REVIEWED
from annotator.recordings import Recording
from annotator.recordings.argoverse import ArgoverseLog
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.exports import OpenLabelFolder
from annotator.recordings.kitti import KittiRaw, KittiTracking
from annotator.recordings.look_around import LookAround
from annotator.recordings.nuscenes import NuScenes
from annotator.recordings.sunrgbd import SunRgbdScenes
from annotator.text import normal, spelled
from annotator.types import Frame, OrientedBox, ReviewState, Truth
from annotator.types.errors import AnnotatorError, FormatError, RecordingError
from annotator.workflows.importing.label_set import LabelSet, transformed
from annotator.workflows.importing.readers import placed_boxes

Read = TypeVar("Read")
# Generated recordings have their truth in a separate folder.
TRUTH_FOLDER = "truth"
# In each raw scene of SUN RGB-D.
SCENE_LABELS = "annotation3Dfinal/index.json"
# Longest table without a row: nuScenes' test split has an empty one, and is not labelled.
EMPTY_LIST_BYTES = 8


@dataclass(frozen=True, eq=False)
class FoundLabel:
    """One object and its place in a file.

    Attributes:
        truth: in the camera frame (in the labels' own frame if the frame could not be read).
        line: line of its row; None for formats without lines.
        row: its KITTI row; None for other formats.
        state: its review state, in formats with such; None: accepted.
    """

    truth: Truth
    file: Path
    line: int | None = None
    row: KittiLabel | None = None
    state: ReviewState | None = None


class FrameLabels(NamedTuple):
    """The labels of a frame.

    Attributes:
        objects: in file order, without those that are invalid.
        faults: those of invalid rows of this frame, or of a file of its own.
        of_file: those of rows of a file of all frames, if their frame is not known.
        error: the first fault of the whole file, or that its angles have another unit; None if all of it is sound.
        rows: all KITTI rows.
    """

    objects: Sequence[FoundLabel] = ()
    faults: Sequence[AnnotatorError] = ()
    of_file: Sequence[AnnotatorError] = ()
    error: AnnotatorError | None = None
    rows: Sequence[KittiLabel] = ()


def load_truth(recording: Recording, index: int, frame: Frame) -> list[Truth]:
    """Returns the labelled objects of a frame in file order; empty if it is labelled as empty, or not at all.

    Args:
        frame: the frame, which has the transform from the labels' coordinates.

    Raises:
        RecordingError: the recording has no labels at all.
        FormatError: its labels are broken, or a box is out of range after the transform to the camera frame.
    """
    found = found_labels(recording, index, frame)
    if found.error is not None:
        raise found.error.with_traceback(None)  # it is kept, and would keep the frames of all callers
    return [each.truth for each in found.objects if each.state is None or each.state in REVIEWED]


def found_labels(recording: Recording, index: int, frame: Frame | None) -> FrameLabels:
    """Returns the labels of a frame; an invalid row does not hide the others.

    Args:
        frame: None if it cannot be read; then only labels that do not need it are read.
    """
    key = recording.keys[index]
    file = label_file(recording, key)
    if file is None:
        places = " or ".join(_own(recording).places) or f"labels of the format {recording.format}"
        raise RecordingError(f"{recording.path}: has no true boxes; looked for {places}")
    if frame is None and not _own(recording).without_frame:
        return FrameLabels()
    base = recording.base if isinstance(recording, LookAround) else recording
    try:
        read = _LABELS[base.format].read(base, key, file, None if frame is None else _as_recorded(frame))
        found = read if isinstance(read, FrameLabels) else FrameLabels([FoundLabel(each, file) for each in read])
        if frame is None:
            return found
        found = _moved(found, frame.T_camera_recorded)
        # all boxes of an export of annotator belong to its one camera
        is_export = recording is base and isinstance(base, NuScenes) and base.is_export
        around = isinstance(base, NuScenes | ArgoverseLog) or (isinstance(base, CloudFolder) and file.name == NAME)
        if around and not is_export:
            K, size = frame.camera.matrix, (frame.camera.width_px, frame.camera.height_px)
            found = found._replace(objects=[each for each in found.objects if is_seen(each.truth.box, K, *size)])
        return found
    except AnnotatorError as error:
        return FrameLabels(faults=(error,), error=error)
    except ValueError as error:
        # a box is out of range after the transform to the camera frame
        fault = FormatError(file, f"frame {key}: {error}; correct its boxes or its calibration")
        return FrameLabels(faults=(fault,), error=fault)


def _own(recording: Recording) -> OwnLabels:
    return _LABELS.get(recording.format, NO_LABELS)


def _moved(found: FrameLabels, T: RigidTransform | None) -> FrameLabels:
    if T is None:
        return found
    truths = transformed([each.truth for each in found.objects], T)
    objects = [replace(each, truth=truth) for each, truth in zip(found.objects, truths, strict=True)]
    return found._replace(objects=objects)


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
    places = _own(recording).places
    return isinstance(recording, SunRgbdScenes) or any((recording.root / name).is_dir() for name in places)


def has_masks(recording: Recording) -> bool:
    """Returns True if there are masks beside the recording, and its points are linked to pixels."""
    return recording.format == _MASKED and mask_folder(recording) is not None


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
        file, is_whole = label_file(recording.base, key), isinstance(recording.base, NuScenes | ArgoverseLog)
        return file if is_whole or (file is not None and file.name == NAME) else None
    if isinstance(recording, SunRgbdScenes):
        labels = recording.scene(key) / SCENE_LABELS
        labelled = labels.is_file() or any((recording.scene(k) / SCENE_LABELS).is_file() for k in recording.keys)
        return labels if labelled else None
    if isinstance(recording, KittiTracking):
        return recording.label_file if recording.label_file.is_file() else None
    if isinstance(recording, OpenLabelFolder):
        return recording.document(key)
    if isinstance(recording, CloudFolder) and not (recording.root / LABELS / CLASSES_FILE).is_file():
        truth = recording.root / PLACES[0]
        return truth if truth.is_file() else None
    folder = recording.tables if isinstance(recording, NuScenes) else recording.root
    for name in _own(recording).places:
        place = folder / name
        if place.is_file() and not (isinstance(recording, NuScenes) and place.stat().st_size <= EMPTY_LIST_BYTES):
            return place
        if place.is_dir():
            return spelled(place, f"{key}{_own(recording).suffix}")
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


def frame_number(path: Path, key: str) -> int:
    """Returns the number of a frame in the label file of a whole recording."""
    if not key.isdecimal():
        raise FormatError(
            path, f"numbers its frames, but the key {key!r} is not a number; name the images by their frame numbers"
        )
    return int(key)


def _whole(read: Callable[..., Read], path: Path, *args: object) -> Read:
    """Returns what a reader gives for a whole file, which is not parsed again for every frame until it changes."""
    status = path.stat()
    return _kept(read, path, (status.st_mtime_ns, status.st_size), *args)  # type: ignore[return-value]


@lru_cache(maxsize=16)
def _kept(read: Callable[..., object], path: Path, _version: tuple[int, int], *args: object) -> object:
    return read(path, *args)


def _first(faults: Iterable[FormatError], angles: Angles) -> FormatError | None:
    """The first fault, also if it is the unit of the angles."""
    of_set: list[FormatError] = []
    with reported(of_set.append):
        angles.require()
    return next(chain(faults, of_set), None)


def _objects(
    rows: Iterable[KittiLabel], path: Path, T: RigidTransform | None, faults: list[FormatError], angles: Angles
) -> list[FoundLabel]:
    """The 3D boxes of KITTI rows; adds faults and angles."""
    found: list[FoundLabel] = []
    for row in rows:
        with reported(faults.append):
            if row.is_solid:
                found.append(FoundLabel(row_truth(row, T, path, angles), path, row.line, row))
    return found


def _of_kitti(_recording: Recording, _key: str, path: Path, frame: Frame | None) -> FrameLabels:
    faults, angles = list[FormatError](), Angles()
    rows = list(read_rows(path, on_fault=faults.append))
    found = _objects(rows, path, frame and frame.T_camera_label, faults, angles)
    return FrameLabels(found, faults, error=_first(faults, angles), rows=rows)


def _of_votenet(_recording: Recording, _key: str, path: Path, frame: Frame | None) -> FrameLabels:
    faults, found = list[FormatError](), list[FoundLabel]()
    for line, fields in text_rows(path):
        with reported(faults.append):
            found.append(FoundLabel(extracted_truth(fields, frame and frame.T_camera_label, path, line), path, line))
    return FrameLabels(found, faults, error=next(iter(faults), None))


def labels_by_frame(recording: Recording, path: Path) -> dict[str, FrameLabels]:
    """The labels of a file of all frames, in its own coordinates, since the transform may differ between frames.

    Returns:
        by the `normal` key in `boxes.json`, the frame's number in `label_02.txt`; by `NO_FRAME` those of other frames.
    """
    return _whole(_tracks if recording.format == TRACKING else _boxes, path)


NO_FRAME = ""


def _tracks(path: Path) -> dict[str, FrameLabels]:
    faults, angles, rows = list[FormatError](), Angles(), defaultdict[str, list[KittiLabel]](list)
    for row in read_rows(path, tracking=True, on_fault=faults.append):
        rows[str(row.frame)].append(row)
    found = {key: FrameLabels(_objects(each, path, None, faults, angles), rows=each) for key, each in rows.items()}
    return _with_error(found, faults, _first(faults, angles))


def _boxes(path: Path) -> dict[str, FrameLabels]:
    of_file, found = list[FormatError](), dict[str, FrameLabels]()
    with reported(of_file.append):
        for key, entries in each_entries(path):
            faults, objects = list[FormatError](), list[FoundLabel]()
            for number, entry in enumerate(entries):
                with reported(faults.append):
                    objects.append(FoundLabel(entry_truth(entry, path, key, number), path))
            found[normal(key)] = FrameLabels(objects, faults)
    every = chain(of_file, *(each.faults for each in found.values()))
    return _with_error(found, of_file, next(every, None))


def _with_error(
    found: dict[str, FrameLabels], of_file: Sequence[AnnotatorError], error: AnnotatorError | None
) -> dict[str, FrameLabels]:
    found[NO_FRAME] = FrameLabels()
    return {key: each._replace(of_file=of_file, error=error) for key, each in found.items()}


def _of_clouds(recording: Recording, key: str, path: Path, frame: Frame) -> FrameLabels | Sequence[Truth]:
    """In the clouds' own frame: of labelCloud, or of a file of boxes."""
    if path.name != NAME:
        return transformed(read_labelcloud_file(path), frame.T_camera_label)
    return _moved(_of_boxes(recording, key, path, frame), frame.T_camera_label)


def _of_tracking(recording: Recording, key: str, path: Path, frame: Frame | None) -> FrameLabels:
    found = labels_by_frame(recording, path)
    return _moved(found.get(str(frame_number(path, key)), found[NO_FRAME]), frame and frame.T_camera_label)


def _of_boxes(recording: Recording, key: str, path: Path, _frame: Frame | None) -> FrameLabels:
    found = labels_by_frame(recording, path)
    return found.get(normal(key), found[NO_FRAME])


def _of_raw(recording: KittiRaw, key: str, path: Path, _frame: Frame) -> list[Truth]:
    """In LiDAR coordinates, unlike all other KITTI labels."""
    truths = _whole(read_tracklets, path).get(frame_number(path, key), ())
    return transformed(truths, recording.calibration(key).T_camera_lidar)


def _of_nuscenes(recording: NuScenes, key: str, path: Path, frame: Frame) -> list[Truth]:
    """The boxes of a frame's sample; none between samples."""
    sample, T = recording.sample(key), frame.T_camera_label
    if sample is None or T is None:
        return []
    return transformed(_whole(_samples, path, recording.tables, recording.samples)[sample], T)


def _samples(_path: Path, tables: Path, samples: frozenset[str]) -> dict[str, tuple[Truth, ...]]:
    """The boxes of the samples of a nuScenes scene, in the global frame."""
    return read_sample_boxes(tables, samples)


def _of_argoverse(_recording: Recording, key: str, path: Path, frame: Frame) -> list[Truth]:
    T = frame.T_camera_label
    return [] if T is None else transformed(_whole(argoverse.read_argoverse, path).get(int(key), ()), T)


def _of_rcv(_recording: Recording, key: str, path: Path, _frame: Frame | None) -> FrameLabels:
    dataset = _whole(_dataset, path.parent.parent / MANIFEST)
    _, found = dataset.labelled(dataset.manifest.frames.index(key))
    pairs = zip(found.truths, found.states or (), strict=True)
    return FrameLabels([FoundLabel(truth, path, state=state) for truth, state in pairs])


def _dataset(manifest: Path) -> RcvDataset:
    return read_rcv(manifest.parent)


def _of_openlabel(_recording: Recording, key: str, path: Path, frame: Frame) -> list[Truth]:
    labels, names = _whole(_openlabel, path)
    return labels.truths(names.known(key), frame)


def _openlabel(path: Path) -> tuple[LabelSet, DatasetNames]:
    return placed_boxes(BoxFormat.OPENLABEL, path), DatasetNames.of(path.parent)


class OwnLabels(NamedTuple):
    """The labels of a format of recordings.

    Attributes:
        read: takes the recording, a frame's key, the label file and the frame, in recorded coordinates. Of files that
            are sound as a whole or not at all, it gives the objects alone.
        places: files, or folders with a file for each frame.
        suffix: of the label files of single frames.
        without_frame: the labels are read also if the frame cannot be.
    """

    read: Callable[..., FrameLabels | Sequence[Truth]]
    places: tuple[str, ...] = ()
    suffix: str = ".txt"
    without_frame: bool = False


_MASKED = "rgbd_folder"
# The only format whose labels have the difficulty fields of KITTI's evaluation; and the other with DontCare areas.
OBJECT, TRACKING = "kitti_object", "kitti_tracking"
_LABELS = {
    _MASKED: OwnLabels(_of_boxes, PLACES, without_frame=True),
    OBJECT: OwnLabels(_of_kitti, ("label_2",), without_frame=True),
    TRACKING: OwnLabels(_of_tracking, ("label_02.txt",), without_frame=True),
    "kitti_raw": OwnLabels(_of_raw, ("tracklet_labels.xml",)),
    "nuscenes": OwnLabels(_of_nuscenes, (ANNOTATIONS,)),
    "argoverse2": OwnLabels(_of_argoverse, (argoverse.ANNOTATIONS,)),
    "sunrgbd_extracted": OwnLabels(_of_votenet, ("label",), without_frame=True),
    "sunrgbd_scenes": OwnLabels(
        lambda _r, _k, path, frame: read_scene_labels(path, frame.T_camera_label), (SCENE_LABELS,)
    ),
    "rcv": OwnLabels(_of_rcv, (LABELS,), ".json", without_frame=True),
    "openlabel": OwnLabels(_of_openlabel),
    "cloud_folder": OwnLabels(_of_clouds, (LABELS, PLACES[0]), ".json"),
}
NO_LABELS = OwnLabels(lambda *_: ())


def true_kitti_rows(recording: Recording, index: int, frame: Frame) -> Sequence[KittiLabel]:
    """Returns the true rows of a frame with DontCare areas: KITTI's own rows if there are any, else made from boxes."""
    file = label_file(recording, frame.key)
    if recording.format == OBJECT and file is not None:
        return read_kitti_file(file)
    rows = rows_of_truth(((truth.label, truth.box) for truth in load_truth(recording, index, frame)), frame)
    return [*rows, *dont_care_rows(recording, frame.key)]


def dont_care_rows(recording: Recording, key: str) -> list[KittiLabel]:
    """Returns the DontCare (unlabelled) areas of a frame; none if it has no label file."""
    file = label_file(recording, key) if recording.format in (OBJECT, TRACKING) else None
    # a label folder may lack files of some frames
    if file is None or not file.is_file():
        return []
    if recording.format == OBJECT:
        rows: Sequence[KittiLabel] = read_kitti_file(file)
    else:
        found = _of_tracking(recording, key, file, None)
        # the unit of the angles does not matter for areas
        for fault in found.of_file:
            raise fault.with_traceback(None)
        rows = found.rows
    return [row for row in rows if row.label == DONT_CARE]


def rows_of_truth(boxes: Iterable[tuple[str, OrientedBox]], frame: Frame) -> list[KittiLabel]:
    """Returns true boxes (class and box, camera frame) as rows; occlusion is computed from the frame's cloud."""
    sight = Sight(frame.cloud.xyz_m)
    return [kitti_row(label, box, None, frame, sight) for label, box in boxes]
