"""Lists the frames of folders: files of one frame share their stem."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from annotator.text import normal, spelled
from annotator.types.errors import FrameError, RecordingError
from annotator.types.messages import first_problem

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
NUMBER = re.compile("(?:0(?=[0-9]))*([0-9]+)")

REMEDIES = {
    errno.ENAMETOOLONG: "give a shorter path",
    errno.EACCES: "allow this user to read it, or give another path",
    errno.EPERM: "allow this user to read it, or give another path",
}


@contextmanager
def path_errors(path: Path) -> Iterator[None]:
    """Converts an OSError while `path` is inspected into a RecordingError."""
    try:
        yield
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "check the path and its disk")
        raise RecordingError(
            f"{error.filename or path}: cannot be read: {error.strerror or error}; {remedy}"
        ) from error


@contextmanager
def file_errors(path: Path, remedy: str, what: str = "", kind: type[RecordingError] = FrameError) -> Iterator[None]:
    """Converts what is wrong with a file (OSError, ValueError) into a FrameError, or a RecordingError, that names it.

    Args:
        what: of the file is wrong, such as "frame 7: ".
    """
    try:
        yield
    except (OSError, ValueError) as error:
        problem = f"{what}{error}"
        if isinstance(error, OSError):
            problem = f"{what}cannot be read ({error.strerror or error})"
        elif isinstance(error, ValidationError):
            problem = what + first_problem(error)
        if kind is FrameError:
            raise FrameError(path, problem, remedy) from error
        raise RecordingError(f"{path}: {problem}; {remedy}") from error


def require_size(path: Path, image: np.ndarray, size: tuple[int, int], whose: str, remedy: str) -> None:
    """Requires that an image has a size (width, height), `whose` it is."""
    height, width = image.shape[:2]
    if (width, height) != size:
        raise FrameError(path, f"the image is {width} x {height} pixels, but {whose} {size[0]} x {size[1]}", remedy)


def stems(folder: Path, suffixes: tuple[str, ...]) -> set[str]:
    """Returns the stems of all files in `folder` with one of `suffixes` (given in lower case; any case matches)."""
    # scandir instead of a stat per file: data sets have ten thousand frames
    with path_errors(folder), os.scandir(folder) as entries:
        files = (entry.name for entry in entries if entry.name[0] != "." and entry.is_file())
        named = map(os.path.splitext, files)
        return {stem for stem, suffix in named if suffix.lower() in suffixes}


def joined(names: set[str], *others: set[str]) -> set[str]:
    """Returns the union of names; of one in two Unicode forms, that of the earlier set."""
    for other in others:
        forms = set(map(normal, names))
        names = names | {name for name in other if normal(name) not in forms}
    return names


def sorted_keys(path: Path, keys: set[str], expected: str) -> tuple[str, ...]:
    """Returns the keys in natural order ("2" before "10")."""
    if not keys:
        raise RecordingError(f"{path}: no frames; expected {expected}")
    # each number is replaced by NUL, its length and its digits, without leading zeros
    return tuple(sorted(sorted(keys), key=lambda key: NUMBER.sub(lambda it: f"\0{chr(len(it[1]))}{it[1]}", key)))


def frame_file(folder: Path, key: str, suffixes: tuple[str, ...], partner: str) -> Path:
    """Returns the file of frame `key` in `folder`; `partner` names the file it belongs to, for the message."""
    candidates = [spelled(folder, key + suffix) for lower in suffixes for suffix in (lower, lower.upper())]
    # by inode: on a case-insensitive file system both spellings are the same file
    try:
        files = {path.stat().st_ino: path for path in reversed(candidates) if path.is_file()}
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "check the path and its disk")
        raise FrameError(folder / (key + suffixes[0]), f"cannot be read: {error.strerror or error}", remedy) from error
    if not files:
        names = " or ".join(key + suffix for suffix in suffixes)
        raise FrameError(folder / (key + suffixes[0]), "missing", f"put {names} beside {partner}, or remove the frame")
    if len(files) > 1:
        names = ", ".join(sorted(path.name for path in files.values()))
        raise FrameError(folder / (key + suffixes[0]), f"ambiguous: the folder has {names}", "keep one of them")
    return next(iter(files.values()))
