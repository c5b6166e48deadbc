"""The skeleton of a label format: its row in the table, the frames to write, what is lost of them, and how it is done.

A format of 3D boxes is a `DatasetWriter`, which takes `DatasetItem`s; one of 2D boxes is a `PictureWriter`, which takes
`PictureLabels`. `table.py` has a row for each format.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from annotator.files import new_folder
from annotator.formats.frame_names import FRAMES_CSV, FrameOrigin, PictureLabels, Values, dump_frames, has_frames
from annotator.geometry.oriented_box import box_corners
from annotator.geometry.transforms import IMAGE_UP
from annotator.image_bytes import encoded_image
from annotator.types import Frame, Label, OrientedBox, PointCloud, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import FormatError
from annotator.types.messages import amount


class Lost(StrEnum):
    """What an export leaves out or approximates; in words, {for one|for several} and the rest of the line."""

    words: str

    def __new__(cls, value: str, words: str) -> Lost:
        member = str.__new__(cls, value)
        member._value_, member.words = value, words
        return member

    TILT = (
        "tilt",
        "{box is tilted; the nearest upright one was|boxes are tilted; the nearest upright ones were} written",
    )
    SCORE = "score", "{box has|boxes have} a score"
    TRACK = "track", "{box has|boxes have} a track id"
    STATE = (
        "state",
        "{box was not reviewed or was|boxes were not reviewed or were} corrected, which the format cannot store",
    )
    LENS = "lens", "{frame has|frames have} lens distortion; images were rectified to an ideal camera"
    DEPTH_COLOR = "point_color", "{cloud has|clouds have} colours"
    REFLECTANCE = "reflectance", "{cloud has|clouds have} reflectances"
    OUTSIDE = "outside", "{box is outside the image and was|boxes are outside the image and were} left out"
    NAME = "name", "{box has|boxes have} a class name that was written with other characters"
    TIME = "time", "{frame has|frames have} a capture time"
    SOLID = (
        "solid",
        "{box is a 3D box; the 2D box around its projection was|boxes are 3D boxes; the 2D boxes around their "
        "projections were} written",
    )
    KIND = (
        "kind",
        "{box is a projected 3D box|boxes are projected 3D boxes} on images whose other boxes are drawn around what is "
        "seen",
    )
    SAME = "same", "{box or image is a duplicate and was|boxes or images are duplicates and were} left out"
    OPEN = (
        "open",
        "{image with reviewed boxes also has unreviewed proposals and was|images with reviewed boxes also have "
        "unreviewed proposals and were} left out",
    )
    GRAVITY = "gravity", "{frame has|frames have} a gravity direction other than the image's downward direction"
    LEVEL = "level", "{frame has|frames have} no known gravity direction; the image's downward direction was used"
    ROUNDED = "rounded", "{box was|boxes were} rounded"
    CUT = "cut", "{frame has|frames have} a scan with points outside the camera's view, which were left out"
    ATTRIBUTE = "attribute", "{attribute value|attribute values} cannot be stored in this format"
    SAID = "said", "{box was|boxes were} proposed by other software; this format cannot store which one"
    ORIGIN = (
        "origin",
        "{frame has|frames have} a place in a map or world; boxes and points were written relative to the camera",
    )
    UNREADABLE = "unreadable", "{frame cannot be read and was|frames cannot be read and were} left out"


# Corners that move less are unchanged, metres.
LEAST_ROUNDING_M = 1e-6
# A box with a smaller tilt counts as upright, radians: angles in files are rounded to two to six decimals.
LEAST_TILT_RAD = 1e-3


class Loss(Strict):
    """One line of the report.

    Attributes:
        kind: what was lost.
        count: the number of boxes (or frames, or images).
        message: the count and what was lost, as text.
        most: the largest loss where it can be measured: radians for TILT; metres, of a corner, for ROUNDED.
    """

    kind: Lost
    count: int
    message: str
    most: float | None = None


class Losses:
    """The counters of one export."""

    def __init__(self) -> None:
        self._counts: Counter[Lost] = Counter()
        self._most: dict[Lost, float] = {}
        self._values: Counter[str] = Counter()

    def add(self, kind: Lost, count: int = 1) -> None:
        """Counts `count` boxes (or frames, or images)."""
        self._counts[kind] += count

    def add_values(self, names: Iterable[str]) -> None:
        """Counts values of attributes, each by the attribute's name."""
        before = self._values.total()
        self._values.update(list(names))  # a mapping would count by its values
        self.add(Lost.ATTRIBUTE, self._values.total() - before)

    def add_tilt(self, tilt_rad: float) -> None:
        """Counts a box that was written upright, unless its tilt is below `LEAST_TILT_RAD`."""
        self._add_beyond(Lost.TILT, tilt_rad, LEAST_TILT_RAD)

    def add_rounding(self, before: OrientedBox, after: OrientedBox) -> None:
        """Counts a box that was rounded, unless its corners move by less than `LEAST_ROUNDING_M`."""
        moved_m = float(np.linalg.norm(box_corners(after) - box_corners(before), axis=1).max())
        self._add_beyond(Lost.ROUNDED, moved_m, LEAST_ROUNDING_M)

    def _add_beyond(self, kind: Lost, value: float, least: float) -> None:
        if value > least:
            self.add(kind)
            self._most[kind] = max(self._most.get(kind, 0.0), value)

    def report(self) -> tuple[Loss, ...]:
        """Returns one line for each kind, in the order of `Lost`."""
        return tuple(self._line(kind) for kind in Lost if self._counts[kind])

    def _line(self, kind: Lost) -> Loss:
        count, most = self._counts[kind], self._most.get(kind)
        several, rest = kind.words[1:].split("} ", 1)
        message = f"{amount(count, *several.split('|'))} {rest}"
        if most is not None:
            said = f"corners move by up to {most * 1000:.2g} mm" if kind is Lost.ROUNDED else ""
            message += f" ({said or f'by up to {np.rad2deg(most):.1f} degrees'})"
        elif kind is Lost.ATTRIBUTE:
            message += f" ({', '.join(f'{number} {name}' for name, number in sorted(self._values.items()))})"
        return Loss(kind=kind, count=count, message=message, most=most)


# Bytes of UTF-8. File systems take 255, which must do for a number, a suffix and the name of a temporary file, too.
LONGEST_STEM = 180


@dataclass(frozen=True, eq=False)
class DatasetItem:
    """One frame to export.

    Attributes:
        recording: name of the frame's recording.
        frame: image, cloud and camera.
        labels: the labels to export; boxes in the camera frame.
        split: the frame's part of the dataset, such as "train"; None for a dataset without parts.
        attributes: values of the frame's attributes.
        unlabelled: areas of the image where objects are not labelled (KITTI's DontCare): left top right bottom, pixels.
    """

    recording: str
    frame: Frame
    labels: Sequence[Label]
    split: str | None = None
    attributes: Values = field(default_factory=dict)
    unlabelled: Sequence[tuple[float, float, float, float]] = ()


@dataclass(frozen=True)
class Detector:
    """A 2D detector that contributed to the boxes; `role` is its input, such as image or view."""

    role: str
    name: str
    fingerprint: str


@dataclass(frozen=True)
class DatasetInfo:
    """What a writer knows of the whole dataset before its first frame.

    Attributes:
        classes: all class names, in order, with or without boxes.
        generator: program and version, such as "annotator 0.1.0".
        image_format: of camera images, in formats that leave the choice.
        vertices: labelCloud: boxes as 8 corners instead of centre, size and angles.
        detectors: those that contributed to the boxes.
        places: recording, key and place in the recording of all frames, in order; for formats that number frames.
        free_tracks: for each recording, an id above all its track ids; for formats in which every box has one.
    """

    classes: tuple[str, ...] = ()
    generator: str = "annotator"
    image_format: Literal["png", "jpg"] = "png"
    vertices: bool = False
    detectors: tuple[Detector, ...] = ()
    places: Sequence[tuple[str, str, int]] = ()
    free_tracks: Mapping[str, int] = field(default_factory=dict)


class FolderWriter:
    """Fills a new folder, which becomes the dataset when it is complete."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def put(self, name: str, content: str | bytes) -> None:
        """Writes a file of the dataset, and the folders above it."""
        file = self.folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content.encode() if isinstance(content, str) else content)


class DatasetWriter(FolderWriter):
    """Writes a dataset of 3D boxes, one frame in memory at a time; each format has a subclass.

    The methods raise OSError if a file cannot be written, FormatError or ConfigError for what the format cannot have.

    Attributes:
        out: for error messages.
        losses: a writer counts what depends on its own rules; `write_dataset` what follows from the format's row.
        counts: number of boxes written, by class.
        origins: the frames so far, this one included.
        notes: remarks for the report of the export.
    """

    def __init__(self, folder: Path, out: Path, info: DatasetInfo, losses: Losses) -> None:
        super().__init__(folder)
        self.out, self.info, self.losses = out, info, losses
        self.counts: Counter[str] = Counter()
        self.origins: list[FrameOrigin] = []
        self.notes: tuple[str, ...] = ()
        self._names = FileNames()

    def begin(self) -> None:
        """Prepares what depends on the whole dataset."""

    def put_image(self, stem: str, rgb: UInt8[np.ndarray, "h w 3"]) -> str:
        """Writes a camera image in the format that is asked for; returns its name."""
        name = f"{stem}.{self.info.image_format}"
        self.put(name, encoded_image(rgb, self.info.image_format))
        return name

    def parts(self, whole: str | None = None) -> dict[str, list[str]]:
        """Returns the ids of the frames in each part; without parts, they are all in `whole`, if it is given."""
        ids = defaultdict[str, list[str]](list)
        for origin in self.origins:
            if part := origin.split or whole:
                ids[part].append(origin.id)
        return ids

    def frame_id(self, item: DatasetItem) -> str:
        """Returns the frame's id, unique in the dataset: by default a file name of recording and key."""
        return self._names.add(item.recording, item.frame.key)

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        """Writes a frame."""
        raise NotImplementedError

    def finish(self) -> None:
        """Writes what describes the whole dataset."""


class PictureWriter(FolderWriter):
    """Writes a dataset of 2D boxes, image by image; each format has a subclass.

    Args:
        classes: all class names, in order.
        parts: names of all parts, including empty ones; () for a dataset without parts.

    Raises:
        ConfigError, FormatError: parts that the format cannot have.
    """

    def __init__(self, folder: Path, classes: Sequence[str], parts: Sequence[str] = ()) -> None:
        super().__init__(folder)
        self.classes, self.parts = tuple(classes), tuple(parts)

    def add(self, picture: PictureLabels, content: bytes, part: str | None = None) -> None:
        """Writes one image, whose boxes are in pixels; OSError if it cannot be written.

        Args:
            content: the bytes of the image file.
            part: of the dataset, such as "train"; None for a dataset without parts.
        """
        raise NotImplementedError

    def finish(self) -> Mapping[str, Path]:
        """Writes the files that describe the dataset; returns the image folder of each part."""
        raise NotImplementedError


@dataclass(frozen=True)
class Format:
    """A label format: what it can hold, how it is recognised, and its options.

    Attributes:
        summary: what an export is, to display; "" for a format that is only read.
        boxes: "any rotation", "upright" (rotated about the vertical only) or "2D".
        loses: what it cannot hold of frames and labels in any case (`count_lost`).
        values: the attributes of boxes that it holds; None: all.
        of_frames: it holds attributes of frames.
        marks: patterns of files that tell its folders; () if only the content of files does.
        is_ours: True for a folder that annotator has exported, which may be replaced; None: one with `marks` and
            frames.csv, which other programs do not write.
        writer: of 3D boxes.
        pictures: the writer of 2D boxes.
        areas: it holds areas of images where objects are not labelled.
        frames_csv: its exports have a `frames.csv`, because the format cannot say where frames come from.
        options: the options of an export that it has, as the command line calls them.
        angles: it has angles, so an import can be told their unit.
    """

    summary: str
    boxes: Literal["any rotation", "upright", "2D"]
    loses: tuple[Lost, ...] = ()
    values: tuple[str, ...] | None = None
    of_frames: bool = False
    marks: tuple[str, ...] = ()
    is_ours: Callable[[Path], bool] | None = None
    writer: type[DatasetWriter] | None = None
    pictures: type[PictureWriter] | None = None
    areas: bool = False
    frames_csv: bool = True
    options: tuple[Literal["images", "boxes-on", "vertices"], ...] = ()
    angles: bool = False

    @property
    def flat(self) -> bool:
        """True for a format of 2D boxes on images."""
        return self.boxes == "2D"

    @property
    def states(self) -> tuple[ReviewState, ...]:
        """The review states that are exported by default: the reviewed ones, and if it holds states, proposed ones."""
        is_held = Lost.STATE not in self.loses
        return (*((ReviewState.PROPOSED,) if is_held else ()), ReviewState.ACCEPTED, ReviewState.EDITED)

    def is_marked(self, folder: Path) -> bool:
        """True for a folder that has one of the marks."""
        return any(next(folder.glob(mark), None) is not None for mark in self.marks)

    def may_replace(self, folder: Path) -> bool:
        """True for a folder that annotator has exported in this format."""
        return has_frames(folder) and self.is_marked(folder) if self.is_ours is None else self.is_ours(folder)


def write_dataset(
    format: Format,
    out: Path,
    items: Iterable[DatasetItem],
    info: DatasetInfo,
    losses: Losses | None = None,
    *,
    overwrite: bool = False,
) -> DatasetWriter:
    """Writes the folder `out` atomically, one frame in memory at a time.

    Args:
        format: one of 3D boxes.
        out: a folder that is missing or empty; with `overwrite`, an older export of this format is replaced.
        items: the frames, each recording in order, read one by one; if reading one raises, `out` is unchanged.

    Raises:
        ConfigError: parts, classes or recordings that the format cannot have.
    """
    losses, known = losses or Losses(), set[tuple[str, str]]()
    assert format.writer is not None
    with new_folder(out, lambda old: overwrite and format.may_replace(old)) as folder:
        writer = format.writer(folder, out, info, losses)
        with writing(out):
            writer.begin()
        for item in items:
            place = (item.recording, item.frame.key)
            if place in known:
                raise FormatError(out, f"{item.recording}, frame {item.frame.key}: the frame is exported twice")
            known.add(place)
            count_lost(losses, item, format.loses)
            if not format.of_frames:
                losses.add_values(item.attributes)
            # a format that holds some values counts the others itself
            if format.values == ():
                losses.add_values(name for label in item.labels for name in label.attributes)
            writer.origins.append(FrameOrigin(writer.frame_id(item), *place, item.split))
            with writing(out):
                writer.frame(item, writer.origins[-1].id)
        if not writer.origins:
            raise FormatError(out, "there is no frame to export; the export was not written")
        with writing(out):
            writer.finish()
            if format.frames_csv:
                write_frames(folder, writer.origins)
    return writer


def write_frames(folder: Path, origins: Iterable[FrameOrigin]) -> None:
    """Writes `frames.csv`."""
    (folder / FRAMES_CSV).write_text(dump_frames(origins), encoding="utf-8", newline="")


def count_lost(losses: Losses, item: DatasetItem, kinds: Iterable[Lost]) -> None:
    """Counts what a format that cannot hold these kinds loses of a frame and its labels."""
    frame = item.frame
    counts = {
        Lost.LENS: not frame.camera.is_ideal,
        Lost.DEPTH_COLOR: frame.cloud.rgb is not None,
        Lost.REFLECTANCE: frame.cloud.reflectance is not None,
        Lost.TIME: frame.timestamp_ns is not None,
        Lost.ORIGIN: frame.T_world_camera is not None,
        Lost.GRAVITY: frame.up is not None and float(np.linalg.norm(frame.up - IMAGE_UP)) > LEAST_TILT_RAD,
        Lost.LEVEL: frame.up is None,
        Lost.SCORE: sum(label.score is not None for label in item.labels),
        Lost.TRACK: sum(label.track_id is not None for label in item.labels),
        Lost.SAID: sum(bool(label.said) for label in item.labels),
        Lost.STATE: sum(label.state is not ReviewState.ACCEPTED for label in item.labels),
    }
    for kind in kinds:
        losses.add(kind, int(counts[kind]))


@dataclass
class FileNames:
    """File names that are valid on every system, and unique even where case is ignored."""

    _taken: set[str] = field(default_factory=set)

    def add(self, *parts: str) -> str:
        """Adds a name: the parts joined by "-", shortened if it is too long, with a number if that name is taken."""
        stem = "-".join(re.sub(r"[^\w.]+", "_", part) for part in parts).lstrip(".") or "_"
        if len(stem.encode()) > LONGEST_STEM:
            # its end, which tells the frames of a recording apart
            stem = stem.encode()[-LONGEST_STEM:].decode(errors="ignore").lstrip(".") or "_"
        candidate, number = stem, 1
        while candidate.casefold() in self._taken:
            number += 1
            candidate = f"{stem}-{number}"
        self._taken.add(candidate.casefold())
        return candidate


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turns an OSError into a FormatError that names the dataset."""
    try:
        yield
    except OSError as error:
        raise FormatError(out, f"cannot be written ({error.strerror}); the incomplete dataset was removed") from error


XYZ = ("x", "y", "z")
RGB = ("red", "green", "blue")
CAMERA_FRAME = "camera frame: x right, y down, z forward, metres"


def ply(cloud: PointCloud, comment: str = CAMERA_FRAME) -> bytes:
    """Returns points as a PLY file (Greg Turk, "The PLY Polygon File Format", 1994): binary, little-endian.

    The properties of the element `vertex` are float x y z, then uchar red green blue and float reflectance if the cloud
    has them.

    Args:
        comment: the points' frame of reference, one line of ASCII.
    """
    known: list[tuple[tuple[str, ...], str, np.ndarray]] = [(XYZ, "float", cloud.xyz_m)]
    known += [] if cloud.rgb is None else [(RGB, "uchar", cloud.rgb)]
    known += [] if cloud.reflectance is None else [(("reflectance",), "float", cloud.reflectance[:, None])]
    kinds = {name: word for names, word, _ in known for name in names}
    rows = np.empty(len(cloud), [(name, "<f4" if word == "float" else "u1") for name, word in kinds.items()])
    for names, _, values in known:
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    head = f"ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex {len(cloud)}\n"
    head += "".join(f"property {word} {name}\n" for name, word in kinds.items()) + "end_header\n"
    return head.encode("ascii") + rows.tobytes()
