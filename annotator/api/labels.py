"""Reads, writes and evaluates labels without a project."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from annotator.evaluation.oriented import evaluate_oriented
from annotator.evaluation.report import Report, oriented_report
from annotator.formats.boxes_json import write_boxes
from annotator.formats.units import AngleUnit
from annotator.types import Label, Proposal, Truth
from annotator.types.errors import ArgumentError
from annotator.workflows.evaluating.evaluate_files import DEFAULT_SCORE, Options, Protocol, ScoredBox, box_table
from annotator.workflows.evaluating.evaluate_files import evaluate_files as evaluate_protocol
from annotator.workflows.importing import table
from annotator.workflows.importing.label_set import LabelSet

FORMATS = tuple(table.BoxFormat)
Boxes = Mapping[str, Sequence[Truth | Label | Proposal]]
"""The boxes of each frame, by the frame's key."""


def read_labels(path: str | Path, format: str = table.BoxFormat.BOXES, angles: str | None = None) -> LabelSet:
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
    if angles not in (None, *AngleUnit):
        raise ArgumentError(f"angles must be {' or '.join(AngleUnit)}, not {angles!r}")
    if format not in FORMATS:
        raise ArgumentError(f"format must be one of {', '.join(FORMATS)}, not {format!r}")
    unit = None if angles is None else AngleUnit(angles)
    return table.read_labels(table.BoxFormat(format), Path(path), unit)


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
    columns = [box_table([list(map(_scored_box, side.get(key, ()))) for key in truth]) for side in (found, truth)]
    return oriented_report(evaluate_oriented(columns[0], columns[1]))


def _scored_box(each: Truth | Label | Proposal) -> ScoredBox:
    return each.label, each.box, DEFAULT_SCORE if each.score is None else each.score


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
    if protocol not in tuple(Protocol):
        raise ArgumentError(f"protocol must be one of {', '.join(Protocol)}, not {protocol!r}")
    return evaluate_protocol(Path(detections), Path(truth), Protocol(protocol), options)
