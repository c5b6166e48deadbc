"""Shared by the label readers: faults, finite numbers, images, the text files of a folder or a zip archive, and JSON.

JSON files are read into pydantic models, or pair by pair if they are large.
"""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath, PurePosixPath
from typing import Annotated, Never, TypeVar

import numpy as np
from jaxtyping import UInt8
from pydantic import BaseModel, Field, ValidationError

from annotator.files import ARCHIVE_ERRORS, DOCUMENT_BYTES, check_file, open_archive, open_file, read_file, write_atomic
from annotator.frame_limits import read_frame_file
from annotator.image_bytes import decode_image, read_image
from annotator.text import SHOWN, decoded, normal, to_number
from annotator.types import BoxKind
from annotator.types.bases import FileRecord
from annotator.types.errors import FormatError
from annotator.types.label import MOST_TRACK
from annotator.types.messages import amount, first_problem

OnFault = Callable[[FormatError], None]
"""Called with each fault. If it returns, the faulty entry is skipped and reading continues."""


def raise_fault(fault: FormatError) -> None:
    """Stops reading by raising the fault."""
    raise fault


def known_kind(value: object) -> BoxKind | None:
    """Returns what 2D boxes enclose, as annotator writes it; None for anything else, since other tools do not."""
    return next((kind for kind in BoxKind if kind.value == value), None)


def finite_number(text: str, path: Path, line: int | None, name: str = "") -> float:
    """Returns a text as a finite number.

    Args:
        name: the field's name, for the error message.
    """
    where = f"{name}: " if name else ""
    try:
        value = to_number(text)
    except ValueError as error:
        raise FormatError(path, f"{where}{error}", line) from None
    if not math.isfinite(value):
        raise FormatError(path, f"{where}{text[:SHOWN]!r} is not a finite number", line)
    return value


def read_picture(file: Path) -> tuple[bytes, UInt8[np.ndarray, "h w 3"]]:
    """Returns the bytes of an image file and its pixels: BGR order, rotated according to the EXIF tag."""
    import cv2

    try:
        content = read_frame_file(file)
        return content, decode_image(content, cv2.IMREAD_COLOR)
    except OSError as error:
        raise FormatError(
            file, f"the image cannot be read ({error.strerror}); restore it, or remove its labels"
        ) from error
    except ValueError as error:
        raise FormatError(file, f"is not a readable image: {error}; restore it, or remove its labels") from error


SUFFIX = ".txt"


def text_files(path: Path, within: str | None = None) -> Iterator[tuple[str, Path, str]]:
    """Yields key (the `normal` name without suffix), path and content of each text file, sorted by name.

    In an archive, the folders of the files are ignored. Files with another suffix and hidden files are skipped: macOS
    adds `._KEY.txt` for each file that it packs.

    Args:
        path: the folder or the archive.
        within: a folder name; if an archive has matching files in a folder of this name, only those are read.
    """
    if path.is_dir():
        yield from _of_folder(path)
    elif path.is_file() and _is_archive(path):
        yield from _of_archive(path, within)
    elif path.exists():
        raise FormatError(path, f"is neither a folder of *{SUFFIX} files nor a zip archive of one")
    else:
        raise FormatError(path, "there is no such folder or zip archive")


def _of_folder(path: Path) -> Iterator[tuple[str, Path, str]]:
    try:
        files = sorted(file for file in path.iterdir() if _is_wanted(file))
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    if not files:
        raise FormatError(path, f"has no {SUFFIX} files; give the folder that contains them")
    seen = set[str]()
    for file in files:
        if (key := normal(file.stem)) in seen:
            raise _twice(path, file.name)
        seen.add(key)
        yield key, file, read_text(file)


def _twice(path: Path, name: str) -> FormatError:
    return FormatError(path, f"has two files called {name}; keep one")


def _is_wanted(file: PurePath) -> bool:
    return file.suffix == SUFFIX and not file.name.startswith(".")


def read_text(file: Path) -> str:
    """Returns the content of a text file."""
    try:
        content = read_file(file)
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror})") from error
    return _text(file, content)


def text_rows(file: Path, text: str | None = None) -> list[tuple[int, list[str]]]:
    """Returns the words of each non-blank line of a text file, or of `text`, with its 1-based line number."""
    text = read_text(file) if text is None else text
    return [(line, row.split()) for line, row in enumerate(text.splitlines(), 1) if row.strip()]


def _of_archive(path: Path, within: str | None) -> Iterator[tuple[str, Path, str]]:
    try:
        with open_file(path) as file, open_archive(file) as archive:
            named: dict[str, zipfile.ZipInfo] = {}
            for info in _wanted(archive, within):
                name = PurePosixPath(info.filename)
                if normal(name.stem) in named:
                    raise _twice(path, name.name)
                named[normal(name.stem)] = info
            if not named:
                raise FormatError(path, f"has no {SUFFIX} files")
            for key in sorted(named):
                with archive.open(named[key]) as stream:
                    # the size that an archive declares may be wrong
                    content = stream.read(DOCUMENT_BYTES + 1)
                member = path / PurePosixPath(named[key].filename).name
                yield key, member, _text(member, content)
    except ARCHIVE_ERRORS as error:
        raise FormatError(path, f"the archive cannot be read ({error})") from error


def holds_texts(path: Path) -> bool:
    """True for a folder with text files or one that cannot be listed, and for any zip archive."""
    if not path.is_dir():
        return path.is_file() and _is_archive(path)
    try:
        return any(_is_wanted(file) for file in path.iterdir())
    except OSError:
        return True  # its reader says what is wrong


def _is_archive(path: Path) -> bool:
    with suppress(OSError):
        check_file(path)
        return zipfile.is_zipfile(path)
    return False


def _wanted(archive: zipfile.ZipFile, within: str | None) -> list[zipfile.ZipInfo]:
    matching = [info for info in archive.infolist() if not info.is_dir() and _is_wanted(PurePosixPath(info.filename))]
    return [info for info in matching if PurePosixPath(info.filename).parent.name == within] or matching


def _text(file: Path, content: bytes) -> str:
    if len(content) > DOCUMENT_BYTES:
        raise FormatError(file, f"is longer than {DOCUMENT_BYTES // 2**20} MiB; a label file of one frame is smaller")
    try:
        return decoded(content)
    except UnicodeDecodeError as error:
        raise FormatError(file, f"is {error}") from error


SINGLE_OBJECT = 255


def read_mask(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Returns object numbers from 1, in the order of the frame's boxes; 0 is the background.

    A mask of one object may also be stored as 0 and 255; it is returned as 0 and 1.
    """
    import cv2

    try:
        mask = read_image(path, cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise FormatError(path, f"the mask cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise FormatError(path, f"is not a valid mask: {error}; write it again") from error
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise FormatError(path, "a mask must be an 8-bit image with one channel of object numbers")
    if np.isin(mask, (0, SINGLE_OBJECT)).all():
        return (mask == SINGLE_OBJECT).astype(np.uint8)
    return np.asarray(mask)


# The largest label file in common use, COCO's training labels, takes 450 MB.
MAX_BYTES = 2**30
SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")

Model = TypeVar("Model", bound=BaseModel)


PairsHook = Callable[[list[tuple[str, object]]], object]


def unique_keys(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Builds a dict from a JSON object's pairs.

    Raises KeyError for a repeated key; `json` itself would silently keep only the last value.
    """
    content: dict[str, object] = {}
    for key, value in pairs:
        if key in content:
            raise KeyError(key)
        content[key] = value
    return content


def read_model(path: Path, model: type[Model], pairs_hook: PairsHook | None = None) -> Model:
    """Returns the validated content of a JSON file.

    Args:
        pairs_hook: as in `read_json`.
    """
    content = read_json(path, pairs_hook)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FormatError(path, first_problem(error) + _more(error)) from error


def read_json(path: Path, pairs_hook: PairsHook | None = None) -> object:
    """Returns the content of a JSON file.

    Args:
        pairs_hook: builds an object from its pairs, such as `unique_keys`; a KeyError from it names a repeated key.
    """
    data = _read(path)
    with json_faults(path):
        text = decoded(data)
        content: object = json.loads(text, object_pairs_hook=pairs_hook)
    require_encodable(path, text, content)
    return content


def _read(path: Path) -> bytes:
    try:
        return read_file(path, MAX_BYTES)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error


@contextmanager
def json_faults(path: Path) -> Iterator[None]:
    """Converts the errors of parsing JSON into FormatErrors; a KeyError names a key that occurs twice."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise FormatError(path, f"is {error}") from error
    except json.JSONDecodeError as error:
        raise FormatError(path, f"is not valid JSON: {error.msg} (column {error.colno})", error.lineno) from error
    except RecursionError as error:
        raise FormatError(path, "is nested too deeply to be a label file") from error
    except KeyError as error:
        raise FormatError(path, f"the key {error} occurs twice; keep one of them") from error
    except ValueError as error:
        # an integer of thousands of digits
        raise FormatError(path, f"has a number that cannot be read ({error})") from error


def require_encodable(path: Path, text: str, content: object) -> None:
    r"""Rejects unpaired surrogates (`\ud800`): valid JSON escapes, but they cannot be encoded as UTF-8.

    Args:
        text: the JSON of `content`.
    """
    if SURROGATE.search(text) is None:
        return
    try:
        json.dumps(content, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise FormatError(
            path, f"has an unpaired surrogate ({error.object[error.start]!a}); write the whole character"
        ) from error


def _more(error: ValidationError) -> str:
    more = error.error_count() - 1
    return f" (and {amount(more, 'more problem')})" if more else ""


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
# Track ids; `Exact` is for formats that store every number as a float.
BoundedTrack = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]
Exact = Annotated[float, Field(ge=-MOST_TRACK, le=MOST_TRACK, allow_inf_nan=False)]


class Axes(FileRecord):
    """One value per axis: metres, or angles."""

    x: Bounded
    y: Bounded
    z: Bounded


Bounded3 = tuple[Bounded, Bounded, Bounded]
Bounded4 = tuple[Bounded, Bounded, Bounded, Bounded]


BLANKS = re.compile(r"[ \t\r\n]*+")


def read_pairs(path: Path, inside: str | None = None) -> Iterator[tuple[str, object]]:
    """Yields the pairs of the object in a file, in its order, each key once; they are parsed one by one.

    Args:
        inside: the key of the object's pair whose own pairs are wanted, instead of the object's.
    """
    data = _read(path)
    with json_faults(path):
        text = _Text(path, decoded(data))
        del data
        keys, found = text.each_key(), inside is None
        for key in keys:
            if inside is None:
                yield key, text.value()
            elif key == inside:
                found = True
                yield from ((name, text.value()) for name in text.each_key())
            else:
                text.value()
        if text.next():
            text.fail("has something after the end of its object")
        if not found:
            raise FormatError(path, f"has no key {inside!r}")


class _Text:
    """The text of a file, and a place in it."""

    def __init__(self, path: Path, text: str) -> None:
        self._path, self._text, self._at = path, text, 0
        self._json = json.JSONDecoder(object_pairs_hook=unique_keys)

    def each_key(self) -> Iterator[str]:
        """Yields the keys of the object that begins here; each key's value must be read before the next one."""
        if self.next() != "{":
            self.fail("must be a JSON object with one entry per frame")
        self._at += 1
        known, end = set[str](), self.next()
        if end == "}":
            self._at += 1
        while end != "}":
            if self.next() != '"':
                self.fail("is not valid JSON: a key in double quotes is missing")
            key = str(self.value())
            if key in known:
                raise KeyError(key)
            known.add(key)
            self._take(":")
            yield key
            end = self._take(",}")

    def value(self) -> object:
        """Reads the value that begins here."""
        self.next()
        value, end = self._json.raw_decode(self._text, self._at)
        require_encodable(self._path, self._text[self._at : end], value)
        self._at = end
        return value

    def next(self) -> str:
        """Goes to the next character that is not blank, and returns it; "" at the end of the file."""
        match = BLANKS.match(self._text, self._at)
        assert match is not None  # it may be empty
        self._at = match.end()
        return self._text[self._at : self._at + 1]

    def _take(self, characters: str) -> str:
        found = self.next()
        if not found or found not in characters:
            self.fail(f"is not valid JSON: Expecting {' or '.join(map(repr, characters))}")
        self._at += 1
        return found

    def fail(self, reason: str) -> Never:
        """Raises FormatError for what is here."""
        raise FormatError(self._path, reason, 1 + self._text.count("\n", 0, self._at))
