"""Shared by the label readers: faults, finite numbers, images, and the text files of a folder or a zip archive."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path, PurePath, PurePosixPath

import numpy as np
from jaxtyping import UInt8

from annotator.files import ARCHIVE_ERRORS, DOCUMENT_BYTES, check_file, open_archive, open_file, read_file
from annotator.frame_limits import read_frame_file
from annotator.image_bytes import decode_image, read_image
from annotator.text import SHOWN, decoded, normal, to_number
from annotator.types import BoxKind
from annotator.types.errors import FormatError

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


MAX_FILES = 1_000_000


def text_files(path: Path, suffix: str = ".txt", within: str | None = None) -> Iterator[tuple[str, Path, str]]:
    """Yields key (the `normal` name without suffix), path and content of each text file, sorted by name.

    In an archive, the folders of the files are ignored. Files with another suffix and hidden files are skipped: macOS
    adds `._KEY.txt` for each file that it packs.

    Args:
        path: the folder or the archive.
        suffix: suffix of the files to read.
        within: a folder name; if an archive has matching files in a folder of this name, only those are read.
    """
    if path.is_dir():
        yield from _of_folder(path, suffix)
    elif path.is_file() and _is_archive(path):
        yield from _of_archive(path, suffix, within)
    elif path.exists():
        raise FormatError(path, f"is neither a folder of *{suffix} files nor a zip archive of one")
    else:
        raise FormatError(path, "there is no such folder or zip archive")


def _of_folder(path: Path, suffix: str) -> Iterator[tuple[str, Path, str]]:
    try:
        files = sorted(file for file in path.iterdir() if _is_wanted(file, suffix))
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    if not files:
        raise FormatError(path, f"has no {suffix} files; give the folder that contains them")
    seen = set[str]()
    for file in files:
        if (key := normal(file.stem)) in seen:
            raise _twice(path, file.name)
        seen.add(key)
        yield key, file, read_text(file)


def _twice(path: Path, name: str) -> FormatError:
    return FormatError(path, f"has two files called {name}; keep one")


def _is_wanted(file: PurePath, suffix: str) -> bool:
    return file.suffix == suffix and not file.name.startswith(".")


def read_text(file: Path) -> str:
    """Returns the content of a text file."""
    try:
        content = read_file(file)
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror})") from error
    return _text(file, content)


def text_rows(file: Path) -> list[tuple[int, list[str]]]:
    """Returns the words of each non-blank line of a text file, with its 1-based line number."""
    return [(line, row.split()) for line, row in enumerate(read_text(file).splitlines(), 1) if row.strip()]


def _of_archive(path: Path, suffix: str, within: str | None) -> Iterator[tuple[str, Path, str]]:
    try:
        with open_file(path) as file, open_archive(file) as archive:
            named: dict[str, zipfile.ZipInfo] = {}
            for info in _wanted(archive, suffix, within):
                name = PurePosixPath(info.filename)
                if normal(name.stem) in named:
                    raise _twice(path, name.name)
                named[normal(name.stem)] = info
            if not named:
                raise FormatError(path, f"has no {suffix} files")
            for key in sorted(named):
                with archive.open(named[key]) as stream:
                    # the size that an archive declares may be wrong
                    content = stream.read(DOCUMENT_BYTES + 1)
                member = path / PurePosixPath(named[key].filename).name
                yield key, member, _text(member, content)
    except ARCHIVE_ERRORS as error:
        raise FormatError(path, f"the archive cannot be read ({error})") from error


def holds_texts(path: Path, suffix: str = ".txt") -> bool:
    """True for a folder with text files or one that cannot be listed, and for any zip archive."""
    if not path.is_dir():
        return path.is_file() and _is_archive(path)
    try:
        return any(_is_wanted(file, suffix) for file in path.iterdir())
    except OSError:
        return True  # its reader says what is wrong


def _is_archive(path: Path) -> bool:
    with suppress(OSError):
        check_file(path)
        return zipfile.is_zipfile(path)
    return False


def _wanted(archive: zipfile.ZipFile, suffix: str, within: str | None) -> list[zipfile.ZipInfo]:
    matching = [
        info
        for info in archive.infolist()[:MAX_FILES]
        if not info.is_dir() and _is_wanted(PurePosixPath(info.filename), suffix)
    ]
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
