"""Finds the datasets below a path: recordings with their own labels, `rcv` datasets, and those of other software.

Of the boxes of other software only units and sizes are checked, because the frames that they label belong to a project,
not to the dataset. Labels, files and lists that refer to frames which a dataset does not have are found here, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from annotator.files import read_file
from annotator.formats import sustechpoints
from annotator.formats.frame_names import has_frames
from annotator.formats.kitti_folders import IMAGE_SETS
from annotator.formats.labelcloud import CLASSES_FILE, CLOUDS, LABELS
from annotator.formats.openlabel import is_document
from annotator.formats.rcv import FOLDERS, MANIFEST, SPLITS, RcvDataset, read_rcv
from annotator.formats.reading import OnFault, text_rows
from annotator.formats.table import FORMATS, AnyFormat, BoxFormat, FlatFormat, format_of
from annotator.formats.yolo import CLASSES, DATA_YAML, SUFFIXES
from annotator.recordings import Recording, open_recording
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.kitti import KittiObject
from annotator.recordings.listing import IMAGE_SUFFIXES, stems
from annotator.recordings.open import FILE_SUFFIXES
from annotator.recordings.sunrgbd import SunRgbdScenes
from annotator.text import normal, spelled
from annotator.types.errors import AnnotatorError, FormatError, RecordingError, UnknownFormatError
from annotator.workflows.importing.pictures import read_pictures
from annotator.workflows.importing.readers import placed_boxes
from annotator.workflows.recorded.reading import NO_FRAME, label_file, labels_by_frame

# Formats of labels that open as a recording with their images and clouds.
OF_RECORDINGS = (BoxFormat.KITTI, BoxFormat.KITTI_TRACKING, BoxFormat.SUNRGBD, BoxFormat.BOXES)

Box = tuple[str, Float64[np.ndarray, "3"] | None]
"""The class and the size of a box; None for 2D boxes."""


class Layout(NamedTuple):
    """How a folder with a dataset of other software is told.

    Attributes:
        title: the format's name to display.
        files: patterns of which the folder has all.
        is_recording: the folder has clouds or images beside the labels, so it may also be a recording.
        opened_as: format of the recordings whose own labels these are; their boxes are checked there.
    """

    format: AnyFormat
    title: str
    files: tuple[str, ...] = ()
    is_recording: bool = True
    opened_as: str | None = None


# labelCloud's labels, without `_classes.json`
JSON_OF_CLOUDS = f"{LABELS}/[!_]*.json"
# with clouds or classes beside them
LABELCLOUD = (CLOUDS, f"{LABELS}/{CLASSES_FILE}")
LAYOUTS = (
    Layout(BoxFormat.NUSCENES, "nuScenes tables", ("v1.0-*/sample_annotation.json",), is_recording=False),
    *(
        Layout(BoxFormat.LABELCLOUD, "labelCloud labels", (beside, JSON_OF_CLOUDS), opened_as="cloud_folder")
        for beside in LABELCLOUD
    ),
    Layout(BoxFormat.SUSTECHPOINTS, "SUSTechPOINTS labels", (sustechpoints.CLOUDS, f"{sustechpoints.LABELS}/*.json")),
    Layout(FlatFormat.COCO, "COCO boxes", FORMATS[FlatFormat.COCO].marks),
)
OF_YOLO = Layout(FlatFormat.YOLO, "YOLO boxes")
DOCUMENTS = Layout(BoxFormat.OPENLABEL, "OpenLABEL documents", is_recording=False, opened_as="openlabel")


@dataclass(frozen=True)
class OtherSoftwareDataset:
    """A dataset whose boxes are not compared with clouds and images."""

    path: Path
    layout: Layout

    def frames(self, on_fault: OnFault) -> Iterator[Sequence[Box]]:
        """Yields the boxes of each frame, read as imports do; the caller judges their sizes."""
        # other JSON files may lie beside documents
        is_folder = self.layout is DOCUMENTS
        for path in filter(is_document, sorted(self.path.glob("*.json"))) if is_folder else (self.path,):
            try:
                yield from _boxes(self.layout.format, path, on_fault)
            except FormatError as fault:
                on_fault(fault)


def other_software_dataset(path: Path) -> OtherSoftwareDataset | None:
    """Returns the dataset in a folder, without looking into subfolders; None for unknown formats."""
    if not path.is_dir() or (path / MANIFEST).is_file():
        return None
    found = (each for each in LAYOUTS if all(next(path.glob(file), None) is not None for file in each.files))
    layout = DOCUMENTS if any(map(is_document, path.glob("*.json"))) else next(found, None)
    layout = OF_YOLO if layout is None and _is_yolo(path) else layout
    return None if layout is None else OtherSoftwareDataset(path, layout)


def _is_yolo(path: Path) -> bool:
    """True for Ultralytics' `data.yaml`, or `classes.txt` with labels in `labels` or beside images of the same name."""
    if (path / DATA_YAML).is_file():
        with suppress(OSError):
            return b"names:" in read_file(path / DATA_YAML)
    if not (path / CLASSES).is_file():
        return False
    if any(file.name != CLASSES for file in (path / "labels").glob("*.txt")):
        return True
    pictures = {normal(file.stem) for file in path.iterdir() if file.suffix.lower() in SUFFIXES}
    return any(normal(file.stem) in pictures for file in path.glob("*.txt"))


def labels_alone(path: Path) -> OtherSoftwareDataset | None:
    """Returns the labels at a path without images or clouds; None for those that are checked with their recording."""
    try:
        format = format_of(path)
    except FormatError:
        return None
    if format in OF_RECORDINGS:
        return None
    what = "boxes" if isinstance(format, FlatFormat) else "labels"
    return OtherSoftwareDataset(path, Layout(format, f"{format} {what}"))


def _boxes(format: AnyFormat, path: Path, on_fault: OnFault) -> Iterator[Sequence[Box]]:
    if isinstance(format, FlatFormat):
        for picture in read_pictures(format, path, on_fault=on_fault).pictures:
            yield [(label, None) for label in picture.labels]
    else:
        for frame in placed_boxes(format, path, on_fault=on_fault).labelled.values():
            yield [(truth.label, truth.box.size_m) for truth in frame.truths]


MOST_LEVELS = 4
# Calibration files of the formats; the first one that exists is used.
CALIBRATIONS = (
    "calib/{key}.txt",
    "calib.txt",
    "calib_cam_to_cam.txt",
    "../calib_cam_to_cam.txt",
    "camera_intrinsic.json",
)


@dataclass(frozen=True)
class Source:
    """A dataset: a recording whose frames are read one at a time, and its labels.

    Attributes:
        dataset: what the recording is as an `rcv` dataset, whose frames may come from several recordings.
    """

    recording: Recording
    dataset: RcvDataset | None = None

    def calibration(self, index: int) -> Path:
        recording = self.recording
        if self.dataset is not None:
            return self.dataset.label_path(index)
        if isinstance(recording, SunRgbdScenes):
            return recording.scene(recording.keys[index]) / "intrinsics.txt"
        places = (spelled(recording.root, name.format(key=recording.keys[index])) for name in CALIBRATIONS)
        return next((place for place in places if place.is_file()), recording.path)

    def place(self, index: int) -> tuple[str, int]:
        """Returns the original recording of a frame, and its number there."""
        return (self.recording.name, index) if self.dataset is None else self.dataset.place(index)

    @property
    def has_labels(self) -> bool:
        return bool(self.recording.keys) and label_file(self.recording, self.recording.keys[0]) is not None

    @property
    def has_pictures(self) -> bool:
        """False if the images are rendered from the clouds."""
        return not (isinstance(self.recording, CloudFolder) and self.recording.images is None)


SourceOrError = Source | OtherSoftwareDataset | tuple[Path, AnnotatorError]


def find_sources(path: Path) -> Iterator[SourceOrError]:
    """Yields the datasets at `path`, else those below it; for one that cannot be opened, its path and the error."""
    is_empty = True
    for source in _below(path, MOST_LEVELS):
        is_empty = False
        yield source
    if is_empty and (labels := labels_alone(path)) is not None:
        yield labels
    elif is_empty:
        # raises an error that says what the path looks like
        open_recording(path)


def _below(path: Path, levels: int) -> Iterator[SourceOrError]:
    dataset = other_software_dataset(path)
    if dataset is not None:
        source = _with_own_labels(path, dataset)
        yield source or dataset
        if source is not None or not dataset.layout.is_recording:
            return
    try:
        yield _open(path)
        return
    except UnknownFormatError:
        pass
    except (FormatError, RecordingError) as error:
        yield path, error
        return
    if levels == 0 or not path.is_dir():
        return
    for child in sorted(path.iterdir()):
        if not child.name.startswith(".") and (child.is_dir() or child.suffix.lower() in FILE_SUFFIXES):
            yield from _below(child, levels - 1)


def _with_own_labels(path: Path, dataset: OtherSoftwareDataset) -> Source | None:
    """Returns the recording whose own labels the sound dataset holds, so that its boxes can be checked."""
    faults: list[FormatError] = []
    with suppress(AnnotatorError):
        source = None if dataset.layout.opened_as is None else _open(path)
        if source is not None and source.recording.format == dataset.layout.opened_as and source.has_labels:
            # labels of frames that the recording does not have are read only here
            for _ in dataset.frames(faults.append):
                pass
            return None if faults else source
    return None


def _open(path: Path) -> Source:
    dataset = read_rcv(path) if (path / MANIFEST).is_file() else None
    return Source(open_recording(path), dataset)


Stray = tuple[Path, int | None, str]
"""A file that refers to a missing frame, the line in it (None: the file's name refers to it), and the frame's name."""


# Files that have the names of frames, and lists of frames.
NAMED = {
    "kitti_object": ("label_2/*.txt", "calib/*.txt"),
    "sunrgbd_extracted": ("label/*.txt", "calib/*.txt"),
    "rcv": tuple(f"{folder}/*" for folder in FOLDERS),
}
LISTS = {"sunrgbd_extracted": "*_data_idx.txt", "rcv": f"{SPLITS}/*.txt"}
# KITTI's test frames, whose labels are not public: their folder, and their list.
TESTING, TEST_LIST = "testing", "test.txt"


def stray_names(recording: Recording) -> Iterator[Stray]:
    """Yields labels, calibrations, files of an export and list entries without a frame.

    Lists are `ImageSets/*.txt` of KITTI (beside `training`, or in the folder itself), VoteNet's `*_data_idx.txt`, which
    have the frames' numbers without leading zeros, and `splits/*.txt` of annotator's exports.
    """
    root, format, keys = recording.root, recording.format, set(map(normal, recording.keys))
    for pattern in NAMED.get(format, ()):
        yield from ((file, None, file.stem) for file in sorted(root.glob(pattern)) if normal(file.stem) not in keys)
    labels = label_file(recording, recording.keys[0]) if recording.keys else None
    if labels is not None and format in ("kitti_tracking", "rgbd_folder"):
        is_number = format == "kitti_tracking"
        known = {str(int(key)) if is_number and key.isdecimal() else key for key in keys}
        with suppress(FormatError):  # reported where the labels are read
            for name, found in labels_by_frame(recording, labels).items():
                # unlabelled areas alone are no labels
                if name not in known and name != NO_FRAME and (found.objects or not is_number):
                    yield labels, found.objects[0].line if found.objects else None, name
    if isinstance(recording, KittiObject):
        yield from _image_sets(recording, keys)
    if format in LISTS:
        zeros = "0" if format == "sunrgbd_extracted" else ""
        for file in sorted(root.glob(LISTS[format])):
            yield from _not_listed(file, keys, zeros)


def _image_sets(recording: KittiObject, keys: set[str]) -> Iterator[Stray]:
    # the recording may have been opened at training/ or at the folder above
    folders = [recording.root, *([recording.root.parent] if recording.root.name == "training" else [])]
    for folder in folders:
        pictures = folder / TESTING / recording.images
        testing = set(map(normal, stems(pictures, IMAGE_SUFFIXES))) if pictures.is_dir() else set()
        for file in sorted((folder / IMAGE_SETS).glob("*.txt")):
            # without testing/, test.txt lists frames elsewhere, except in exports, which have them in training/
            if file.name != TEST_LIST:
                yield from _not_listed(file, keys)
            elif testing or has_frames(folder):
                yield from _not_listed(file, keys | testing)


def _not_listed(file: Path, keys: set[str], zeros: str = "") -> Iterator[Stray]:
    """Yields the frames in a list that are none of `keys`, of which all may lack leading `zeros`."""
    known = {key.lstrip(zeros) for key in keys}
    for line, (name, *_) in text_rows(file):
        if normal(name).lstrip(zeros) not in known:
            yield file, line, name
