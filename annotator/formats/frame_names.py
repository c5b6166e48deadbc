"""The frames, images and attribute values of a dataset that readers return, and `frames.csv`: where frames come from.

`frames.csv` is for formats that cannot store the origin of a frame. One line per frame under the header
`id,recording,key,split` (RFC 4180, UTF-8): the frame's id in the dataset (the stem of its files, or its token), the
recording's name, the frame's key in the recording, and its part of the dataset (may be empty). A text that a
spreadsheet would run as a formula begins with an apostrophe, which the reader removes.

In KITTI's and SUN RGB-D's folders, frames have six-digit names and classes one-word names, because the tools of both
data sets form file names from numbers (`%06d`) and split label rows at spaces.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.formats.reading import read_text
from annotator.geometry.outline import clip_to_image, edges_of
from annotator.text import OutsideError, inside, is_absolute, normal, stem_of
from annotator.types import Box2D, BoxKind, Frame, ReviewState, Truth
from annotator.types.errors import FormatError
from annotator.types.label import AttributeValue

Values = Mapping[str, AttributeValue]
NO_VALUES: Values = MappingProxyType({})

# Attributes that formats measure or have fields for; an operator's value wins.
TRUNCATION, OCCLUSION, VISIBILITY = "truncation", "occlusion", "visibility"


def held_by_kitti(values: Values) -> dict[str, float]:
    """The values that a row of KITTI can hold: a truncation in 0..1 and an occlusion of 0 to 3."""
    numbers = {
        name: value for name, value in values.items() if isinstance(value, int | float) and not isinstance(value, bool)
    }
    held = {}
    if 0 <= numbers.get(TRUNCATION, -1) <= 1:
        held[TRUNCATION] = float(numbers[TRUNCATION])
    if numbers.get(OCCLUSION, -1) in range(4):
        held[OCCLUSION] = float(numbers[OCCLUSION])
    return held


def of_kitti(truncated: float, occluded: int) -> dict[str, AttributeValue]:
    """The values of a row; negative ones mean that they are unknown."""
    values = ((TRUNCATION, float(truncated)), (OCCLUSION, occluded))
    return {name: value for name, value in values if value >= 0}


def dotted(values: Values) -> tuple[str, ...]:
    """Values as names like nuScenes' attributes, `pose.sitting`."""
    return tuple(f"{name}.{str(value).lower() if isinstance(value, bool) else value}" for name, value in values.items())


def from_dotted(names: Iterable[str]) -> dict[str, AttributeValue]:
    """The values of such names; a name without a dot is the value true."""
    parts = (name.partition(".") for name in names)
    return {name.strip(): typed_value(value) if dot else True for name, dot, value in parts}


def typed_value(text: str) -> AttributeValue:
    """The number or boolean that `dotted` writes as this text, else the text: "0012" and "nan" stay texts."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    is_number = isinstance(value, int) or (isinstance(value, float) and math.isfinite(value))
    return value if is_number and json.dumps(value) == text else text


def joined(values: Values) -> str:
    """Values as one text, `pose.sitting,helmet.true`; commas within them are escaped as in URLs."""
    return ",".join(name.replace("%", "%25").replace(",", "%2C") for name in dotted(values))


def from_joined(text: str) -> dict[str, AttributeValue]:
    """The values of such a text, or of one that a person wrote: `door open, occluded`."""
    return from_dotted(unquote(part) if "." in part else part.strip() for part in text.split(",") if part.strip())


FRAMES_CSV = "frames.csv"
HEADER = ("id", "recording", "key", "split")

# Apostrophes before such a beginning are doubled, so that every text is read back as it was.
_FORMULA = re.compile(r"'*[=+\-@\t\r\n]")
_ESCAPED = re.compile(r"^'(?='*[=+\-@\t\r\n])")
_NUMBER = re.compile(r"[+-]?[0-9]+(\.[0-9]*)?([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class FrameOrigin:
    """One line of the file.

    Attributes:
        id: the frame's id in the dataset.
        recording: name of the recording that the frame came from.
        key: the frame's key in that recording.
        split: its part of the dataset; None for a dataset without parts.
    """

    id: str
    recording: str
    key: str
    split: str | None = None

    @property
    def name(self) -> str:
        """`RECORDING/KEY`, which identifies the frame in a project."""
        return f"{self.recording}/{self.key}"


def dump_frames(origins: Iterable[FrameOrigin]) -> str:
    """Returns the text of the file."""
    stream = io.StringIO()
    # RFC 4180; with "\n" alone the csv module would not quote a "\r" in a name
    rows = csv.writer(stream, lineterminator="\r\n")
    rows.writerow(HEADER)
    rows.writerows(map(_escaped, (o.id, o.recording, o.key, o.split or "")) for o in origins)
    return stream.getvalue()


def _escaped(cell: str) -> str:
    return f"'{cell}" if _FORMULA.match(cell) and not _NUMBER.fullmatch(cell) else cell


def parse_frames(path: Path, text: str) -> dict[str, FrameOrigin]:
    """Returns the lines of the file, by `normal` id; `path` is for error messages."""
    origins: dict[str, FrameOrigin] = {}
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        if (header := tuple(next(rows, ()))) != HEADER:
            raise FormatError(path, f"must begin with {','.join(HEADER)}, not {','.join(header)}", 1)
        for row in ([_ESCAPED.sub("", cell) for cell in row] for row in rows):
            if len(row) != len(HEADER) or not row[0] or not row[2]:
                raise FormatError(
                    path, f"needs the fields {', '.join(HEADER)}; id and key must not be empty", rows.line_num
                )
            if normal(row[0]) in origins:
                raise FormatError(path, f"the id {row[0]} occurs twice; keep one of its lines", rows.line_num)
            origins[normal(row[0])] = FrameOrigin(row[0], row[1], row[2], row[3] or None)
    except csv.Error as error:
        raise FormatError(path, f"is not valid CSV: {error}", rows.line_num) from error
    return origins


def read_frames(folder: Path) -> dict[str, FrameOrigin]:
    """Returns the origins of a dataset's frames, by `normal` id; empty if it has no such file or an unrelated one."""
    path = folder / FRAMES_CSV
    return parse_frames(path, read_text(path)) if has_frames(folder) else {}


def has_frames(folder: Path) -> bool:
    """True if a folder has the file; a `frames.csv` with an unrelated header does not count."""
    path = folder / FRAMES_CSV
    if not path.is_file():
        return False
    head = read_text(path).partition("\n")[0]
    # a damaged header still counts, so that reading the file reports it
    return not head.strip() or "recording" in head.split(",")


CLASS_NAMES = "classes.txt"
SIX_DIGITS = re.compile(r"[0-9]{6}")


def six_digit_ids(places: Sequence[tuple[str, str]], first: int = 0) -> dict[tuple[str, str], str]:
    """Returns a six-digit name for each frame: its key if all keys have six digits and differ, else its number.

    Args:
        places: recording and key of all frames, all different, in order.
        first: the first number.
    """
    keys = [key for _, key in places]
    if all(map(SIX_DIGITS.fullmatch, keys)) and len(set(keys)) == len(keys):
        return dict(zip(places, keys, strict=True))
    return {place: f"{number:06d}" for number, place in enumerate(places, first)}


class ClassWords:
    """Class names as unique single words: spaces become `_`."""

    def __init__(self, classes: Iterable[str], reserved: Sequence[str] = ()) -> None:
        """
        Args:
            classes: all class names.
            reserved: words with another meaning in the format, in any case.
        """
        self._words: dict[str, str] = {}
        taken = {word.casefold() for word in reserved}
        # single words come first, so that they stay unchanged
        for name in sorted(classes, key=lambda name: len(name.split()) != 1):
            word = "_".join(name.split())
            while word in self._words.values() or word.casefold() in taken:
                word += "_"
            self._words[name] = word

    def __getitem__(self, name: str) -> str:
        return self._words[name]

    def is_changed(self, name: str) -> bool:
        """True if the word differs from the name."""
        return self._words[name] != name

    def write(self, folder: Path) -> None:
        """Writes `classes.txt`, with a line `WORD NAME` for each changed name; nothing if none has changed."""
        if changed := "".join(f"{word} {name}\n" for name, word in self._words.items() if word != name):
            (folder / CLASS_NAMES).write_text(changed, encoding="utf-8")


def read_class_names(folder: Path) -> dict[str, str]:
    """Returns the class names in a dataset's `classes.txt` (`ClassWords.write`), by word; empty without that file."""
    path = folder / CLASS_NAMES
    if not path.is_file():
        return {}
    names: dict[str, str] = {}
    for line, text in enumerate(read_text(path).splitlines(), 1):
        word, _, name = text.partition(" ")
        if not word or not name.strip() or word in names:
            raise FormatError(path, "a line must be `WORD CLASS_NAME`, with each word only once", line)
        names[word] = name
    return names


@dataclass(frozen=True)
class DatasetNames:
    """The frame and class names of an exported dataset; empty for datasets from other software.

    Attributes:
        root: the folder with frames.csv; None without that file.
        frames: the frames' origins by the `normal` stem of their files.
    """

    root: Path | None = None
    frames: dict[str, FrameOrigin] = field(default_factory=dict)

    @classmethod
    def of(cls, labels: Path) -> DatasetNames:
        """Reads the names of the dataset that a folder of label files belongs to.

        Its frames.csv is in that folder or at most two levels above.
        """
        above = labels.resolve()
        root = next((folder for folder in (above, *above.parents[:2]) if has_frames(folder)), None)
        if root is None:
            return cls()
        frames, ids = read_frames(root), dict[str, str]()
        for origin in frames.values():
            if ids.setdefault(origin.name, origin.id) != origin.id:
                raise FormatError(
                    root / FRAMES_CSV, f"the ids {ids[origin.name]} and {origin.id} both name {origin.name}; keep one"
                )
        return cls(root, frames)

    def frame(self, stem: str) -> str:
        """Returns `RECORDING/KEY` of a label file; its `normal` stem without a frames.csv."""
        stem = normal(stem)
        if self.root is None:
            return stem
        if stem not in self.frames:
            raise FormatError(
                self.root / FRAMES_CSV, f"does not list the frame {stem}, which has labels; add a line for this frame"
            )
        return self.frames[stem].name

    def known(self, stem: str) -> str:
        """As `frame`, but the `normal` stem also of a file that frames.csv does not list."""
        stem = normal(stem)
        return self.frames[stem].name if stem in self.frames else stem

    @cached_property
    def classes(self) -> dict[str, str]:
        """Class names by word, where the two differ; formats without such words may have another `classes.txt`."""
        return {} if self.root is None else read_class_names(self.root)

    def label(self, word: str) -> str:
        """Returns the class name of a word."""
        return self.classes.get(word, word)


Pose = Callable[[Frame], RigidTransform | None]
"""The transform from the frame of reference of a dataset's boxes to the camera of the project's frame; None: the boxes
are in its frame already."""


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """The objects of one frame of a dataset.

    Attributes:
        truths: in file order, with their scores as in the file.
        pose: from their frame of reference to the camera, as the dataset says it, else as the project's frame, whose
            reading takes long; None: they are in the camera frame.
        states: of each object, for formats with review states; None: accepted.
        values: attributes of the frame.
        flat: number of 2D boxes without a 3D box.
    """

    truths: Sequence[Truth]
    pose: RigidTransform | Pose | None = None
    states: Sequence[ReviewState | None] | None = None
    values: Values = field(default_factory=dict)
    flat: int = 0

    def T_camera(self, read: Callable[[], Frame]) -> RigidTransform | None:
        """Returns the transform to the camera of the project's frame, which is read only if that is necessary."""
        return self.pose if self.pose is None or isinstance(self.pose, RigidTransform) else self.pose(read())


def add_once(frames: dict[str, LabelledFrame], file: Path, name: str, frame: LabelledFrame) -> None:
    """Adds a frame of a label file; FormatError if its dataset has labels for it in another place, too."""
    if name in frames:
        raise FormatError(file, f"the frame {name} has labels twice; import one folder, scene or sensor at a time")
    frames[name] = frame


def of_recording(frame: Frame) -> RigidTransform | None:
    """The pose of boxes in the frame of the recording's own labels."""
    return frame.T_camera_label


def in_world(T_world_there: RigidTransform | None) -> Pose | None:
    """The pose of boxes relative to the camera of an exported frame.

    In a map of the clouds, its place is another than that of the project's frame if the recording was added with
    another origin. Poses may have been corrected since, which moves no box before its camera.

    Args:
        T_world_there: where the dataset says that its camera is; None if it does not.
    """
    if T_world_there is None:
        return None

    def pose(frame: Frame) -> RigidTransform | None:
        T = frame.T_world_camera if frame.in_map else None
        return None if T is None else T.inv() * T_world_there

    return pose


@dataclass(frozen=True)
class YoloBox:
    """One line of a label file.

    Attributes:
        label: class name.
        shares: cx, cy, w, h as fractions of the image size.
        score: 1 if absent.
        is_around: it is the rectangle around a turned box or a polygon.
        corners: x1 y1 x2 y2 ... of that; else ().
    """

    label: str
    shares: tuple[float, float, float, float]
    score: float = 1.0
    is_around: bool = False
    corners: tuple[float, ...] = field(default=(), compare=False, repr=False)

    def on(self, width_px: int, height_px: int) -> Box2D:
        """Returns the box in pixels of an image of that size, clipped to the image."""
        edges = edges_of(np.array(self.shares), width_px, height_px)
        x_min, y_min, x_max, y_max = map(float, edges)
        box = Box2D(self.label, x_min, y_min, x_max, y_max, self.score)
        cut = clip_to_image(box, width_px, height_px)
        assert cut is not None  # `parse_boxes` rejects boxes outside the image
        return cut


@dataclass(frozen=True, eq=False)
class PictureLabels:
    """One image of a dataset of 2D boxes.

    Attributes:
        file_name: as in the dataset, usually relative to the image folder; the label file's if there is no image.
        boxes: in file order; in pixels they are clipped to the image, the centre of the first pixel is (0, 0).
        size_px: width and height from the dataset; None if boxes are fractions of the image size.
        folder: where the image is or would be.
        box_kind: what the boxes enclose, if the dataset says so.
        values: attributes of each box; () if none has any.
        attributes: of the image.
        around: number of boxes that are the rectangles around turned boxes or polygons.
    """

    file_name: str
    boxes: tuple[Box2D, ...] | tuple[YoloBox, ...]
    size_px: tuple[int, int] | None = None
    folder: Path = Path()
    box_kind: BoxKind | None = None
    values: tuple[Values, ...] = ()
    attributes: Values = field(default_factory=dict)
    around: int = 0

    def boxes_on(self, width_px: int, height_px: int) -> tuple[Box2D, ...]:
        """Returns the boxes on an image of that size."""
        return tuple(box.on(width_px, height_px) if isinstance(box, YoloBox) else box for box in self.boxes)

    @property
    def labels(self) -> tuple[str, ...]:
        """The class of each box."""
        return tuple(box.label for box in self.boxes)

    @property
    def stem(self) -> str:
        """The file's `normal` name without folder and suffix."""
        return normal(stem_of(self.file_name))

    def file(self, path: Path) -> Path | None:
        """Returns the image file; None if it does not exist, such as one that was on another computer."""
        try:
            file = inside(self.folder, self.file_name)
        except OutsideError as error:
            if is_absolute(self.file_name):
                return None
            raise FormatError(path, str(error)) from error
        # labels without an image have the name of their label file, which may be in this folder
        return file if file.is_file() and file.suffix.lower() != ".txt" else None
