"""Writes SUN RGB-D in the layout of VoteNet's extracted data, with the data set's own label table beside it.

image/ID.jpg  calib/ID.txt  depth/ID.mat  label/ID.txt  PART_data_idx.txt, `SUNRGBDMeta3DBB_v2.mat` (`meta_table.py`)
and frames.csv with the origin of each frame.

Clouds (`instance`: n x 6 float32, x y z metres, r g b in 0..1) and labels are in upright depth (`upright_depth.py`).
A label row is (`votenet/sunrgbd/sunrgbd_utils.py`, `SUNObject3d`)

    class xmin ymin width height cx cy cz half_width half_length half_height ox oy

with pixels counted from 1 and the length along (ox, oy); its box is upright. A calib file has `Rtilt` and `K` on one
line each, column by column. IDs have six digits; index lists store them as numbers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import RigidTransform

from annotator.files import new_folder
from annotator.formats.dataset_writing import DatasetItem, encoded_image, writing
from annotator.formats.frame_class_names import CLASS_NAMES, ClassWords
from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, dump_frames, has_frames
from annotator.formats.losses import Losses, Lost, count_lost
from annotator.formats.sunrgbd.meta_table import META, MetaRow, dump_meta, meta_frame
from annotator.formats.sunrgbd.upright_depth import FIRST_PX, one_based_matrix, tilt_matrix, upright_frame
from annotator.geometry.oriented_box import nearest_upright
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import project, straightened
from annotator.types import Box2D, Camera, Frame, OrientedBox
from annotator.types.errors import FormatError

PARTS = ("image", "calib", "depth", "label")
INDEX = "{}_data_idx.txt"
NOT_HELD = (
    Lost.SCORE,
    Lost.TRACK,
    Lost.STATE,
    Lost.ATTRIBUTE,
    Lost.SAID,
    Lost.LENS,
    Lost.REFLECTANCE,
    Lost.TIME,
    Lost.ORIGIN,
)
UP = np.array([0.0, 0.0, 1.0])
# Minimum side of a 2D box, pixels; objects that are narrower on the image are left out.
LEAST_SIDE_PX = 0.01
LEAST_HALF_M = 1e-6


def write_sunrgbd(
    out: Path,
    items: Iterable[DatasetItem],
    ids: Mapping[tuple[str, str], str],
    classes: Sequence[str],
    losses: Losses,
    *,
    overwrite: bool = False,
) -> Counter[str]:
    """Writes the folder `out` atomically, with one frame and the labels of all frames in memory.

    Arguments, result and errors as in `kitti.object_folder.write_kitti`, except that parts may have any name. Only the
    table stores tilted boxes.
    """
    from scipy.io import savemat

    words, counts, origins = ClassWords(classes), Counter[str](), list[FrameOrigin]()
    table: list[MetaRow] = []
    with new_folder(out, lambda folder: overwrite and _is_dataset(folder)) as part:
        with writing(out):
            for name in PARTS:
                (part / name).mkdir()
        for item in items:
            origin = FrameOrigin(ids[item.recording, item.frame.key], item.recording, item.frame.key, item.split)
            origins.append(origin)
            count_lost(losses, item, NOT_HELD)
            with writing(out):
                table.append(_write_frame(part, origin, item, words, counts, losses))
        if not origins:
            raise FormatError(out, "there is no frame to export; the export was not written")
        with writing(out):
            savemat(str(part / META), dump_meta(table), do_compression=True)
            _write_lists(part, origins)
            (part / FRAMES_CSV).write_text(dump_frames(origins), encoding="utf-8", newline="")
            if changed := words.dump():
                (part / CLASS_NAMES).write_text(changed, encoding="utf-8")
    return counts


def dump_label_row(label: str, box: OrientedBox, on_image: Box2D) -> str:
    """Returns a label row, which `labels.extracted_truth` reads.

    Args:
        label: one word.
        box: in upright depth, z up.
        on_image: its 2D box, pixels counted from 0.
    """
    length, width, height = np.maximum(box.size_m / 2, LEAST_HALF_M)
    corner = (on_image.x_min + FIRST_PX, on_image.y_min + FIRST_PX)
    numbers = (*corner, on_image.width_px, on_image.height_px, *box.center_m, width, length, height)
    # more digits: the heading is normalised when read, and must not rotate with each round trip
    heading = box.rotation[:2, 0]
    return " ".join([label, *(_decimal(value, 6) for value in numbers), *(_decimal(value, 9) for value in heading)])


def _decimal(value: float, digits: int) -> str:
    # no "-0.000000", so that reading and writing a file leaves it unchanged
    return f"{round(float(value), digits) + 0.0:.{digits}f}"


def calibration_text(camera: Camera, T_camera_upright: RigidTransform) -> str:
    """Returns the text of `calib/ID.txt` for an ideal camera."""
    matrices = (tilt_matrix(T_camera_upright), one_based_matrix(camera))
    return "".join(" ".join(f"{value:.12g}" for value in matrix.T.ravel()) + "\n" for matrix in matrices)


def _is_dataset(folder: Path) -> bool:
    """True for an export of annotator: VoteNet's folders have no frames.csv."""
    return has_frames(folder) and (folder / META).is_file() and (folder / "label").is_dir()


def _write_frame(
    part: Path, origin: FrameOrigin, item: DatasetItem, words: ClassWords, counts: Counter[str], losses: Losses
) -> MetaRow:
    """Writes the frame's four files; returns its element of the table."""
    from scipy.io import savemat

    frame, stem = item.frame, origin.id
    camera, rgb = straightened(frame.camera, frame.rgb)
    T = upright_frame(frame)
    if frame.up is None:
        losses.add(Lost.LEVEL)
    (part / "image" / f"{stem}.jpg").write_bytes(encoded_image(rgb, "jpg"))
    (part / "calib" / f"{stem}.txt").write_text(calibration_text(camera, T), encoding="utf-8")
    # compressed as in the data set, which halves the size
    points = upright_points(frame, T, camera, rgb)
    savemat(str(part / "depth" / f"{stem}.mat"), {"instance": points}, do_compression=True)
    rows, boxes = [], []
    for label in item.labels:
        box = label.box.transformed(T.inv())
        upright, tilt_rad = nearest_upright(box, UP)
        on_image = box_on_image(camera, upright.transformed(T), label.label, LEAST_SIDE_PX)
        if on_image is None:
            losses.add(Lost.OUTSIDE)
            continue
        losses.add_tilt(tilt_rad)
        if words.is_changed(label.label):
            losses.add(Lost.NAME)
        counts[label.label] += 1
        rows.append(dump_label_row(words[label.label], upright, on_image) + "\n")
        boxes.append((label.label, box, on_image))
    (part / "label" / f"{stem}.txt").write_text("".join(rows), encoding="utf-8")
    return meta_frame(origin.name, (f"depth/{stem}.mat", f"image/{stem}.jpg"), camera, T, boxes)


def upright_points(
    frame: Frame, T_camera_upright: RigidTransform, camera: Camera, rgb: np.ndarray
) -> Float32[np.ndarray, "n 6"]:
    """Returns `instance` of a frame: points in upright depth and their colours.

    Clouds without colours get those of the image; points outside the image are black.

    Args:
        camera, rgb: the ideal camera and its image.
    """
    xyz = T_camera_upright.inv().apply(frame.cloud.xyz_m.astype(np.float64))
    colors = frame.cloud.rgb
    if colors is None:
        px = np.nan_to_num(np.rint(project(camera, frame.cloud.xyz_m)), nan=-1.0)
        inside = ((px >= 0) & (px < [camera.width_px, camera.height_px])).all(axis=1)
        colors = np.zeros((len(xyz), 3), np.uint8)
        u, v = px[inside].astype(np.int64).T
        colors[inside] = rgb[v, u]
    return np.column_stack([xyz, colors / 255.0]).astype(np.float32)


def _write_lists(part: Path, origins: Sequence[FrameOrigin]) -> None:
    """Writes the frame numbers of each part, one per line; without parts all are in train."""
    parts: dict[str, list[str]] = {}
    for origin in origins:
        parts.setdefault(origin.split or "train", []).append(f"{int(origin.id)}\n")
    for name, numbers in parts.items():
        (part / INDEX.format(name)).write_text("".join(numbers), encoding="utf-8")
