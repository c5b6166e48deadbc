"""Evaluates detections in files with a benchmark's protocol."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.evaluation.boxes import BoxTable
from annotator.evaluation.kitti import NEIGHBOURS, OFFICIAL, RELAXED, KittiRows, evaluate_kitti
from annotator.evaluation.oriented import evaluate_oriented, evaluate_sunrgbd
from annotator.evaluation.report import Report, kitti_report, oriented_report, sunrgbd_report
from annotator.files import TABLE_BYTES, read_text_file
from annotator.formats.box_csv import BoxRow, read_box_csv
from annotator.formats.kitti_objects import label_place, read_kitti_folder
from annotator.formats.kitti_rows import KittiLabel
from annotator.formats.rcv import MANIFEST, read_rcv
from annotator.formats.reading import holds_texts
from annotator.text import normal
from annotator.types import OrientedBox, ReviewState
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import amount

# Used for boxes without a score.
DEFAULT_SCORE = 1.0
SCORE_PROJECT = (
    "to score boxes of another format, add their recording to a project, and its boxes with `annotator add` or "
    "`annotator import`; then `annotator evaluate --project PROJECT`"
)


class Protocol(StrEnum):
    """The evaluation protocol: KITTI's devkit, VoteNet's SUN RGB-D evaluation, or fully oriented boxes."""

    KITTI = "kitti"
    SUNRGBD = "sunrgbd"
    ORIENTED = "oriented"


ScoredBox = tuple[str, OrientedBox, float]
"""Class, box and score."""


@dataclass(frozen=True)
class Options:
    """Options of an evaluation.

    Attributes:
        frames: names of the frames to evaluate; None = all. KITTI: file names without suffix. SUN RGB-D: images.
            Oriented: `RECORDING/KEY`.
        relaxed: KITTI's relaxed IoU thresholds in bird's-eye view and 3D (0.5 for Car, 0.25 for the others).
    """

    frames: Collection[str] | None = None
    relaxed: bool = False


def read_frame_names(path: Path) -> list[str]:
    """Reads frame names from a file with one name per line, such as KITTI's `ImageSets/val.txt`.

    Raises:
        FormatError: the file cannot be read, or contains no name.
    """
    try:
        lines = read_text_file(path, TABLE_BYTES).split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(path, f"the list of frames cannot be read ({error})") from error
    names = [normal(line.strip()) for line in lines if line.strip()]
    if not names:
        raise FormatError(path, "contains no frame name")
    return names


def evaluate_files(detections: Path, truth: Path, protocol: Protocol, options: Options | None = None) -> Report:
    """Evaluates detections against truth, both in the protocol's format.

    Args:
        detections, truth: kitti = folders or zip archives with one text file per frame, or datasets with
            training/label_2; sunrgbd = CSV files of boxes; oriented = `rcv` datasets.

    Raises:
        FormatError: a file cannot be read or violates its format; the message names file and line.
        ConfigError: the frames of detections and truth do not match.
    """
    return _OF_FILES[protocol](detections, truth, options or Options())


def _kitti(detections: Path, truth: Path, options: Options) -> Report:
    detections, truth = label_place(detections), label_place(truth)
    for path in (detections, truth):
        if path.exists() and not holds_texts(path):
            raise FormatError(
                path, f"is no folder of KITTI's text files, one for each frame, and no zip of one; {SCORE_PROJECT}"
            )
    detected, true = read_kitti_folder(detections, scored=True), read_kitti_folder(truth, scored=False)
    names = sorted(detected) if options.frames is None else list(dict.fromkeys(options.frames))
    _require(names, true, truth, "with the truth")
    _require(names, detected, detections, "with detections; write an empty file for a frame without detections")
    if options.frames is None and len(true) > len(detected):
        other = next(name for name in true if name not in detected)
        raise ConfigError(
            f"{detections}: has {amount(len(detected), 'frame')}, {truth} has {len(true)}; e.g. {other}.txt is "
            "missing. Write an empty file for each frame without detections, "
            "or name the frames of your split with --frame-list"
        )
    return kitti_of([detected[name] for name in names], [true[name] for name in names], options.relaxed)


def kitti_of(
    detected: Sequence[Sequence[KittiLabel]], true: Sequence[Sequence[KittiLabel]], relaxed: bool = False
) -> Report:
    """Evaluates rows by frame with KITTI's protocol.

    Raises:
        ConfigError: no detection is of a class that KITTI evaluates.
    """
    result = evaluate_kitti(kitti_rows(detected), kitti_rows(true), RELAXED if relaxed else OFFICIAL)
    if not result.curves:
        raise ConfigError(
            f"no detection, of {sum(map(len, detected))} in all, is of a class that KITTI evaluates "
            f"({', '.join(NEIGHBOURS)})"
        )
    return kitti_report(result)


def _require(names: Iterable[str], files: Mapping[str, object], path: Path, what: str) -> None:
    missing = [name for name in names if name not in files]
    if missing:
        raise ConfigError(
            f"{path}: has no file {missing[0]}.txt {what} ({amount(len(missing), 'frame')} without a file)"
        )


def kitti_rows(frames: Sequence[Sequence[KittiLabel]]) -> KittiRows:
    """Returns rows by frame as columns; frames are numbered from 0."""
    numbers = [
        (
            *(row.truncated, row.occluded, row.alpha, row.left, row.top, row.right, row.bottom),
            *(row.height, row.width, row.length, row.x, row.y, row.z, row.rotation_y),
            DEFAULT_SCORE if row.score is None else row.score,
        )
        for rows in frames
        for row in rows
    ]
    frame = np.repeat(np.arange(len(frames)), [len(rows) for rows in frames])
    labels = np.array([row.label for rows in frames for row in rows], np.str_)
    return KittiRows.from_table(frame, labels, np.array(numbers, np.float64).reshape(-1, 15))


def _sunrgbd(detections: Path, truth: Path, options: Options) -> Report:
    for path in (detections, truth):
        if path.is_dir() or path.suffix == ".json":
            raise FormatError(
                path, f"is no CSV file of boxes, one for all images (image,class,cx,...); {SCORE_PROJECT}"
            )
    detected, true = read_box_csv(detections, scored=True), read_box_csv(truth, scored=False)
    if detected and not {row.image for row in detected} & {row.image for row in true}:
        raise ConfigError(
            f"{detections} and {truth} have no image in common (first images: {detected[0].image}, "
            f"{true[0].image if true else 'none'}); images must have the same names in both"
        )
    if options.frames is not None:
        names = set(options.frames)
        _require_some(names, {row.image for row in (*detected, *true)}, truth)
        detected, true = ([row for row in rows if row.image in names] for rows in (detected, true))
    _require_truth(truth, len(true))
    numbers: dict[str, int] = {}
    return sunrgbd_report(evaluate_sunrgbd(box_rows(detected, numbers), box_rows(true, numbers)))


def box_rows(rows: Sequence[BoxRow], numbers: dict[str, int]) -> BoxTable:
    """Returns rows of a CSV file as columns.

    Args:
        numbers: number of each image; new images are added with the next numbers.
    """
    yaws = np.array([row.yaw_rad for row in rows], np.float64).reshape(-1, 1)
    return BoxTable(
        np.array([numbers.setdefault(row.image, len(numbers)) for row in rows], np.int64),
        np.array([row.label for row in rows], np.str_),
        np.array([row.center_m for row in rows], np.float64).reshape(-1, 3),
        Rotation.from_rotvec(yaws * np.array([[0.0, 0.0, 1.0]])).as_matrix().reshape(-1, 3, 3),
        np.array([row.size_m for row in rows], np.float64).reshape(-1, 3),
        np.array([DEFAULT_SCORE if row.score is None else row.score for row in rows], np.float64),
    )


def _oriented(detections: Path, truth: Path, options: Options) -> Report:
    detected, true = _rcv_boxes(detections), _rcv_boxes(truth)
    if not set(detected) & set(true):
        raise ConfigError(
            f"{detections} and {truth} have no frame in common; the recordings must have the same names in both "
            f"(first frames: {next(iter(detected), 'none')}, {next(iter(true), 'none')})"
        )
    if options.frames is not None:
        _require_some(set(options.frames), {*detected, *true}, truth)
    names = [name for name in dict.fromkeys([*true, *detected]) if options.frames is None or name in options.frames]
    _require_truth(truth, sum(len(true.get(name, ())) for name in names))
    return oriented_report(
        evaluate_oriented(
            box_table([detected.get(name, ()) for name in names]), box_table([true.get(name, ()) for name in names])
        )
    )


def box_table(frames: Sequence[Sequence[ScoredBox]]) -> BoxTable:
    """Returns boxes by frame as columns; frames are numbered from 0."""
    return BoxTable.of((number, *box) for number, frame in enumerate(frames) for box in frame)


def _rcv_boxes(path: Path) -> dict[str, list[ScoredBox]]:
    """Reads the boxes of each frame by `RECORDING/KEY`, without rejected ones."""
    if path.exists() and not (path / MANIFEST).is_file():
        raise FormatError(path, f"is no dataset in the format rcv, which has a {MANIFEST}; {SCORE_PROJECT}")
    dataset, boxes = read_rcv(path), {}
    for index in range(len(dataset)):
        name, labels, *_ = dataset.named_labels(index)
        name = normal(name)
        if name in boxes:
            raise FormatError(path, f"frame {name} occurs twice; remove one")
        accepted = (label for label in labels if label.state is not ReviewState.REJECTED)
        boxes[name] = [(x.label, x.box, DEFAULT_SCORE if x.score is None else x.score) for x in accepted]
    return boxes


def _require_some(names: Collection[str], known: Collection[str], truth: Path) -> None:
    """Checks that at least one name is known; images without boxes do not occur in the files."""
    if not set(names) & set(known):
        raise ConfigError(
            f"none of the names to evaluate (first: {min(names, default='none')}) is in {truth} "
            f"(first: {min(known, default='none')})"
        )


def _require_truth(truth: Path, boxes: int) -> None:
    if boxes == 0:
        raise ConfigError(f"{truth}: has no true boxes in the frames to evaluate")


_OF_FILES: Mapping[Protocol, Callable[[Path, Path, Options], Report]] = {
    Protocol.KITTI: _kitti,
    Protocol.SUNRGBD: _sunrgbd,
    Protocol.ORIENTED: _oriented,
}
