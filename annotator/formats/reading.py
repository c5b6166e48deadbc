"""Shared by the label readers: numbers and their units, images, the text files of a folder or a zip archive, and JSON.

Programs write degrees where a format has radians, millimetres where it has metres. One box seldom shows that, but all
boxes of a set together do. So a reader hands over the numbers of all boxes that belong together, and a set that cannot
be right is refused. What can be right is read: a format's unit is doubted only where its numbers contradict it.
"""

from __future__ import annotations

import json
import math
import re
import zipfile
from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path, PurePath, PurePosixPath
from typing import Annotated, TypeVar

import numpy as np
from jaxtyping import Float64, UInt8
from pydantic import BaseModel, Field, ValidationError
from scipy.spatial.transform import Rotation

from annotator.files import ARCHIVE_ERRORS, DOCUMENT_BYTES, check_file, open_archive, open_file, read_file, write_atomic
from annotator.frame_limits import read_frame_file
from annotator.image_bytes import decode_image, read_image
from annotator.text import SHOWN, NotTextError, decoded, normal, to_number
from annotator.types import BoxKind
from annotator.types.bases import FileRecord
from annotator.types.errors import FormatError, UnitError, UnitKind
from annotator.types.label import MOST_TRACK
from annotator.types.messages import amount, first_problem

# Programs write angles in radians that they have not normalised: OpenPCDet's KITTI results have rotation_y down to
# -2.75 pi. Those of a set in degrees nearly always have a larger one. Files round to two decimals.
MOST_RAD = 3 * math.pi + 0.01
BEYOND = "beyond 3 pi"
# Limits of the median of the boxes' longest sides, metres. Few objects of a scene are longer than the first one, as
# ships are; none is longer than the second one, or shorter than the third.
LONG_M, LONGEST_M, SHORTEST_M = 100.0, 1000.0, 0.005


class AngleUnit(StrEnum):
    """Units of angles."""

    RADIANS = "radians"
    DEGREES = "degrees"


class Angles:
    """The angles of a set of boxes in a format that has radians; each passes through `radians` while it is read.

    Args:
        given: the unit that the operator has stated; then nothing is doubted.
    """

    def __init__(self, given: AngleUnit | None = None) -> None:
        self._given = given
        self._count = self._beyond = 0
        self._worst: tuple[float, Path, int | None] | None = None

    def radians(self, value: float, file: Path, line: int | None = None) -> float:
        """Returns an angle of a file in radians."""
        if self._given is AngleUnit.DEGREES:
            return math.radians(value)
        self._count += value != 0
        if abs(value) > MOST_RAD:
            self._beyond += 1
            if self._worst is None or abs(value) > abs(self._worst[0]):
                self._worst = (value, file, line)
        return value

    def require(self) -> None:
        """Raises UnitError if something shows that they are not in radians; it names the place of the largest one."""
        if self._worst is None or self._given is not None:
            return
        value, file, line = self._worst
        problem = (
            f"{value:g} is no angle in radians, which this format has ({self._beyond} of "
            f"{amount(self._count, 'angle')} other than 0 {BEYOND}); write radians (`annotator import` converts "
            f"degrees with --angles {AngleUnit.DEGREES}, and reads the angles as they are with --angles "
            f"{AngleUnit.RADIANS})"
        )
        raise UnitError(UnitKind.ANGLE, file, problem, line)


class Lengths:
    """The sizes of a set of boxes, in a format that has metres."""

    def __init__(self, sizes_m: Iterable[Float64[np.ndarray, "3"]] = ()) -> None:
        self._longest = array("d", (float(max(size_m)) for size_m in sizes_m))

    def add(self, size_m: Float64[np.ndarray, "3"]) -> None:
        """Adds the size of a box."""
        self._longest.append(float(max(size_m)))

    def problem(self) -> str | None:
        """Returns what shows that the sizes are hardly in metres; None if nothing does."""
        longest, median = np.array(self._longest), self._median_m
        if SHORTEST_M <= median <= LONG_M:
            return None
        off = (longest > LONG_M) if median > LONG_M else (longest < SHORTEST_M)
        boxes = f"{off.sum()} of {amount(len(longest), 'box')} {'is' if off.sum() == 1 else 'are'}"
        if median > LONG_M:
            unit = "millimetres" if median > LONGEST_M else "millimetres or centimetres"
            what = f"longer than {LONG_M:g} m (the median is {median:g} m), so they look like {unit}"
        else:
            what = f"shorter than {1000 * SHORTEST_M:g} mm (the median is {median:g} m), so they look like kilometres"
        return f"{boxes} {what}; write centres and sizes in metres"

    @property
    def _median_m(self) -> float:
        return float(np.median(self._longest)) if self._longest else 1.0

    def require(self, path: Path) -> None:
        """Raises UnitError if the sizes cannot be in metres."""
        if not SHORTEST_M <= self._median_m <= LONGEST_M and (problem := self.problem()) is not None:
            raise UnitError(UnitKind.LENGTH, path, problem)


# Tolerance for R^T R = identity, since matrices in files are rounded.
MOST_OFF_ROTATION = 1e-2


def rotation_problem(R: Float64[np.ndarray, "3 3"], most_off: float = MOST_OFF_ROTATION) -> str | None:
    """Returns why a matrix of a file is no rotation; None if it is one."""
    if not np.abs(R.T @ R - np.eye(3)).max() <= most_off:
        return "is not a rotation (its columns must have length 1 and be at right angles)"
    if np.linalg.det(R) < 0:
        return "has left-handed axes (it mirrors: its determinant is -1), and annotator's are right-handed; negate one"
    return None


def angles_xyz(R: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3"]:
    """Returns the angles x, y, z of R = Rx Ry Rz, radians in [-pi, pi].

    If the z axis that it turns lies along x (gimbal lock), only the sum or difference of x and z is determined. y and z
    are computed from the rotation that remains after x, so that all three together are exact.
    """
    x = np.arctan2(-R[1, 2], R[2, 2])
    rest = Rotation.from_rotvec([-x, 0.0, 0.0]).as_matrix() @ R
    return np.array([x, np.arctan2(rest[0, 2], rest[2, 2]), np.arctan2(rest[1, 0], rest[1, 1])])


OnFault = Callable[[FormatError], None]
"""Called with each fault. If it returns, the faulty entry is skipped and reading continues."""


def raise_fault(fault: FormatError) -> None:
    """Stops reading by raising the fault."""
    raise fault


@contextmanager
def reported(on_fault: OnFault) -> Iterator[None]:
    """Tells `on_fault` of a FormatError within the block, the rest of which is skipped."""
    try:
        yield
    except FormatError as fault:
        on_fault(fault)


@contextmanager
def faults(path: Path, what: str = "", line: int | None = None, remedy: str = "") -> Iterator[None]:
    """Turns what is wrong with a file (OSError, ValueError) into a FormatError that names it.

    Args:
        what: begins the message, such as "row 3: ".
        remedy: ends it.
    """
    try:
        yield
    except OSError as error:
        raise FormatError(path, f"{what}cannot be read ({error.strerror}){remedy}", line) from error
    except ValidationError as error:
        place = what.removesuffix(": ")
        raise FormatError(path, first_problem(error, *([place] if place else [])) + remedy, line) from error
    except NotTextError as error:
        raise FormatError(path, f"is {error}") from error
    except UnicodeDecodeError as error:
        raise FormatError(path, "is not UTF-8 text; save it as UTF-8") from error
    except ValueError as error:
        raise FormatError(path, f"{what}{error}{remedy}", line) from error


def known_kind(value: object) -> BoxKind | None:
    """Returns what 2D boxes enclose, as annotator writes it; None for anything else, since other tools do not."""
    return next((kind for kind in BoxKind if kind.value == value), None)


def finite_number(text: str, path: Path, line: int | None, name: str = "") -> float:
    """Returns a text as a finite number.

    Args:
        name: the field's name, for the error message.
    """
    where = f"{name}: " if name else ""
    try:  # of every number of a file, so without the time of `faults`
        value = to_number(text)
    except ValueError as error:
        raise FormatError(path, f"{where}{error}", line) from None
    if not math.isfinite(value):
        raise FormatError(path, f"{where}{text[:SHOWN]!r} is not a finite number", line)
    return value


def read_picture(file: Path) -> tuple[bytes, UInt8[np.ndarray, "h w 3"]]:
    """Returns the bytes of an image file and its pixels: BGR order, rotated according to the EXIF tag."""
    import cv2

    with faults(file, remedy="; restore it, or remove its labels"):
        content = read_frame_file(file)
        return content, decode_image(content, cv2.IMREAD_COLOR)


SUFFIX = ".txt"


def text_files(path: Path, *within: str) -> Iterator[tuple[str, Path, str]]:
    """Yields key (the `normal` name without suffix), path and content of each text file, sorted by name.

    In an archive, the folders of the files are ignored. Files with another suffix and hidden files are skipped: macOS
    adds `._KEY.txt` for each file that it packs.

    Args:
        path: the folder or the archive.
        within: folder names; if an archive has matching files in such folders, only those are read.
    """
    if path.is_dir():
        with faults(path):
            files = [file for file in path.iterdir() if _is_wanted(file)]
        for key, file in _by_key(path, files, "; give the folder that contains them"):
            yield key, file, read_text(file)
    elif _is_archive(path):
        try:
            with open_file(path) as opened, open_archive(opened) as archive:
                # an archive may have several files of one name
                every = [(PurePosixPath(each), each) for each in archive.namelist() if not each.endswith("/")]
                names, members = dict(every), [member for member, _ in every if _is_wanted(member)]
                for key, member in _by_key(path, [each for each in members if each.parent.name in within] or members):
                    with archive.open(names[member]) as stream:
                        # the size that an archive declares may be wrong
                        yield key, path / member.name, _text(path / member.name, stream.read(DOCUMENT_BYTES + 1))
        except ARCHIVE_ERRORS as error:
            raise FormatError(path, f"the archive cannot be read ({error})") from error
    elif path.exists():
        raise FormatError(path, f"is neither a folder of *{SUFFIX} files nor a zip archive of one")
    else:
        raise FormatError(path, "there is no such folder or zip archive")


PathKind = TypeVar("PathKind", bound=PurePath)


def _by_key(path: Path, files: Iterable[PathKind], advice: str = "") -> list[tuple[str, PathKind]]:
    """Returns files with their keys, sorted."""
    found: dict[str, PathKind] = {}
    for file in sorted(files):
        if normal(file.stem) in found:
            raise FormatError(path, f"has two files called {file.name}; keep one")
        found[normal(file.stem)] = file
    if not found:
        raise FormatError(path, f"has no {SUFFIX} files{advice}")
    return list(found.items())


def _is_wanted(file: PurePath) -> bool:
    return file.suffix == SUFFIX and not file.name.startswith(".")


def read_text(file: Path) -> str:
    """Returns the content of a text file."""
    with faults(file):
        return decoded(read_file(file))


def text_rows(file: Path, text: str | None = None) -> list[tuple[int, list[str]]]:
    """Returns the words of each non-blank line of a text file, or of `text`, with its 1-based line number."""
    text = read_text(file) if text is None else text
    return [(line, row.split()) for line, row in enumerate(text.splitlines(), 1) if row.strip()]


def holds_texts(path: Path) -> bool:
    """True for a folder with text files or one that cannot be listed, and for any zip archive."""
    if not path.is_dir():
        return _is_archive(path)
    try:
        return any(_is_wanted(file) for file in path.iterdir())
    except OSError:
        return True  # its reader says what is wrong


def _is_archive(path: Path) -> bool:
    with suppress(OSError):
        check_file(path)
        return path.is_file() and zipfile.is_zipfile(path)
    return False


def _text(file: Path, content: bytes) -> str:
    if len(content) > DOCUMENT_BYTES:
        raise FormatError(file, f"is longer than {DOCUMENT_BYTES // 2**20} MiB; a label file of one frame is smaller")
    with faults(file):
        return decoded(content)


SINGLE_OBJECT = 255


def read_mask(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Returns object numbers from 1, in the order of the frame's boxes; 0 is the background.

    A mask of one object may also be stored as 0 and 255; it is returned as 0 and 1.
    """
    import cv2

    with faults(path, "is not a valid mask: ", remedy="; write it again"):
        mask = read_image(path, cv2.IMREAD_UNCHANGED)
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise FormatError(path, "a mask must be an 8-bit image with one channel of object numbers")
    if np.isin(mask, (0, SINGLE_OBJECT)).all():
        return (mask == SINGLE_OBJECT).astype(np.uint8)
    return np.asarray(mask)


# The largest label file in common use, COCO's training labels, takes 450 MB.
MAX_BYTES = 2**30
SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")

Model = TypeVar("Model", bound=BaseModel)


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        raise KeyError(next(key for place, key in enumerate(keys) if key in keys[:place]))
    return content


def read_model(path: Path, model: type[Model], *, unique: bool = False) -> Model:
    """Returns the validated content of a JSON file; `unique` as in `read_json`."""
    content = read_json(path, unique=unique)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        more = error.error_count() - 1
        others = f" (and {amount(more, 'more problem')})" if more else ""
        raise FormatError(path, first_problem(error) + others) from error


def read_json(path: Path, *, unique: bool = False) -> object:
    """Returns the content of a JSON file.

    Unpaired surrogates (`\\ud800`) are refused: they are valid JSON escapes, but cannot be encoded as UTF-8.

    Args:
        unique: a repeated key is refused, too; `json` itself would silently keep only the last value.
    """
    with faults(path):
        text = decoded(read_file(path, MAX_BYTES))
    try:
        content: object = json.loads(text, object_pairs_hook=_unique if unique else None)
        if SURROGATE.search(text) is not None:
            json.dumps(content, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        shown = f"{error.object[error.start]!a}"
        raise FormatError(path, f"has an unpaired surrogate ({shown}); write the whole character") from error
    except json.JSONDecodeError as error:
        raise FormatError(path, f"is not valid JSON: {error.msg} (column {error.colno})", error.lineno) from error
    except RecursionError as error:
        raise FormatError(path, "is nested too deeply to be a label file") from error
    except KeyError as error:
        raise FormatError(path, f"the key {error} occurs twice; keep one of them") from error
    except ValueError as error:
        # an integer of thousands of digits
        raise FormatError(path, f"has a number that cannot be read ({error})") from error
    return content


def read_object(path: Path) -> dict[str, object]:
    """Returns the object of a JSON file, each key once."""
    content = read_json(path, unique=True)
    if not isinstance(content, dict):
        raise FormatError(path, "must be a JSON object with one entry per frame")
    return content


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically: a reader sees the old file or the new one."""
    try:
        write_atomic(path, text.encode())
    except OSError as error:
        raise FormatError(path, f"cannot be written ({error.strerror})") from error


# Plausibility limit for coordinates and sizes, metres.
MOST = 1e14

Bounded = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
BoundedPositive = Annotated[float, Field(gt=0, le=MOST, allow_inf_nan=False)]
# Of formats that store every number as a float.
Exact = Annotated[float, Field(ge=-MOST_TRACK, le=MOST_TRACK, allow_inf_nan=False)]


class Axes(FileRecord):
    """One value per axis: metres, or angles."""

    x: Bounded
    y: Bounded
    z: Bounded


Bounded3 = tuple[Bounded, Bounded, Bounded]
Bounded4 = tuple[Bounded, Bounded, Bounded, Bounded]
