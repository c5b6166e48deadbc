"""Opens and generates recordings, and reads the boxes that come with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from annotator import recordings
from annotator.detection.perfect import PerfectDetector, Scene
from annotator.recordings import Recording
from annotator.synthetic import write_generated
from annotator.types import BoxKind, Frame, Truth
from annotator.types.errors import ArgumentError
from annotator.workflows.recorded.reading import load_truth


def open_recording(path: str | Path, **options: Any) -> Recording:
    """The recording at `path`, in any supported format (docs/recordings.md).

    Args:
        options: how it is read, for formats that take options: fields of `ReaderOptions`, such as `columns=5`.

    Returns:
        a recording of `len(recording)` frames; `recording.frame(i)` reads one; frames are not cached.

    Raises:
        UnknownFormatError: no reader recognises the path; `looked_for` lists what each looks for.
        ConfigError: an option that the format does not take, or an invalid value.
        RecordingError: it has no frames, or cannot be read.
    """
    return recordings.open_recording(Path(path), recordings.parse_options(**options))


def generate_recording(
    path: str | Path,
    preset: str = "hands",
    frames: int = 4,
    *,
    seed: int = 0,
    width_px: int = 640,
    height_px: int = 480,
) -> Recording:
    """Generates an RGB-D recording of a synthetic room with exact ground truth, for experiments.

    Args:
        path: the folder to create; it must not exist.
        preset: hands (two hands in the air) or people (who stand and walk in a furnished room).

    Raises:
        ConfigError: the folder exists, or a number is out of its range.
    """
    write_generated(Path(path), preset, frames, seed, width_px, height_px)
    return open_recording(path)


def perfect_detector(recording: Recording, box_kind: BoxKind | str = BoxKind.SILHOUETTE) -> PerfectDetector:
    """An image and view detector that returns the projected 3D boxes of a recording, for examples and tests.

    The clouds of all frames stay in memory.

    Args:
        box_kind: what its 2D boxes measure; as for `propose`.

    Raises:
        ArgumentError: an unknown kind.
        RecordingError, FormatError: as `read_truth`.
    """
    if box_kind not in tuple(BoxKind):
        raise ArgumentError(f"box_kind must be one of {', '.join(BoxKind)}, not {box_kind!r}")
    frames = [recording.frame(i) for i in range(len(recording))]
    scenes = [Scene.of(frame, load_truth(recording, i, frame)) for i, frame in enumerate(frames)]
    return PerfectDetector(scenes, BoxKind(box_kind))


def read_truth(recording: Recording, index: int, frame: Frame | None = None) -> list[Truth]:
    """The 3D boxes that come with a recording for one of its frames, in the camera frame.

    Args:
        frame: the frame, if it has been read already.

    Raises:
        RecordingError: the recording has no labels, or the frame cannot be read.
        FormatError: its labels are broken.
        IndexError: there is no such frame.
    """
    return load_truth(recording, index, recording.frame(index) if frame is None else frame)
