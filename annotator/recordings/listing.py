"""Lists the frames of folders: files of one frame share their stem."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from annotator.text import normal, spelled
from annotator.types.errors import FrameError, RecordingError
from annotator.types.messages import first_problem

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
NUMBER = re.compile("(?:0(?=[0-9]))*([0-9]+)")

REMEDIES: dict[int | None, str] = {
    errno.ENAMETOOLONG: "give a shorter path",
    errno.EACCES: "allow this user to read it, or give another path",
    errno.EPERM: "allow this user to read it, or give another path",
}


def path_errors(path: Path) -> AbstractContextManager[None]:
    """Converts an OSError while `path` is inspected into a RecordingError."""
    return file_errors(path, "check the path and its disk", kind=RecordingError)


@contextmanager
def file_errors(path: Path, remedy: str, what: str = "", kind: type[RecordingError] = FrameError) -> Iterator[None]:
    """Converts what is wrong with a file (OSError, ValueError) into a FrameError, or a RecordingError, that names it.

    `what` of the file is wrong, such as "frame 7: ".
    """
    try:
        yield
    except (OSError, ValueError) as error:
        problem = f"{what}{error}"
        if isinstance(error, OSError):
            problem, remedy = f"{what}cannot be read ({error.strerror or error})", REMEDIES.get(error.errno, remedy)
        elif isinstance(error, ValidationError):
            problem = what + first_problem(error)
        if kind is FrameError:
            raise FrameError(path, problem, remedy) from error
        # of a folder, it may be a file or folder within
        where = getattr(error, "filename", None) or path
        raise RecordingError(f"{where}: {problem}; {remedy}") from error


def require_size(path: Path, image: np.ndarray, size: tuple[int, int], whose: str, remedy: str) -> None:
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
    expected = folder / (key + suffixes[0])
    with file_errors(expected, "check the path and its disk"):
        files = {path.stat().st_ino: path for path in reversed(candidates) if path.is_file()}
    if not files:
        names = " or ".join(key + suffix for suffix in suffixes)
        raise FrameError(expected, "missing", f"put {names} beside {partner}, or remove the frame")
    if len(files) > 1:
        names = ", ".join(sorted(path.name for path in files.values()))
        raise FrameError(expected, f"ambiguous: the folder has {names}", "keep one of them")
    return next(iter(files.values()))
