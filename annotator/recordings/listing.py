"""Frame names from folders: files that belong together share their stem."""

from __future__ import annotations

import re
from pathlib import Path

from annotator.types.errors import FrameError, RecordingError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def stems(folder: Path, suffixes: tuple[str, ...]) -> set[str]:
    """The stems of all files in `folder` with one of `suffixes` (lower case; files may have upper case)."""
    return {
        entry.stem
        for entry in folder.iterdir()
        if entry.suffix.lower() in suffixes and not entry.name.startswith(".") and entry.is_file()
    }


def sorted_keys(path: Path, keys: set[str], wanted: str) -> tuple[str, ...]:
    """The keys in natural order ("2" before "10").

    Raises:
        RecordingError: there is none; `wanted` says what was expected in `path`.
    """
    if not keys:
        raise RecordingError(f"{path}: no frames; expected {wanted}")
    return tuple(sorted(keys, key=lambda key: (_natural(key), key)))


def _natural(key: str) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", key)
    return [(int(part), "") if part.isdigit() and part.isascii() else (-1, part) for part in parts]


def frame_file(folder: Path, key: str, suffixes: tuple[str, ...], partner: str) -> Path:
    """The one file of frame `key` in `folder`.

    Raises:
        FrameError: there is none, or more than one; `partner` names what it should be paired with.
    """
    candidates = [folder / (key + suffix) for lower in suffixes for suffix in (lower, lower.upper())]
    # a case-insensitive file system answers for both spellings of one file
    found = {path.stat().st_ino: path for path in reversed(candidates) if path.is_file()}
    if not found:
        names = " or ".join(key + suffix for suffix in suffixes)
        raise FrameError(folder / (key + suffixes[0]), "missing", f"put {names} beside {partner}, or remove the frame")
    if len(found) > 1:
        names = ", ".join(sorted(path.name for path in found.values()))
        raise FrameError(folder / (key + suffixes[0]), f"ambiguous, the folder holds {names}", "keep one of them")
    return next(iter(found.values()))
