"""Opens the recording at a path, in any supported format."""

from __future__ import annotations

import shlex
from importlib import import_module
from pathlib import Path
from typing import Any

from annotator.recordings.listing import path_errors
from annotator.recordings.look_around import Scanned, look_around
from annotator.recordings.nearest import (
    Below,
    kind_of_file,
    missing_part,
    nearest_formats,
    recording_above,
    recordings_below,
)
from annotator.recordings.recording import NotFound, ReaderOptions, Recording, option_flag
from annotator.recordings.table import OPTIONS, QUICK_CHECKS, READERS
from annotator.types.errors import ConfigError, UnknownFormatError

# Suffixes of single files that are recordings.
FILE_SUFFIXES = (".mkv", ".r3d", ".bag", ".mcap", ".db3")
MOST_PROBLEMS = 2
NO_OPTIONS = ReaderOptions()


def open_recording(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Opens the recording at `path`; its frames are listed but not read.

    Raises:
        ConfigError: an option that the reader does not take.
        UnknownFormatError: no reader recognises the path.
        RecordingError: the recording has no frames, or the path cannot be read.
    """
    result = _try_readers(path, options)
    if isinstance(result, list):
        with path_errors(path):
            message = _explain(path)
        raise UnknownFormatError(message, tuple(result) if path.exists() else ())
    return result


def detect_format(path: Path) -> str | None:
    """Returns the name of the format at `path`; None if no reader recognises it.

    Raises:
        RecordingError: the recording has no frames, or the path cannot be read.
    """
    for name, target in READERS.items():
        with path_errors(path):
            result = (
                _load(QUICK_CHECKS[name])(path) if name in QUICK_CHECKS else _opened(name, target, path, NO_OPTIONS)
            )
        if result is not False and not isinstance(result, NotFound):
            return name
    return None


def _try_readers(path: Path, options: ReaderOptions) -> Recording | list[str]:
    """Opens `path` with the first reader that recognises it; else returns what each reader looked for."""
    looked_for = []
    # the virtual cameras are those of the LiDAR, and no camera of the recording itself
    own = options.model_copy(update={"look_around": None, "camera": None}) if options.look_around else options
    for name, target in READERS.items():
        with path_errors(path):
            result = _opened(name, target, path, own)
        if not isinstance(result, NotFound):
            _require_taken(path, name, own)
            return look_around(_scanned(path, name, result), options) if options.look_around else result
        looked_for.append(f"{name}: {result.looked_for}")
    return looked_for


def _opened(name: str, target: str, path: Path, options: ReaderOptions) -> Recording | NotFound:
    opened: Recording | NotFound = _load(target)(path, options) if name in OPTIONS else _load(target)(path)
    return opened


def _require_taken(path: Path, name: str, options: ReaderOptions) -> None:
    """
    Raises:
        ConfigError: an option that the reader `name` does not take.
    """
    taken = OPTIONS.get(name, ())
    surplus = [option_flag(option) for option in options.given() if option not in taken]
    if surplus:
        possible = ", ".join(map(option_flag, taken)) or "no options"
        raise ConfigError(f"{path}: is read as {name}, which takes {possible}, not {', '.join(surplus)}")


def _scanned(path: Path, name: str, recording: Recording) -> Scanned:
    """
    Raises:
        ConfigError: the recording has no scans that look all around.
    """
    if not isinstance(recording, Scanned):
        raise ConfigError(
            f"{path}: is read as {name}, without scans of a LiDAR, and takes no {option_flag('look_around')}; scans of "
            "KITTI, nuScenes, Argoverse 2, bags and folders of point clouds do"
        )
    return recording


def _load(target: str) -> Any:
    module, _, function = target.partition(":")
    return getattr(import_module(module), function)


def _explain(path: Path) -> str:
    """Returns in one line what a path lacks, and where recordings are."""
    if not path.exists():
        return f"{path}: {missing_part(path)}; give the path of a recording"
    is_folder = path.is_dir()
    kind = "folder" if is_folder else "file"
    near = nearest_formats(path) if is_folder else kind_of_file(path)
    parts = [f"{path}: no known recording format in this {kind}", *near]
    below = recordings_below(path, detect_format, FILE_SUFFIXES) if is_folder else Below()
    if below.is_partial:
        parts.append("it has many folders, and not all were searched for recordings")
    if below.recordings:
        parts.append("it contains recordings; give the path of one of them: " + ", ".join(below.recordings))
    elif below.problems:
        parts.append("it contains recordings that cannot be opened: " + "; ".join(below.problems[:MOST_PROBLEMS]))
    elif (above := recording_above(path, detect_format)) is not None:
        parts.append(f"it is a part of the recording {above}; give that path")
    elif is_folder and not near and next(path.glob("*.txt"), None) is not None:
        parts.append("it holds text files; if they are labels, give the folder that also has their images and clouds")
    elif not near:
        parts.append(f"`annotator inspect {shlex.quote(str(path))}` lists what each format needs")
    return "; ".join(parts)
