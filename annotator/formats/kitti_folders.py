"""KITTI labels of many frames: `label_2` folders and the datasets around them, tracking files, and results.

    training/image_2/ID.png  velodyne/ID.bin  calib/ID.txt  label_2/ID.txt
    ImageSets/{train,val,test,trainval}.txt   frames.csv

Boxes are in rectified camera 0, as in `kitti_rows.py`. A `frames.csv` above the label files, as in annotator's
exports, gives the name of each file's frame in a project; without it the file's stem is the frame's key.

Scans (float32 x y z reflectance; x forward, y left, z up; reflectance 0 if unknown) have their origin at rectified
camera 0 (x right, y down, z forward). The shift to the colour camera comes from the calibrations: P2 = K [I | t], so a
point in the frame of camera 0 plus t is the same point in the colour camera's frame; in KITTI t is about 6 cm. In
exports, `px = P2 * R0_rect * Tr_velo_to_cam * X_lidar` with R0_rect the identity (KITTI object devkit, readme.txt). All
images are in `training/`, including those of the part `test`, because their labels are known. As in the devkit, results
need a file for every frame; it is empty for a frame without detections.

Tracking folders have sequences with one label file each, whose rows begin with `frame track_id` (KITTI tracking devkit,
readme.txt):

    training/image_02/SEQ/FRAME.png  velodyne/SEQ/FRAME.bin  calib/SEQ.txt  label_02/SEQ.txt   frames.csv

SEQ has four digits and FRAME six. Boxes, scans and calibrations are as above, but a truncation is one of three levels.
Track ids are unique within a sequence.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats import kitti_rows
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, Lost
from annotator.formats.frame_names import (
    SIX_DIGITS,
    TRUNCATION,
    ClassWords,
    DatasetNames,
    LabelledFrame,
    held_by_kitti,
    six_digit_ids,
)
from annotator.formats.kitti_rows import DONT_CARE, dont_care, dump_tracking_line
from annotator.formats.reading import MOST, Angles, AngleUnit, faults, text_files, text_rows
from annotator.geometry.outline import Sight
from annotator.geometry.projection import straightened
from annotator.image_bytes import encoded_image
from annotator.text import spelled, to_number
from annotator.types import Camera, Frame, Label, PointCloud
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import amount

PLACES = ("training/label_2", "label_2", "label_02.txt")
NO_NAMES = DatasetNames()


def read_kitti(path: Path, unit: AngleUnit | None = None) -> dict[str, LabelledFrame]:
    """Returns the 3D boxes of each frame, by `RECORDING/KEY` or only `KEY`.

    Args:
        path: a folder of label files or a zip archive of one, a KITTI folder (training/label_2, label_2), or a tracking
            file `label_02.txt`, where every frame with a row counts as labelled, by its number with six digits.
        unit: of the angles; None: radians, as the format says.
    """
    place, angles = label_place(path), Angles(unit)
    if place.is_file() and place.suffix == ".txt":
        if any(len(fields) in (kitti_rows.FIELDS, kitti_rows.FIELDS + 1) for _, fields in text_rows(place)[:1]):
            raise FormatError(place, f"has the labels of one frame; give the folder of all: {place.parent}")
        frames = tracked_frames(place, None, angles)
        if not frames:
            raise FormatError(place, "has no label row")
    else:
        names, frames = DatasetNames.of(place), dict[str, LabelledFrame]()
        for stem, file, text in text_files(place, LABELS):
            calibration = calibration_beside(file) if place.is_dir() else None
            shift = None if calibration is None else read_shift(calibration)
            frames[names.frame(stem)] = frame_of(list(kitti_rows.read_rows(file, text)), file, angles, names, shift)
    angles.require()
    return frames


def tracked_frames(
    file: Path,
    text: str | None,
    angles: Angles,
    names: DatasetNames = NO_NAMES,
    shift: Float64[np.ndarray, "3"] | None = None,
) -> dict[str, LabelledFrame]:
    """Returns the frames of a tracking file, by their number with six digits.

    Args:
        text, names, shift: as in `read_rows` and `frame_of`.
    """
    rows = defaultdict[str, list[kitti_rows.KittiLabel]](list)
    for row in kitti_rows.read_rows(file, text, tracking=True):
        rows[f"{row.frame or 0:06d}"].append(row)
    return {frame: frame_of(each, file, angles, names, shift) for frame, each in rows.items()}


def frame_of(
    rows: Sequence[kitti_rows.KittiLabel],
    file: Path,
    angles: Angles,
    names: DatasetNames,
    shift: Float64[np.ndarray, "3"] | None,
) -> LabelledFrame:
    """Returns the objects of a frame's rows.

    Args:
        angles: those of all rows that belong together.
        names: of the dataset.
        shift: from rectified camera 0 to the colour camera, metres, by the dataset's calibration; None: that of the
            frame's recording, and without either, the labels are taken as being in the camera frame.
    """
    truths = [kitti_rows.row_truth(row, None, file, angles) for row in rows if row.is_solid]
    pose = kitti_rows.label_frame if shift is None else RigidTransform.from_translation(shift)
    named = [replace(truth, label=names.label(truth.label)) for truth in truths]
    return LabelledFrame(named, pose, flat=sum(row.is_flat for row in rows))


def label_place(path: Path) -> Path:
    """The folder or file of labels in a KITTI dataset; the path itself if it is none."""
    return next((path / name for name in PLACES if (path / name).exists()), path)


LABELS, CALIBRATIONS, SCANS = "label_2", "calib", "velodyne"
# Plausibility limit, metres: two cameras of one vehicle.
MOST_SHIFT_M = 100.0


def calibration_beside(label_file: Path) -> Path | None:
    """Returns `calib/STEM.txt` beside the `label_2` folder of a label file; None if there is no such file.

    It may have the name in another Unicode form.
    """
    if label_file.parent.name != LABELS:
        return None
    file = spelled(label_file.parent.parent / CALIBRATIONS, label_file.name)
    return file if file.is_file() else None


def read_matrices(path: Path, shapes: Mapping[str, tuple[int, int]]) -> dict[str, Float64[np.ndarray, "r c"]]:
    """Returns the matrices of these names in a calibration file."""
    matrices: dict[str, Float64[np.ndarray, "r c"]] = {}
    for line, (head, *words) in text_rows(path):
        name = head.rstrip(":")
        if name not in shapes or name in matrices:
            continue
        rows, columns = shapes[name]
        with faults(path, f"{name} needs {rows * columns} numbers: ", line):
            matrix = np.array([to_number(word) for word in words]).reshape(rows, columns)
        if not (np.abs(matrix) <= MOST).all():
            raise FormatError(path, f"{name} must be finite and at most {MOST:g}", line)
        matrices[name] = matrix
    if missing := [name for name in shapes if name not in matrices]:
        raise FormatError(path, f"has no {' and no '.join(missing)}")
    return matrices


P2_SHAPE = {"P2": (3, 4)}


def shift_of(path: Path, P2: Float64[np.ndarray, "3 4"]) -> Float64[np.ndarray, "3"]:
    """Returns t of P2 = K [I | t], metres."""
    try:
        shift = np.linalg.solve(P2[:, :3], P2[:, 3])
    except np.linalg.LinAlgError as error:
        raise FormatError(path, "P2 is not a camera matrix: its left 3x3 part is singular") from error
    if not (np.abs(shift) <= MOST_SHIFT_M).all():
        raise FormatError(path, f"P2 shifts the camera by more than {MOST_SHIFT_M:g} m; correct its last column")
    return shift


def read_shift(path: Path) -> Float64[np.ndarray, "3"]:
    """Returns t of a calibration file, metres."""
    return shift_of(path, read_matrices(path, P2_SHAPE)["P2"])


def read_kitti_folder(path: Path, *, scored: bool) -> dict[str, tuple[kitti_rows.KittiLabel, ...]]:
    """Returns the rows of every frame, by the file's stem, in file order.

    Args:
        path: a folder, or a zip archive, of `KEY.txt` files.
        scored: True for results: every row must have a score.
    """
    return {key: read_kitti_file(file, text, scored=scored) for key, file, text in text_files(path)}


def read_kitti_file(file: Path, text: str | None = None, *, scored: bool = False) -> tuple[kitti_rows.KittiLabel, ...]:
    """Returns the rows of one frame; arguments as in `read_rows` and `read_kitti_folder`."""
    rows, angles = tuple(kitti_rows.read_rows(file, text)), Angles()
    for row in rows:
        if scored and row.score is None:
            raise FormatError(
                file,
                "has no score, so it is a label and no result; a result row has 16 fields, with the score as the last: "
                "append one to each row (1.0 if all are equally certain), and give DETECTIONS before TRUTH",
                row.line,
            )
        if row.right < row.left or row.bottom < row.top:
            edges = f"{row.left:g} {row.top:g} {row.right:g} {row.bottom:g}"
            problem = f"the 2D box must have left <= right and top <= bottom, not left top right bottom = {edges}"
            raise FormatError(file, problem, row.line)
        if row.is_solid and min(row.height, row.width, row.length) <= 0:
            sizes = f"{row.height:g} {row.width:g} {row.length:g}"
            raise FormatError(file, f"height width length must be positive, not {sizes}", row.line)
        if row.is_solid:
            angles.radians(row.rotation_y, file, row.line)
    angles.require()
    return rows


TRAINING, IMAGE_SETS = "training", "ImageSets"
# KITTI's names of the parts; trainval.txt lists train and val.
SPLITS = ("train", "val", "test")
TEST = SPLITS[-1]
# Rectified camera 0 <- LiDAR: x right = -y left, y down = -z up, z forward = x.
CAMERA_LIDAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


class KittiWriter(DatasetWriter):
    """Writes an object folder. KITTI's own recordings keep their DontCare areas."""

    def begin(self) -> None:
        self.words = ClassWords(self.info.classes, reserved=(kitti_rows.DONT_CARE,))
        self.ids = six_digit_ids([(recording, key) for recording, key, _ in self.info.places])

    def frame_id(self, item: DatasetItem) -> str:
        return self.ids[item.recording, item.frame.key]

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        if item.split is not None and item.split not in SPLITS:
            # KITTI's tools would ignore another part
            raise ConfigError(
                f"KITTI's parts are called {', '.join(SPLITS)}, not {item.split}; split the dataset with "
                "--split train=0.8,val=0.2"
            )
        rows = [kitti_rows.dump_label_line(row) for _, row in self.rows(item)]
        rows += [kitti_rows.dump_label_line(kitti_rows.dont_care(edges)) for edges in item.unlabelled]
        self.put(f"{TRAINING}/{LABELS}/{frame_id}.txt", "".join(f"{row}\n" for row in rows))
        calibration = self.files(item.frame, f"image_2/{frame_id}", f"{SCANS}/{frame_id}")
        self.put(f"{TRAINING}/{CALIBRATIONS}/{frame_id}.txt", calibration)

    def files(self, frame: Frame, image: str, scan: str) -> str:
        """Writes the image and the scan of a frame, at paths without suffix; returns the text of its calibration."""
        camera, rgb = straightened(frame.camera, frame.rgb)
        T = kitti_rows.label_frame(frame)
        self.put(f"{TRAINING}/{image}.png", encoded_image(rgb))
        self.put(f"{TRAINING}/{scan}.bin", lidar_points(frame.cloud, T).tobytes())
        return calibration_text(camera, T)

    def finish(self) -> None:
        """Writes the frame ids of each part, one per line; without parts all are in train and trainval."""
        parts = self.parts("train")
        parts["trainval"] = [origin.id for origin in self.origins if origin.split != TEST]
        for name, ids in parts.items():
            self.put(f"{IMAGE_SETS}/{name}.txt", "".join(f"{each}\n" for each in ids))
        self.words.write(self.folder)

    def rows(self, item: DatasetItem, *, levels: bool = False) -> Iterator[tuple[Label, kitti_rows.KittiLabel]]:
        """Yields the labels inside the image with their rows, and counts boxes and losses.

        All fields of a row follow from its rounded 3D box, so the row is consistent when read back; but truncation and
        occlusion are those of the label's attributes, if it has them.

        Args:
            levels: the truncation is going to be written as a level, as in tracking files.
        """
        sight, losses = Sight(item.frame.cloud.xyz_m), self.losses
        for label in item.labels:
            upright, tilt_rad = kitti_rows.upright_box(label.box, item.frame)
            rounded = kitti_rows.rounded_box(upright)
            row = kitti_rows.upright_row(self.words[label.label], rounded, None, item.frame, sight, label.attributes)
            if not kitti_rows.is_in_image(row):
                losses.add(Lost.OUTSIDE)
                continue
            losses.add_tilt(tilt_rad)
            losses.add_rounding(upright, rounded)
            held = held_by_kitti(label.attributes)
            losses.add_values(label.attributes.keys() - held.keys())
            losses.add_values(_approximated(held, levels))
            if self.words.is_changed(label.label):
                losses.add(Lost.NAME)
            self.counts[label.label] += 1
            yield label, row


def _approximated(held: Mapping[str, float], levels: bool) -> Iterator[str]:
    """Yields what happens to values that are not written as they are."""
    for name, value in held.items():
        if levels and name == TRUNCATION:
            # only "not truncated" is read again as a share
            if value != 0:
                yield f"{name}, as a level"
        elif round(value, kitti_rows.DECIMALS) != value:
            yield f"{name}, rounded"


def lidar_points(cloud: PointCloud, T_camera_label: RigidTransform | None) -> Float32[np.ndarray, "n 4"]:
    """Returns the points as a scan: x forward, y left, z up from rectified camera 0, metres, and the reflectance."""
    xyz = cloud.xyz_m.astype(np.float64)
    if T_camera_label is not None:
        xyz = T_camera_label.inv().apply(xyz)
    reflectance = np.zeros(len(xyz)) if cloud.reflectance is None else cloud.reflectance
    return np.column_stack([xyz @ CAMERA_LIDAR, reflectance]).astype("<f4")


def calibration_text(camera: Camera, T_camera_label: RigidTransform | None) -> str:
    """Returns the text of `calib/ID.txt`: all seven lines of KITTI's files, since some programs count them.

    Args:
        camera: an ideal camera.
        T_camera_label: from rectified camera 0, a shift; None for identity.
    """
    shift = np.zeros(3) if T_camera_label is None else T_camera_label.translation
    K, still = camera.matrix, np.zeros((3, 1))
    return matrices_text(np.hstack([K, still]), np.column_stack([K, K @ shift]), np.hstack([CAMERA_LIDAR, still]))


def matrices_text(P0: np.ndarray, P2: np.ndarray, Tr_velo_to_cam: np.ndarray) -> str:
    """Returns the text of a calibration file, unrounded; R0_rect and the IMU's matrix are the identity."""
    matrices = {
        "P0": P0,
        "P1": P0,
        "P2": P2,
        "P3": P2,
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": Tr_velo_to_cam,
        "Tr_imu_to_velo": np.eye(3, 4),
    }
    # + 0.0: no negative zeros
    rows = {name: map(repr, (matrix + 0.0).ravel().tolist()) for name, matrix in matrices.items()}
    return "".join(f"{name}: {' '.join(numbers)}\n" for name, numbers in rows.items())


TRACK_LABELS = "label_02"
IMAGES = "image_02"
# Track id of DontCare areas.
NO_TRACK = -1


class KittiTrackingWriter(KittiWriter):
    """Writes a tracking folder, one sequence per recording. Boxes without a track id get a new one."""

    def begin(self) -> None:
        self.words = ClassWords(self.info.classes, reserved=(DONT_CARE,))
        self.places = sequence_ids(self.info.places)
        self.label_rows: dict[str, list[str]] = {}
        self.calibrations: dict[str, str] = {}
        # the class of each track id of a sequence
        self.owners: dict[tuple[str, int], str] = {}
        self.fresh = dict(self.info.free_tracks)
        self.untracked = 0

    def frame_id(self, item: DatasetItem) -> str:
        name, number = self.places[item.recording, item.frame.key]
        return f"{name}/{number:06d}"

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        name, number = self.places[item.recording, item.frame.key]
        rows, in_frame = self.label_rows.setdefault(name, []), set[int]()
        for label, row in self.rows(item, levels=True):
            track = self._track_of(item.recording, label, in_frame)
            in_frame.add(track)
            rows.append(dump_tracking_line(number, track, row))
        rows += [dump_tracking_line(number, NO_TRACK, dont_care(edges)) for edges in item.unlabelled]
        calibration = self.files(item.frame, f"{IMAGES}/{frame_id}", f"{SCANS}/{frame_id}")
        if self.calibrations.setdefault(name, calibration) != calibration:
            raise FormatError(
                self.out,
                f"frame {item.frame.key} has a different calibration from earlier frames, but a KITTI sequence has "
                "only one; export as kitti",
            )

    def _track_of(self, recording: str, label: Label, in_frame: set[int]) -> int:
        """Returns the track id for a label: its own, or a new one if it has none or its own is taken.

        An id is taken if another class of the sequence, or another box of the frame, has it.
        """
        track = label.track_id
        if (
            track is not None
            and track >= 0
            and track not in in_frame
            and self.owners.setdefault((recording, track), label.label) == label.label
        ):
            return track
        self.untracked += 1
        self.fresh[recording] += 1
        return self.fresh[recording] - 1

    def finish(self) -> None:
        for name, rows in self.label_rows.items():
            self.put(f"{TRAINING}/{TRACK_LABELS}/{name}.txt", "".join(f"{row}\n" for row in rows))
            self.put(f"{TRAINING}/{CALIBRATIONS}/{name}.txt", self.calibrations[name])
        self.words.write(self.folder)
        if self.untracked:
            boxes = amount(self.untracked, "box")
            self.notes = (f"{boxes} without a track id got a new one each; `annotator track` links boxes",)


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
        by_key = all(SIX_DIGITS.fullmatch(key) for key, _ in frames)
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
        for number, frame in tracked_frames(file, text, angles, names, shift).items():
            frames[names.frame(f"{sequence}/{number}")] = frame
    angles.require()
    return frames
