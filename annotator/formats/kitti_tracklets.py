"""Labels of KITTI raw drives, `tracklet_labels.xml`: each object with its class, its size and one pose per frame.

KITTI raw devkit, `cpp/tracklets.h` (fields, their values) and `matlab/run_demoTracklets.m` (their meaning): poses are
in the LiDAR's frame (x forward, y left, z up), tx ty tz is the middle of the bottom face, rz turns about z, 0 if the
object faces +x; l w h are the sizes along its own x y z. Pose number k belongs to frame first_frame + k of the drive.

The file is a serialised C++ object with an empty `<!DOCTYPE boost_serialization>`. Any other DTD content is rejected:
entities could expand without limit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.files import open_file
from annotator.formats.reading import finite_number
from annotator.formats.units import Angles
from annotator.types import OrientedBox, Truth
from annotator.types.errors import FormatError

OBJECT = ("boost_serialization", "tracklets", "item")
POSE = (*OBJECT, "poses", "item")
# tracklets.h: the object is outside the image (2) or behind the camera (3), where it was not labelled.
NOT_IN_IMAGE = (2, 3)
MOST_LEVELS = 20
LONGEST_VALUE = 200
MOST_FRAME = 10_000_000
# KITTI writes rx = ry = 0; the order of rotations for other values is not documented.
MOST_TILT_RAD = 1e-6


@dataclass
class _Object:
    """One tracklet: its fields, and its poses with their lines."""

    values: dict[str, str] = field(default_factory=dict)
    poses: list[tuple[int, dict[str, str]]] = field(default_factory=list)


def read_tracklets(path: Path) -> dict[int, list[Truth]]:
    """Returns the objects by the drive's frame number, in file order, in the LiDAR's frame.

    A frame without objects has no entry. Track ids count the objects of the file from 0. Poses outside the image
    (`truncation`) are left out.
    """
    frames: dict[int, list[Truth]] = {}
    angles = Angles()
    for track_id, (line, tracklet) in enumerate(_objects(path)):
        label = tracklet.values.get("objectType", "").strip()
        if not label:
            raise FormatError(path, "an object has no objectType", line)
        size_m = np.array([_number(path, line, tracklet.values, name) for name in ("l", "w", "h")])
        if (size_m <= 0).any():
            raise FormatError(path, f"l w h must be positive, not {' '.join(map(str, size_m))}", line)
        first = _number(path, line, tracklet.values, "first_frame")
        if first != int(first) or not 0 <= first <= MOST_FRAME:
            raise FormatError(path, f"first_frame must be a whole number in 0..{MOST_FRAME}, not {first}", line)
        for number, (pose_line, pose) in enumerate(tracklet.poses, int(first)):
            if _number(path, pose_line, pose, "truncation", 0.0) in NOT_IN_IMAGE:
                continue
            truth = Truth(label, _box(path, pose_line, pose, size_m, angles), track_id)
            frames.setdefault(number, []).append(truth)
    angles.require()
    return frames


def _box(path: Path, line: int, pose: dict[str, str], size_m: np.ndarray, angles: Angles) -> OrientedBox:
    bottom_m = np.array([_number(path, line, pose, name) for name in ("tx", "ty", "tz")])
    tilt = max(abs(_number(path, line, pose, name, 0.0)) for name in ("rx", "ry"))
    if tilt > MOST_TILT_RAD:
        raise FormatError(path, "a pose has rx or ry other than 0; only rz is supported", line)
    turn = Rotation.from_euler("z", angles.radians(_number(path, line, pose, "rz"), path, line))
    center_m = bottom_m + np.array([0.0, 0.0, size_m[2] / 2])
    try:
        return OrientedBox.from_parts(center_m, turn.as_matrix(), size_m)
    except ValueError as error:
        raise FormatError(path, str(error), line) from error


def _number(path: Path, line: int, values: dict[str, str], name: str, missing: float | None = None) -> float:
    text = values.get(name)
    if text is None:
        if missing is None:
            raise FormatError(path, f"{name} is missing", line)
        return missing
    return finite_number(text, path, line, name)


def _objects(path: Path) -> list[tuple[int, _Object]]:
    """Returns the objects with the lines that they begin on."""
    reader = _Reader(path)
    try:
        with open_file(path) as file:
            reader.parser.ParseFile(file)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise FormatError(path, f"is not valid XML, or truncated ({reason})", error.lineno) from error
    except (LookupError, ValueError) as error:
        # expat looks up unknown encodings in Python
        raise FormatError(path, f"declares an encoding that cannot be read ({error}); save it as UTF-8", 1) from error
    if not reader.has_tracklets:
        raise FormatError(path, "is XML, but contains no tracklets")
    return reader.objects


class _Reader:
    """Collects the values while the XML is parsed; the document is never in memory as a whole."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.objects: list[tuple[int, _Object]] = []
        self.has_tracklets = False
        self._open: list[str] = []
        self._text = ""
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._add
        self.parser.StartDoctypeDeclHandler = self._doctype
        self.parser.EntityDeclHandler = self._reject_dtd

    def _doctype(self, name: str, system: str | None, public: str | None, has_content: int) -> None:
        if system or public or has_content:
            self._reject_dtd()

    def _reject_dtd(self, *_: object) -> None:
        raise FormatError(
            self.path, "contains a document type definition (DTD), which is not supported; remove it", self._line
        )

    @property
    def _line(self) -> int:
        return int(self.parser.CurrentLineNumber)

    def _start(self, name: str, _: dict[str, str]) -> None:
        if len(self._open) >= MOST_LEVELS:
            raise FormatError(self.path, f"has elements nested more than {MOST_LEVELS} levels deep", self._line)
        self._open.append(name)
        self._text = ""
        place = tuple(self._open)
        self.has_tracklets |= place == OBJECT[:2]
        if place == OBJECT:
            self.objects.append((self._line, _Object()))
        elif place == POSE:
            self.objects[-1][1].poses.append((self._line, {}))

    def _add(self, text: str) -> None:
        # white space between elements is not part of a value
        self._text += text if self._text else text.lstrip()
        if len(self._text) > LONGEST_VALUE:
            raise FormatError(self.path, f"has a value of more than {LONGEST_VALUE} characters", self._line)

    def _end(self, name: str) -> None:
        self._open.pop()
        place = tuple(self._open)
        if place == OBJECT:
            self.objects[-1][1].values[name] = self._text
        elif place == POSE:
            self.objects[-1][1].poses[-1][1][name] = self._text
        self._text = ""
