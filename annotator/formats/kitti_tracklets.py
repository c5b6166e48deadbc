"""Labels of KITTI raw drives, `tracklet_labels.xml`: each object with its class, its size and one pose per frame.

KITTI raw devkit, `cpp/tracklets.h` (fields, their values) and `matlab/run_demoTracklets.m` (their meaning): poses are
in the LiDAR's frame (x forward, y left, z up), tx ty tz is the middle of the bottom face, rz turns about z, 0 if the
object faces +x; l w h are the sizes along its own x y z. Pose number k belongs to frame first_frame + k of the drive.

The file is a serialised C++ object, which defines no entities. Those of other files are refused: they may expand to
gigabytes, and long chains of them crash expat before version 2.7.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.files import TABLE_BYTES, read_file
from annotator.formats.reading import Angles, faults, finite_number
from annotator.types import OrientedBox, Truth
from annotator.types.errors import FormatError

# tracklets.h: the object is outside the image (2) or behind the camera (3), where it was not labelled.
NOT_IN_IMAGE = (2, 3)
# KITTI writes rx = ry = 0; the order of rotations for other values is not documented.
MOST_TILT_RAD = 1e-6


def read_tracklets(path: Path) -> dict[int, list[Truth]]:
    """Returns the objects by the drive's frame number, in file order, in the LiDAR's frame.

    A frame without objects has no entry. Track ids count the objects of the file from 0. Poses outside the image
    (`truncation`) are left out.
    """
    frames: dict[int, list[Truth]] = {}
    angles = Angles()
    for track_id, tracklet in enumerate(_tracklets(path)):
        where, values = f"object {track_id}", _values(tracklet)
        label = values.get("objectType", "").strip()
        if not label:
            raise FormatError(path, f"{where} has no objectType")
        size_m = np.array([_number(path, where, values, name) for name in ("l", "w", "h")])
        if (size_m <= 0).any():
            raise FormatError(path, f"{where}: l w h must be positive, not {' '.join(map(str, size_m))}")
        first = _number(path, where, values, "first_frame")
        if first != int(first) or first < 0:
            raise FormatError(path, f"{where}: first_frame must be a whole number, not {first}")
        for place, pose in enumerate(map(_values, tracklet.iterfind("poses/item"))):
            at = f"{where}, pose {place}"
            if _number(path, at, pose, "truncation", 0.0) not in NOT_IN_IMAGE:
                box = _box(path, at, pose, size_m, angles)
                frames.setdefault(int(first) + place, []).append(Truth(label, box, track_id))
    angles.require()
    return frames


def _tracklets(path: Path) -> list[Element]:
    try:
        tracklets = _root(path, read_file(path, TABLE_BYTES)).find("tracklets")
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise FormatError(path, f"is not valid XML, or truncated ({reason})", error.lineno) from error
    except (LookupError, ValueError) as error:
        # expat looks up unknown encodings in Python
        raise FormatError(path, f"declares an encoding that cannot be read ({error}); save it as UTF-8", 1) from error
    if tracklets is None:
        raise FormatError(path, "is XML, but contains no tracklets")
    return tracklets.findall("item")


def _root(path: Path, data: bytes) -> Element:
    parser, tree = expat.ParserCreate(), TreeBuilder()

    def refuse(*_: object) -> None:
        raise FormatError(path, "defines entities (<!ENTITY), which tracklets have none of", parser.CurrentLineNumber)

    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = tree.start, tree.end
    parser.CharacterDataHandler, parser.EntityDeclHandler = tree.data, refuse
    parser.Parse(data, True)
    return tree.close()


def _values(item: Element) -> dict[str, str]:
    return {child.tag: child.text or "" for child in item}


def _box(path: Path, where: str, pose: dict[str, str], size_m: np.ndarray, angles: Angles) -> OrientedBox:
    tx, ty, tz, rz = (_number(path, where, pose, name) for name in ("tx", "ty", "tz", "rz"))
    tilt = max(abs(_number(path, where, pose, name, 0.0)) for name in ("rx", "ry"))
    if tilt > MOST_TILT_RAD:
        raise FormatError(path, f"{where} has rx or ry other than 0; only rz is supported")
    turn = Rotation.from_euler("z", angles.radians(rz, path))
    with faults(path, f"{where}: "):
        return OrientedBox.from_parts(np.array([tx, ty, tz + size_m[2] / 2]), turn.as_matrix(), size_m)


def _number(path: Path, where: str, values: dict[str, str], name: str, missing: float | None = None) -> float:
    text = values.get(name)
    if text is None and missing is not None:
        return missing
    if text is None:
        raise FormatError(path, f"{where}: {name} is missing")
    return finite_number(text, path, None, f"{where}: {name}")
