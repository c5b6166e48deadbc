"""Opens and generates recordings; reads, writes, evaluates and draws labels without a project."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from annotator import recordings
from annotator.api.frames import choice
from annotator.detection.perfect import PerfectDetector, Scene
from annotator.evaluation.boxes import evaluate_oriented
from annotator.evaluation.report import Report, oriented_report
from annotator.formats.box_files import write_boxes
from annotator.formats.reading import AngleUnit
from annotator.formats.table import BoxFormat
from annotator.recordings import Recording
from annotator.synthetic import write_generated
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, Proposal, Truth
from annotator.types.errors import ArgumentError
from annotator.workflows.drawn_boxes import Canvas
from annotator.workflows.evaluate import Options, Protocol, box_table, scored_box
from annotator.workflows.evaluate import evaluate_files as evaluate_protocol
from annotator.workflows.importing import readers
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.recorded.reading import load_truth

Boxes = Mapping[str, Sequence[Truth | Proposal]]
"""The boxes of each frame, by the frame's key."""


def read_labels(path: str | Path, format: str = BoxFormat.BOXES, angles: str | None = None) -> LabelSet:
    """The 3D labels in a file or folder, read and checked as a whole.

    Args:
        format: boxes (a `boxes.json` file), rcv, kitti, kitti-tracking, sunrgbd, openlabel, labelcloud, nuscenes,
            sustechpoints, argoverse2 or box-csv.
        angles: degrees or radians, if it is not what the format says, or if the labels do not show it.

    Returns:
        the labels: `frames` has the names of the labelled frames, and `truths(name, frame)` returns the objects of one
        of them in the camera frame. It needs the `Frame`, because several formats store boxes in other coordinates.

    Raises:
        ArgumentError: an unknown format or unit of angles.
        ConfigError: `angles` for a format without angles.
        FormatError: a file does not follow the format; the message names file and line.
    """
    unit = None if angles is None else choice("angles", angles, AngleUnit)
    return readers.read_labels(choice("format", format, BoxFormat), Path(path), unit)


def write_labels(path: str | Path, labels: Boxes) -> None:
    """Writes boxes without their scores to a `boxes.json` file, for `read_labels` or an RGB-D folder.

    The other formats also need images and calibrations; use `Project.export` for them.

    Args:
        labels: truths, labels or proposals, by frame key.

    Raises:
        FormatError: the file cannot be written.
    """
    as_truths = {
        key: [Truth(each.label, each.box, getattr(each, "track_id", None)) for each in boxes]
        for key, boxes in labels.items()
    }
    write_boxes(Path(path), as_truths)


def evaluate(found: Boxes, truth: Boxes) -> Report:
    """Average precision (exact 3D IoU, thresholds 0.25 and 0.5) and mean errors of fully oriented boxes.

    Args:
        found: by frame key; a frame without an entry has no boxes. A box without a score gets the score 1.
        truth: by frame key; only its frames are evaluated.

    Raises:
        ArgumentError: `truth` has no box, or the two have no frame in common.
    """
    if not any(truth.values()):
        raise ArgumentError("truth has no box to evaluate against")
    if not set(found) & set(truth):
        raise ArgumentError(f"no frame in common: found has {list(found)[:3]}, truth has {list(truth)[:3]}")
    columns = [box_table([list(map(scored_box, side.get(key, ()))) for key in truth]) for side in (found, truth)]
    return oriented_report(evaluate_oriented(columns[0], columns[1]))


def evaluate_files(
    detections: str | Path, truth: str | Path, protocol: str = Protocol.ORIENTED, options: Options | None = None
) -> Report:
    """Evaluates files with a benchmark's protocol, as `annotator evaluate` does.

    Args:
        detections, truth: kitti: folders of label files; sunrgbd: CSV files of boxes; oriented: `rcv` datasets.
        protocol: kitti, sunrgbd or oriented.

    Raises:
        ArgumentError: an unknown protocol.
        FormatError, ConfigError: the files cannot be read, or detections and truth have different frames.
    """
    return evaluate_protocol(Path(detections), Path(truth), choice("protocol", protocol, Protocol), options)


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
        path: the folder to create; missing or empty.
        preset: hands (two hands in the air) or people (who stand and walk in a furnished room).

    Raises:
        ConfigError: an unknown preset, or a number out of its range.
        FormatError: the folder is not empty, or cannot be created.
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
    kind = choice("box_kind", box_kind, BoxKind)
    frames = [recording.frame(i) for i in range(len(recording))]
    scenes = [Scene.of(frame, load_truth(recording, i, frame)) for i, frame in enumerate(frames)]
    return PerfectDetector(scenes, kind)


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


# Colours of 3D and of 2D boxes, RGB.
GREEN, RED = (60, 220, 90), (230, 60, 50)


def draw_boxes(
    frame: Frame, boxes: Sequence[Proposal | Truth | OrientedBox | Box2D], thickness_px: int = 2
) -> UInt8[np.ndarray, "h w 3"]:
    """The frame's image (RGB) with boxes drawn on it: 3D boxes green, with an arrow along the heading; 2D boxes red.

    To save the result: `cv2.imwrite(name, picture[..., ::-1])`.
    """
    canvas = Canvas(frame.rgb)
    for each in boxes:
        if isinstance(each, Box2D):
            canvas.box(each, RED, thickness_px=thickness_px)
        else:
            canvas.solid(frame.camera, each if isinstance(each, OrientedBox) else each.box, GREEN, thickness_px)
    return canvas.rgb
