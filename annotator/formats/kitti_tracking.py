"""KITTI tracking folders: sequences with one label file each, whose rows begin with `frame track_id`.

training/image_02/SEQ/FRAME.png  velodyne/SEQ/FRAME.bin  calib/SEQ.txt  label_02/SEQ.txt  and frames.csv with the origin
of each frame (KITTI tracking devkit, readme.txt). SEQ has four digits and FRAME six. Boxes, scans and calibrations are
as in `object_folder.py`, but a truncation is one of three levels. Track ids are unique within a sequence.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.file_names import spelled
from annotator.files import new_folder
from annotator.formats.dataset_writing import DatasetItem, encoded_image, writing
from annotator.formats.frame_names import (
    CLASS_NAMES,
    FRAMES_CSV,
    ClassWords,
    DatasetNames,
    FrameOrigin,
    dump_frames,
    has_frames,
)
from annotator.formats.kitti_objects import (
    CALIBRATIONS,
    NOT_HELD,
    TRAINING,
    Frames,
    KittiRows,
    calibration_text,
    item_rows,
    lidar_points,
    read_shift,
)
from annotator.formats.kitti_rows import DONT_CARE, KittiLabel, dump_tracking_line, label_frame, parse_tracking_fields
from annotator.formats.losses import Losses, Lost, count_lost
from annotator.formats.reading import text_files
from annotator.geometry.projection import straightened
from annotator.types import Frame, Label, Truth
from annotator.types.errors import FormatError

LABELS = "label_02"
IMAGES, SCANS = "image_02", "velodyne"
# Track id of DontCare areas.
NO_TRACK = -1
MOST_SEQUENCES = 10_000


@dataclass
class TrackingSequence:
    """One sequence while it is written.

    Attributes:
        name: four digits.
        rows: rows of its label file so far.
        calibration: calibration of its first frame.
        fresh: the next unused track id.
        owners: the class of each track id.
        untracked: number of boxes that had no track id of their own and got a new one.
    """

    name: str
    fresh: int
    rows: list[str] = field(default_factory=list)
    calibration: str | None = None
    owners: dict[int, str] = field(default_factory=dict)
    untracked: int = 0

    def track_of(self, label: Label, in_frame: set[int]) -> int:
        """Returns the track id for a label: its own, or a new one if it has none or its own is taken.

        An id is taken if another class of the sequence, or another box of the frame, has it.
        """
        track = label.track_id
        if track is None or track < 0 or track in in_frame or self.owners.setdefault(track, label.label) != label.label:
            track, self.fresh = self.fresh, self.fresh + 1
            self.untracked += 1
        in_frame.add(track)
        return track


def write_kitti_tracking(
    out: Path,
    items: Iterable[DatasetItem],
    ids: Mapping[tuple[str, str], tuple[str, int]],
    first_free: Mapping[str, int],
    classes: Sequence[str],
    losses: Losses,
    *,
    areas: Callable[[DatasetItem], Sequence[KittiLabel]] = lambda item: (),
    overwrite: bool = False,
) -> tuple[Counter[str], int]:
    """Writes the folder `out` atomically, one frame in memory at a time.

    Args:
        out: a folder that is missing or empty; with `overwrite`, an older export of this format is replaced.
        items: the frames, recording by recording in order.
        ids: sequence and number of each (recording, key) (`sequence_ids`).
        first_free: for each recording, an id above all its track ids.
        classes, losses, areas: as in `write_kitti`.

    Returns:
        The number of boxes written, by class, and the number of boxes that got a new track id.

    Raises:
        FormatError: `out` exists, there is no frame, a recording has several calibrations, or writing fails.
    """
    words, counts, origins = ClassWords(classes, reserved=(DONT_CARE,)), Counter[str](), list[FrameOrigin]()
    sequences: dict[str, TrackingSequence] = {}
    not_held = tuple(kind for kind in NOT_HELD if kind is not Lost.TRACK)
    with new_folder(out, lambda folder: overwrite and _is_dataset(folder)) as part:
        root = part / TRAINING
        for item in items:
            name, number = ids[item.recording, item.frame.key]
            if name not in sequences:
                sequences[name] = TrackingSequence(name, first_free[item.recording])
                with writing(out):
                    for folder in (IMAGES, SCANS):
                        (root / folder / name).mkdir(parents=True)
            sequence = sequences[name]
            origins.append(FrameOrigin(f"{name}/{number:06d}", item.recording, item.frame.key, item.split))
            count_lost(losses, item, not_held)
            _add_rows(sequence, number, item, words, counts, losses, areas(item))
            with writing(out):
                _write_frame(out, root, sequence, number, item.frame)
        if not origins:
            raise FormatError(out, "there is no frame to export; the export was not written")
        with writing(out):
            for folder in (CALIBRATIONS, LABELS):
                (root / folder).mkdir()
            for sequence in sequences.values():
                (root / LABELS / f"{sequence.name}.txt").write_text("".join(sequence.rows), encoding="utf-8")
                (root / CALIBRATIONS / f"{sequence.name}.txt").write_text(sequence.calibration or "", encoding="utf-8")
            (part / FRAMES_CSV).write_text(dump_frames(origins), encoding="utf-8", newline="")
            if changed := words.dump():
                (part / CLASS_NAMES).write_text(changed, encoding="utf-8")
    return counts, sum(sequence.untracked for sequence in sequences.values())


def _add_rows(
    sequence: TrackingSequence,
    number: int,
    item: DatasetItem,
    words: ClassWords,
    counts: Counter[str],
    losses: Losses,
    areas: Sequence[KittiLabel],
) -> None:
    in_frame: set[int] = set()
    for label, row in item_rows(item, words, counts, losses, levels=True):
        sequence.rows.append(f"{dump_tracking_line(number, sequence.track_of(label, in_frame), row)}\n")
    sequence.rows += [f"{dump_tracking_line(number, NO_TRACK, row)}\n" for row in areas]


def _write_frame(out: Path, root: Path, sequence: TrackingSequence, number: int, frame: Frame) -> None:
    camera, rgb = straightened(frame.camera, frame.rgb)
    T = label_frame(frame)
    calibration = calibration_text(camera, T)
    if sequence.calibration not in (None, calibration):
        raise FormatError(
            out,
            f"frame {frame.key} has a different calibration from earlier frames, but a KITTI sequence has only one; "
            "export as kitti",
        )
    sequence.calibration = calibration
    (root / IMAGES / sequence.name / f"{number:06d}.png").write_bytes(encoded_image(rgb, "png"))
    (root / SCANS / sequence.name / f"{number:06d}.bin").write_bytes(lidar_points(frame.cloud, T).tobytes())


def _is_dataset(folder: Path) -> bool:
    """True for an export of annotator: KITTI's own folders have no frames.csv."""
    return has_frames(folder) and (folder / TRAINING / LABELS).is_dir()


def sequence_ids(places: Sequence[tuple[str, str, int]]) -> dict[tuple[str, str], tuple[str, int]]:
    """Returns sequence and frame number of each (recording, key): one sequence per recording.

    Args:
        places: recording, key and place in the recording of all frames. The frame number is the key if all keys of
            the recording have six digits, else the place.

    Raises:
        ValueError: more recordings than four digits can count.
    """
    names = list(dict.fromkeys(recording for recording, _, _ in places))
    if len(names) > MOST_SEQUENCES:
        raise ValueError(
            f"KITTI tracking has at most {MOST_SEQUENCES} sequences (four digits); export fewer recordings"
        )
    ids: dict[tuple[str, str], tuple[str, int]] = {}
    for number, name in enumerate(names):
        frames = [(key, place) for recording, key, place in places if recording == name]
        by_key = all(len(key) == 6 and key.isascii() and key.isdigit() for key, _ in frames)
        ids |= {(name, key): (f"{number:04d}", int(key) if by_key else place) for key, place in frames}
    return ids


def read_kitti_tracks(path: Path, found: KittiRows) -> tuple[Frames, dict[str, Float64[np.ndarray, "3"]]]:
    """Returns the objects of all labelled frames, without DontCare, and the shifts to the colour camera from calib/.

    Args:
        path: a tracking folder, its `label_02` with one file per sequence, or a zip archive of that.
        found: collects what the rows show beside their 3D boxes.

    Returns:
        Both by `RECORDING/KEY` from frames.csv, else by `SEQUENCE/FRAME`. A frame without a row is included only if
        frames.csv lists it. Boxes are in rectified camera 0; see `read_kitti_shifts`.

    Raises:
        FormatError: there are no labels, a row is not a valid label (names the line), frames.csv does not list a
            frame, or the angles are not in radians.
    """
    place = next((path / name for name in (f"{TRAINING}/{LABELS}", LABELS) if (path / name).is_dir()), path)
    dataset_names, frames, shifts = (
        DatasetNames.of(place),
        dict[str, list[Truth]](),
        dict[str, Float64[np.ndarray, "3"]](),
    )
    for origin in dataset_names.frames.values():
        frames[origin.name] = []
    for sequence, file, text in text_files(place, within=LABELS):
        calibration = spelled(place.parent / CALIBRATIONS, f"{sequence}.txt")
        shift = read_shift(calibration) if place.is_dir() and calibration.is_file() else None
        for line, row in enumerate(text.splitlines(), 1):
            if not row.strip():
                continue
            number, track_id, label = parse_tracking_fields(row.split(), file, line)
            name = dataset_names.frame(f"{sequence}/{number:06d}")
            objects = frames.setdefault(name, [])
            if shift is not None:
                shifts[name] = shift
            if (truth := found.truth(name, label, track_id, file, line)) is not None:
                objects.append(replace(truth, label=dataset_names.label(truth.label)))
    found.angles.require()
    return {name: tuple(objects) for name, objects in frames.items()}, shifts
