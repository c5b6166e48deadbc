"""KITTI tracking folders: sequences with one label file each, whose rows begin with `frame track_id`.

training/image_02/SEQ/FRAME.png  velodyne/SEQ/FRAME.bin  calib/SEQ.txt  label_02/SEQ.txt  and frames.csv with the origin
of each frame (KITTI tracking devkit, readme.txt). SEQ has four digits and FRAME six. Boxes, scans and calibrations are
as in `kitti_objects.py`, but a truncation is one of three levels. Track ids are unique within a sequence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.frame_names import ClassWords, DatasetNames, LabelledFrame
from annotator.formats.kitti_objects import CALIBRATIONS, SCANS, TRAINING, KittiWriter, read_shift, tracked_frames
from annotator.formats.kitti_rows import DONT_CARE, dont_care, dump_tracking_line
from annotator.formats.reading import text_files
from annotator.formats.units import Angles, AngleUnit
from annotator.text import spelled
from annotator.types import Label
from annotator.types.errors import FormatError
from annotator.types.messages import amount

TRACK_LABELS = "label_02"
IMAGES = "image_02"
# Track id of DontCare areas.
NO_TRACK = -1


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


class KittiTrackingWriter(KittiWriter):
    """Writes a tracking folder, one sequence per recording. Boxes without a track id get a new one."""

    def begin(self) -> None:
        self.words = ClassWords(self.info.classes, reserved=(DONT_CARE,))
        self.places = sequence_ids(self.info.places)
        self.sequences: dict[str, TrackingSequence] = {}

    def frame_id(self, item: DatasetItem) -> str:
        name, number = self.places[item.recording, item.frame.key]
        return f"{name}/{number:06d}"

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        name, number = self.places[item.recording, item.frame.key]
        if name not in self.sequences:
            self.sequences[name] = TrackingSequence(name, self.info.free_tracks[item.recording])
        sequence, in_frame = self.sequences[name], set[int]()
        for label, row in self.rows(item, levels=True):
            sequence.rows.append(dump_tracking_line(number, sequence.track_of(label, in_frame), row))
        sequence.rows += [dump_tracking_line(number, NO_TRACK, dont_care(edges)) for edges in item.unlabelled]
        calibration = self.files(item.frame, f"{IMAGES}/{frame_id}", f"{SCANS}/{frame_id}")
        if sequence.calibration not in (None, calibration):
            raise FormatError(
                self.out,
                f"frame {item.frame.key} has a different calibration from earlier frames, but a KITTI sequence has "
                "only one; export as kitti",
            )
        sequence.calibration = calibration

    def finish(self) -> None:
        for sequence in self.sequences.values():
            self.put(f"{TRAINING}/{TRACK_LABELS}/{sequence.name}.txt", "".join(f"{row}\n" for row in sequence.rows))
            self.put(f"{TRAINING}/{CALIBRATIONS}/{sequence.name}.txt", sequence.calibration or "")
        self.words.write(self.folder)
        if untracked := sum(sequence.untracked for sequence in self.sequences.values()):
            note = f"{amount(untracked, 'box')} without a track id got a new one each; `annotator track` links boxes"
            self.notes = (note,)


def sequence_ids(places: Sequence[tuple[str, str, int]]) -> dict[tuple[str, str], tuple[str, int]]:
    """Returns sequence and frame number of each (recording, key): one sequence per recording.

    Args:
        places: recording, key and place in the recording of all frames. The frame number is the key if all keys of
            the recording have six digits, else the place.
    """
    names = list(dict.fromkeys(recording for recording, _, _ in places))
    ids: dict[tuple[str, str], tuple[str, int]] = {}
    for number, name in enumerate(names):
        frames = [(key, place) for recording, key, place in places if recording == name]
        by_key = all(len(key) == 6 and key.isascii() and key.isdigit() for key, _ in frames)
        ids |= {(name, key): (f"{number:04d}", int(key) if by_key else place) for key, place in frames}
    return ids


def read_kitti_tracks(path: Path, unit: AngleUnit | None = None) -> dict[str, LabelledFrame]:
    """Returns the objects of all labelled frames, without DontCare.

    Args:
        path: a tracking folder, its `label_02` with one file per sequence, or a zip archive of that.
        unit: of the angles; None: radians, as the format says.

    Returns:
        by `RECORDING/KEY` from frames.csv, else by `SEQUENCE/FRAME`. A frame without a row is included only if
        frames.csv lists it.
    """
    place = next((path / name for name in (f"{TRAINING}/{TRACK_LABELS}", TRACK_LABELS) if (path / name).is_dir()), path)
    names, angles = DatasetNames.of(place), Angles(unit)
    frames = {origin.name: LabelledFrame(()) for origin in names.frames.values()}
    for sequence, file, text in text_files(place, TRACK_LABELS):
        calibration = spelled(place.parent / CALIBRATIONS, f"{sequence}.txt")
        shift = read_shift(calibration) if place.is_dir() and calibration.is_file() else None
        name = partial(_name, names, sequence)
        frames |= tracked_frames(file, text, angles, name, names, shift)
    angles.require()
    return frames


def _name(names: DatasetNames, sequence: str, number: int) -> str:
    return names.frame(f"{sequence}/{number:06d}")
