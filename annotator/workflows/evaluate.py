"""How good detections in files are, by the yardstick of a benchmark."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.evaluation.boxes import BoxTable
from annotator.evaluation.kitti import OFFICIAL, RELAXED, KittiRows, evaluate_kitti
from annotator.evaluation.kitti.protocol import NEIGHBOURS
from annotator.evaluation.oriented_protocol import evaluate_oriented
from annotator.evaluation.report import Report, kitti_report, oriented_report, sunrgbd_report
from annotator.evaluation.sunrgbd import evaluate_sunrgbd
from annotator.formats.box_csv import BoxRow, read_box_csv
from annotator.formats.kitti import KittiLabel
from annotator.formats.kitti_results import read_kitti_folder
from annotator.formats.rcv import read_rcv
from annotator.types import OrientedBox, ReviewState
from annotator.types.errors import ConfigError, FormatError

# Of a box that nobody gave a score.
SURE = 1.0


class Protocol(StrEnum):
    """Whose rules: KITTI's devkit, VoteNet's SUN RGB-D evaluation, or fully oriented boxes."""

    KITTI = "kitti"
    SUNRGBD = "sunrgbd"
    ORIENTED = "oriented"


Named = tuple[str, OrientedBox, float]
"""Class, box and score."""


@dataclass(frozen=True)
class Options:
    """How to evaluate.

    Attributes:
        frames: only the frames of these names; None = all. KITTI: the files' names without suffix. SUN RGB-D: the
            images. Oriented: `RECORDING/KEY`.
        relaxed: KITTI's looser overlaps in bird's-eye view and 3D (0.5 for Car, 0.25 for the others).
    """

    frames: Collection[str] | None = None
    relaxed: bool = False


def read_frame_names(path: Path) -> list[str]:
    """The names in a file, one a line, such as KITTI's `ImageSets/val.txt`.

    Raises:
        FormatError: the file cannot be read, or names nothing.
    """
    try:
        names = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(path, f"the list of frames cannot be read ({error})") from error
    found = [name.strip() for name in names if name.strip()]
    if not found:
        raise FormatError(path, "names no frame")
    return found


def evaluate_files(detections: Path, truth: Path, protocol: Protocol, options: Options | None = None) -> Report:
    """Evaluates detections against truth, both in the protocol's own form.

    Args:
        detections, truth: kitti = folders (or zip archives) of one text file a frame; sunrgbd = CSV files of boxes;
            oriented = `rcv` datasets.

    Raises:
        FormatError: a file cannot be read or does not follow its format; the message names file and line.
        ConfigError: the two do not belong together.
    """
    return _OF_FILES[protocol](detections, truth, options or Options())


def _kitti(detections: Path, truth: Path, options: Options) -> Report:
    found, there = read_kitti_folder(detections, scored=True), read_kitti_folder(truth, scored=False)
    wanted = sorted(found) if options.frames is None else list(dict.fromkeys(options.frames))
    _require(wanted, there, truth, "with the truth")
    _require(wanted, found, detections, "with what was detected; where nothing was, it is empty")
    if options.frames is None and len(there) > len(found):
        other = next(name for name in there if name not in found)
        raise ConfigError(
            f"{detections}: has {len(found)} frames, {truth} {len(there)}; {other}.txt, for one, is missing. Write an "
            "empty file where nothing was detected, or name the frames of your split with --frames"
        )
    return kitti_of([found[name] for name in wanted], [there[name] for name in wanted], options.relaxed)


def kitti_of(
    found: Sequence[Sequence[KittiLabel]], there: Sequence[Sequence[KittiLabel]], relaxed: bool = False
) -> Report:
    """Evaluates the rows of frames 0, 1, 2 ...

    Raises:
        ConfigError: nothing that was detected is of a class that KITTI evaluates.
    """
    result = evaluate_kitti(kitti_rows(found), kitti_rows(there), RELAXED if relaxed else OFFICIAL)
    if not result.curves:
        raise ConfigError(
            f"none of {sum(map(len, found))} detections is of a class that KITTI evaluates ({', '.join(NEIGHBOURS)})"
        )
    return kitti_report(result)


def _require(wanted: Iterable[str], there: Mapping[str, object], path: Path, what: str) -> None:
    missing = [name for name in wanted if name not in there]
    if missing:
        raise ConfigError(f"{path}: has no file {missing[0]}.txt {what} ({len(missing)} frames lack theirs)")


def kitti_rows(frames: Sequence[Sequence[KittiLabel]]) -> KittiRows:
    """The rows of frames 0, 1, 2 ... as columns."""
    numbers = [
        (
            *(row.truncated, row.occluded, row.alpha, row.left, row.top, row.right, row.bottom),
            *(row.height, row.width, row.length, row.x, row.y, row.z, row.rotation_y),
            SURE if row.score is None else row.score,
        )
        for rows in frames
        for row in rows
    ]
    frame = np.repeat(np.arange(len(frames)), [len(rows) for rows in frames])
    labels = np.array([row.label for rows in frames for row in rows], np.str_)
    return KittiRows.from_table(frame, labels, np.array(numbers, np.float64).reshape(-1, 15))


def _sunrgbd(detections: Path, truth: Path, options: Options) -> Report:
    found, there = read_box_csv(detections, scored=True), read_box_csv(truth, scored=False)
    if found and not {row.image for row in found} & {row.image for row in there}:
        raise ConfigError(
            f"{detections} and {truth} have no image in common (first images: {found[0].image}, "
            f"{there[0].image if there else 'none'}); images must have the same names in both"
        )
    if options.frames is not None:
        names = set(options.frames)
        _require_some(names, {row.image for row in (*found, *there)}, truth)
        found, there = ([row for row in rows if row.image in names] for rows in (found, there))
    _require_truth(truth, len(there))
    numbers: dict[str, int] = {}
    return sunrgbd_report(evaluate_sunrgbd(box_rows(found, numbers), box_rows(there, numbers)))


def box_rows(rows: Sequence[BoxRow], numbers: dict[str, int]) -> BoxTable:
    """Rows of a CSV file as columns.

    Args:
        numbers: of the images; images that are not in it yet get the next ones.
    """
    yaws = np.array([row.yaw_rad for row in rows], np.float64).reshape(-1, 1)
    return BoxTable(
        np.array([numbers.setdefault(row.image, len(numbers)) for row in rows], np.int64),
        np.array([row.label for row in rows], np.str_),
        np.array([row.center_m for row in rows], np.float64).reshape(-1, 3),
        Rotation.from_rotvec(yaws * np.array([[0.0, 0.0, 1.0]])).as_matrix().reshape(-1, 3, 3),
        np.array([row.size_m for row in rows], np.float64).reshape(-1, 3),
        np.array([SURE if row.score is None else row.score for row in rows], np.float64),
    )


def _oriented(detections: Path, truth: Path, options: Options) -> Report:
    found, there = _rcv_boxes(detections), _rcv_boxes(truth)
    if not set(found) & set(there):
        raise ConfigError(
            f"{detections} and {truth} have no frame in common; the recordings must have the same names in both "
            f"(first frames: {next(iter(found), 'none')}, {next(iter(there), 'none')})"
        )
    if options.frames is not None:
        _require_some(set(options.frames), {*found, *there}, truth)
    names = [name for name in dict.fromkeys([*there, *found]) if options.frames is None or name in options.frames]
    _require_truth(truth, sum(len(there.get(name, ())) for name in names))
    return oriented_report(
        evaluate_oriented(
            box_table([found.get(name, ()) for name in names]), box_table([there.get(name, ()) for name in names])
        )
    )


def box_table(frames: Sequence[Sequence[Named]]) -> BoxTable:
    """The boxes of frames 0, 1, 2 ... as columns."""
    return BoxTable.of((number, *named) for number, frame in enumerate(frames) for named in frame)


def _rcv_boxes(path: Path) -> dict[str, list[Named]]:
    """The boxes of each frame that are not rejected, by `RECORDING/KEY`."""
    dataset, found = read_rcv(path), {}
    for index in range(len(dataset)):
        name, labels = dataset.named_labels(index)
        if name in found:
            raise FormatError(path, f"has the frame {name} twice")
        kept = (label for label in labels if label.state is not ReviewState.REJECTED)
        found[name] = [(x.label, x.box, SURE if x.score is None else x.score) for x in kept]
    return found


def _require_some(names: Collection[str], known: Collection[str], truth: Path) -> None:
    """A name may stand for a picture without any box, but not all of them."""
    if not set(names) & set(known):
        raise ConfigError(
            f"none of the names to evaluate (first: {min(names, default='none')}) is one of those in {truth} "
            f"(first: {min(known, default='none')})"
        )


def _require_truth(truth: Path, boxes: int) -> None:
    if boxes == 0:
        raise ConfigError(f"{truth}: has no true box in the frames to evaluate")


_OF_FILES: Mapping[Protocol, Callable[[Path, Path, Options], Report]] = {
    Protocol.KITTI: _kitti,
    Protocol.SUNRGBD: _sunrgbd,
    Protocol.ORIENTED: _oriented,
}
