"""Frame names from folders: files that belong together share their stem."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from annotator.types.errors import FrameError, RecordingError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
NUMBER = re.compile("[0-9]+")

REMEDIES = {
    errno.ENAMETOOLONG: "give a shorter path",
    errno.EACCES: "allow this user to read it, or give another path",
    errno.EPERM: "allow this user to read it, or give another path",
}


@contextmanager
def looking_at(path: Path) -> Iterator[None]:
    """What the system refuses while `path` is looked at becomes an error for the user.

    Raises:
        RecordingError: it refused.
    """
    try:
        yield
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "check the path and its disk")
        raise RecordingError(
            f"{error.filename or path}: cannot be read: {error.strerror or error}; {remedy}"
        ) from error


def stems(folder: Path, suffixes: tuple[str, ...]) -> set[str]:
    """The stems of all files in `folder` with one of `suffixes` (lower case; files may have upper case).

    Raises:
        RecordingError: the folder cannot be read.
    """
    # a data set has ten thousand frames: what the folder itself says of its files is not asked of each
    with looking_at(folder), os.scandir(folder) as entries:
        files = (entry.name for entry in entries if entry.name[0] != "." and entry.is_file())
        named = map(os.path.splitext, files)
        return {stem for stem, suffix in named if suffix.lower() in suffixes}


def sorted_keys(path: Path, keys: set[str], wanted: str) -> tuple[str, ...]:
    """The keys in natural order ("2" before "10").

    Raises:
        RecordingError: there is none; `wanted` says what was expected in `path`.
    """
    if not keys:
        raise RecordingError(f"{path}: no frames; expected {wanted}")
    return tuple(sorted(sorted(keys), key=_natural))


def _natural(key: str) -> str:
    """Sorts by its numbers: each is led by how long it is without zeros, behind what is less than any letter."""
    return NUMBER.sub(_measured, key)


def _measured(number: re.Match[str]) -> str:
    digits = number[0].lstrip("0")
    return f"\0{chr(len(digits))}{digits}"


def frame_file(folder: Path, key: str, suffixes: tuple[str, ...], partner: str) -> Path:
    """The one file of frame `key` in `folder`.

    Raises:
        FrameError: there is none, or more than one, or the folder cannot be read; `partner` names what it should be
            paired with.
    """
    candidates = [folder / (key + suffix) for lower in suffixes for suffix in (lower, lower.upper())]
    # a case-insensitive file system answers for both spellings of one file
    try:
        found = {path.stat().st_ino: path for path in reversed(candidates) if path.is_file()}
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "check the path and its disk")
        raise FrameError(folder / (key + suffixes[0]), f"cannot be read: {error.strerror or error}", remedy) from error
    if not found:
        names = " or ".join(key + suffix for suffix in suffixes)
        raise FrameError(folder / (key + suffixes[0]), "missing", f"put {names} beside {partner}, or remove the frame")
    if len(found) > 1:
        names = ", ".join(sorted(path.name for path in found.values()))
        raise FrameError(folder / (key + suffixes[0]), f"ambiguous, the folder holds {names}", "keep one of them")
    return next(iter(found.values()))
