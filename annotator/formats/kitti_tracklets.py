"""KITTI raw drives' own labels, `tracklet_labels.xml`: each object with its class, its size and a pose a frame.

KITTI raw devkit, `cpp/tracklets.h` (fields, their values) and `matlab/run_demoTracklets.m` (their meaning): poses are
in the LiDAR's frame (x forward, y left, z up), tx ty tz is the middle of the bottom face, rz turns about z, 0 where
the object faces +x; l w h lie along its own x y z. Pose number k is of the drive's frame first_frame + k.

The file is a serialised C++ object, whose line `<!DOCTYPE boost_serialization>` is empty. Nothing else that a document
type may declare (entities above all, which can grow without end) is let in.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.formats.finite import finite_number
from annotator.types import OrientedBox, Truth
from annotator.types.errors import FormatError

OBJECT = ("boost_serialization", "tracklets", "item")
POSE = (*OBJECT, "poses", "item")
# tracklets.h: the object lies outside the image (2) or behind the camera (3) then; nobody has looked at it there.
NOT_IN_IMAGE = (2, 3)
MOST_LEVELS = 20
LONGEST_VALUE = 200
MOST_FRAME = 10_000_000
# Written as 0 throughout; in which order a tilt would turn is not said.
MOST_TILT_RAD = 1e-6


@dataclass
class _Object:
    """One tracklet; `frame` counts its poses."""

    values: dict[str, str] = field(default_factory=dict)
    poses: list[tuple[int, dict[str, str]]] = field(default_factory=list)


def read_tracklets(path: Path) -> dict[int, list[Truth]]:
    """The objects by the drive's frame number, in the order of the file, in the LiDAR's frame.

    A frame without objects has no entry. Track ids count the objects of the file from 0. Poses that say that the object
    is not in the image are left out.

    Raises:
        FormatError: the file is missing, no XML, declares what it may not, or has an object that is none; names the
            line.
    """
    frames: dict[int, list[Truth]] = {}
    for track_id, (line, found) in enumerate(_objects(path)):
        label = found.values.get("objectType", "").strip()
        if not label:
            raise FormatError(path, "an object has no objectType", line)
        size_m = np.array([_number(path, line, found.values, name) for name in ("l", "w", "h")])
        if (size_m <= 0).any():
            raise FormatError(path, f"l w h must be positive, not {' '.join(map(str, size_m))}", line)
        first = _number(path, line, found.values, "first_frame")
        if first != int(first) or not 0 <= first <= MOST_FRAME:
            raise FormatError(path, f"first_frame is no frame's number: {first}", line)
        for number, (pose_line, pose) in enumerate(found.poses, int(first)):
            if _number(path, pose_line, pose, "truncation", 0.0) in NOT_IN_IMAGE:
                continue
            truth = Truth(label, _box(path, pose_line, pose, size_m), track_id)
            frames.setdefault(number, []).append(truth)
    return frames


def _box(path: Path, line: int, pose: dict[str, str], size_m: np.ndarray) -> OrientedBox:
    bottom_m = np.array([_number(path, line, pose, name) for name in ("tx", "ty", "tz")])
    tilt = max(abs(_number(path, line, pose, name, 0.0)) for name in ("rx", "ry"))
    if tilt > MOST_TILT_RAD:
        raise FormatError(path, "a pose has a tilt (rx, ry), which KITTI's tracklets do not have", line)
    turn = Rotation.from_euler("z", _number(path, line, pose, "rz"))
    center_m = bottom_m + np.array([0.0, 0.0, size_m[2] / 2])
    return OrientedBox.from_parts(center_m, turn.as_matrix(), size_m)


def _number(path: Path, line: int, values: dict[str, str], name: str, missing: float | None = None) -> float:
    text = values.get(name)
    if text is None:
        if missing is None:
            raise FormatError(path, f"there is no {name}", line)
        return missing
    return finite_number(text, path, line, name)


def _objects(path: Path) -> list[tuple[int, _Object]]:
    """The objects with the lines that they begin on."""
    reader = _Reader(path)
    try:
        with path.open("rb") as file:
            reader.parser.ParseFile(file)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise FormatError(path, f"is no XML, or cut off ({reason})", error.lineno) from error
    if not reader.is_ours:
        raise FormatError(path, "is XML, but has no tracklets in it")
    return reader.objects


class _Reader:
    """Takes the values out of the XML as it goes by; the document is never held as a whole."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.objects: list[tuple[int, _Object]] = []
        self.is_ours = False
        self._open: list[str] = []
        self._text = ""
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._add
        self.parser.StartDoctypeDeclHandler = self._doctype
        self.parser.EntityDeclHandler = self._refuse

    def _doctype(self, name: str, system: str | None, public: str | None, has_content: int) -> None:
        if system or public or has_content:
            self._refuse()

    def _refuse(self, *_: object) -> None:
        raise FormatError(self.path, "declares things of its own (a DTD), which is not read", self._line)

    @property
    def _line(self) -> int:
        return int(self.parser.CurrentLineNumber)

    def _start(self, name: str, _: dict[str, str]) -> None:
        if len(self._open) >= MOST_LEVELS:
            raise FormatError(self.path, f"has elements more than {MOST_LEVELS} deep", self._line)
        self._open.append(name)
        self._text = ""
        place = tuple(self._open)
        self.is_ours |= place == OBJECT[:2]
        if place == OBJECT:
            self.objects.append((self._line, _Object()))
        elif place == POSE:
            self.objects[-1][1].poses.append((self._line, {}))

    def _add(self, text: str) -> None:
        # the white space between elements is none of a value, however long
        self._text += text if self._text else text.lstrip()
        if len(self._text) > LONGEST_VALUE:
            raise FormatError(self.path, f"has a value of more than {LONGEST_VALUE} letters", self._line)

    def _end(self, name: str) -> None:
        self._open.pop()
        place = tuple(self._open)
        if place == OBJECT:
            self.objects[-1][1].values[name] = self._text
        elif place == POSE:
            self.objects[-1][1].poses[-1][1][name] = self._text
        self._text = ""
