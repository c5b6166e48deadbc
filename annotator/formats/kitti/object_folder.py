"""Writes a KITTI object folder for training 3D detectors.

training/image_2/ID.png  velodyne/ID.bin  calib/ID.txt  label_2/ID.txt,  ImageSets/{train,val,test,trainval}.txt, and
frames.csv with the origin of each frame.

Scans (float32 x y z reflectance; x forward, y left, z up; reflectance 0 if unknown) have their origin at rectified
camera 0 (x right, y down, z forward), and P2 = K [I | t] shifts that camera to the colour camera:
`px = P2 * R0_rect * Tr_velo_to_cam * X_lidar` with R0_rect the identity (KITTI object devkit, readme.txt). All images
are in `training/`, including those of the part `test`, because their labels are known.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import RigidTransform

from annotator.files import new_folder
from annotator.formats.attributes import TRUNCATION, held_by_kitti
from annotator.formats.dataset_writing import DatasetItem, encoded_image, writing
from annotator.formats.frame_class_names import CLASS_NAMES, ClassWords
from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, dump_frames, has_frames
from annotator.formats.kitti.box_rows import (
    is_in_image,
    label_frame,
    rounded_box,
    upright_box,
    upright_row,
)
from annotator.formats.kitti.label_files import DECIMALS, DONT_CARE, KittiLabel, dump_label_line
from annotator.formats.losses import Losses, Lost, count_lost
from annotator.geometry.occlusion import Sight
from annotator.geometry.projection import straightened
from annotator.types import Camera, Frame, Label, PointCloud
from annotator.types.errors import ConfigError, FormatError

PARTS = ("image_2", "velodyne", "calib", "label_2")
TRAINING, IMAGE_SETS = "training", "ImageSets"
# KITTI's names of the parts; trainval.txt lists train and val.
SPLITS = ("train", "val", "test")
TEST = SPLITS[-1]
NOT_HELD = (
    Lost.SCORE,
    Lost.TRACK,
    Lost.STATE,
    Lost.SAID,
    Lost.LENS,
    Lost.DEPTH_COLOR,
    Lost.TIME,
    Lost.GRAVITY,
    Lost.ORIGIN,
)
# Rectified camera 0 <- LiDAR: x right = -y left, y down = -z up, z forward = x.
CAMERA_LIDAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def write_kitti(
    out: Path,
    items: Iterable[DatasetItem],
    ids: Mapping[tuple[str, str], str],
    classes: Sequence[str],
    losses: Losses,
    *,
    areas: Callable[[DatasetItem], Sequence[KittiLabel]] = lambda item: (),
    overwrite: bool = False,
) -> Counter[str]:
    """Writes the folder `out` atomically, one frame in memory at a time.

    Args:
        out: a folder that is missing or empty; with `overwrite`, an older export of this format is replaced.
        items: the frames; if reading one raises, `out` is unchanged.
        ids: the file name of each (recording, key) (`six_digit_ids`).
        classes: all class names.
        losses: counts what the format cannot store.
        areas: returns the DontCare rows of a frame, which are written after its labels.

    Returns:
        The number of boxes written, by class.

    Raises:
        FormatError: `out` exists, there is no frame, or writing fails.
        ConfigError: a part that KITTI does not have.
    """
    words, counts, origins = ClassWords(classes, reserved=(DONT_CARE,)), Counter[str](), list[FrameOrigin]()
    with new_folder(out, lambda folder: overwrite and _is_dataset(folder)) as part:
        with writing(out):
            for name in PARTS:
                (part / TRAINING / name).mkdir(parents=True)
        for item in items:
            _check_part(item.split)
            frame_id = ids[item.recording, item.frame.key]
            origins.append(FrameOrigin(frame_id, item.recording, item.frame.key, item.split))
            rows = _rows(item, words, counts, losses) + "".join(f"{dump_label_line(x)}\n" for x in areas(item))
            with writing(out):
                _write_frame(part / TRAINING, frame_id, item.frame, rows)
        if not origins:
            raise FormatError(out, "there is no frame to export; the export was not written")
        with writing(out):
            _write_sets(part / IMAGE_SETS, origins)
            (part / FRAMES_CSV).write_text(dump_frames(origins), encoding="utf-8", newline="")
            if changed := words.dump():
                (part / CLASS_NAMES).write_text(changed, encoding="utf-8")
    return counts


def _check_part(name: str | None) -> None:
    """Raises ConfigError for a part that KITTI does not have, since KITTI's tools would ignore it."""
    if name is not None and name not in SPLITS:
        raise ConfigError(
            f"KITTI's parts are called {', '.join(SPLITS)}, not {name}; split the dataset with "
            "--split train=0.8,val=0.2"
        )


def _is_dataset(folder: Path) -> bool:
    """True for an export of annotator: KITTI's own folders have no frames.csv."""
    return has_frames(folder) and (folder / TRAINING / "label_2").is_dir()


def _rows(item: DatasetItem, words: ClassWords, counts: Counter[str], losses: Losses) -> str:
    """Returns the text of a frame's label file and counts its losses."""
    count_lost(losses, item, NOT_HELD)
    return "".join(f"{dump_label_line(row)}\n" for _, row in item_rows(item, words, counts, losses))


def item_rows(
    item: DatasetItem, words: ClassWords, counts: Counter[str], losses: Losses, *, levels: bool = False
) -> Iterator[tuple[Label, KittiLabel]]:
    """Yields the labels inside the image with their rows, and counts boxes and losses.

    All fields of a row follow from its rounded 3D box, so the row is consistent when read back; but truncation and
    occlusion are those of the label's attributes, if it has them.

    Args:
        levels: the truncation is going to be written as a level, as in tracking files.
    """
    sight = Sight(item.frame.cloud.xyz_m)
    losses.add_values(item.attributes)
    for label in item.labels:
        upright, tilt_rad = upright_box(label.box, item.frame)
        rounded = rounded_box(upright)
        row = upright_row(words[label.label], rounded, None, item.frame, sight, label.attributes)
        if not is_in_image(row):
            losses.add(Lost.OUTSIDE)
            continue
        losses.add_tilt(tilt_rad)
        losses.add_rounding(upright, rounded)
        held = held_by_kitti(label.attributes)
        losses.add_values(label.attributes.keys() - held.keys())
        losses.add_values(_approximated(held, levels))
        if words.is_changed(label.label):
            losses.add(Lost.NAME)
        counts[label.label] += 1
        yield label, row


def _approximated(held: Mapping[str, float], levels: bool) -> Iterator[str]:
    """Yields what happens to values that are not written as they are."""
    for name, value in held.items():
        if levels and name == TRUNCATION:
            # only "not truncated" is read again as a share
            if value != 0:
                yield f"{name}, as a level"
        elif round(value, DECIMALS) != value:
            yield f"{name}, rounded"


def _write_frame(training: Path, frame_id: str, frame: Frame, rows: str) -> None:
    """Writes the frame's four files."""
    camera, rgb = straightened(frame.camera, frame.rgb)
    T = label_frame(frame)
    (training / "image_2" / f"{frame_id}.png").write_bytes(encoded_image(rgb, "png"))
    (training / "velodyne" / f"{frame_id}.bin").write_bytes(lidar_points(frame.cloud, T).tobytes())
    (training / "calib" / f"{frame_id}.txt").write_text(calibration_text(camera, T), encoding="utf-8")
    (training / "label_2" / f"{frame_id}.txt").write_text(rows, encoding="utf-8")


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
    P0, P2 = np.hstack([K, still]), np.column_stack([K, K @ shift])
    matrices = {
        "P0": P0,
        "P1": P0,
        "P2": P2,
        "P3": P2,
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": np.hstack([CAMERA_LIDAR, still]),
        "Tr_imu_to_velo": np.eye(3, 4),
    }
    # + 0.0: no negative zeros
    return "".join(
        f"{name}: {' '.join(f'{value + 0.0:.12e}' for value in matrix.ravel())}\n" for name, matrix in matrices.items()
    )


def _write_sets(folder: Path, origins: Sequence[FrameOrigin]) -> None:
    """Writes the frame ids of each part, one per line; without parts all are in train and trainval."""
    folder.mkdir()
    parts: dict[str, list[str]] = {}
    for origin in origins:
        parts.setdefault(origin.split or "train", []).append(origin.id)
    parts["trainval"] = [origin.id for origin in origins if origin.split != TEST]
    for name, ids in parts.items():
        (folder / f"{name}.txt").write_text("".join(f"{each}\n" for each in ids), encoding="utf-8")
