"""Writes a folder that labelCloud opens, one frame in memory at a time.

    [PART/]pointclouds/ID.ply   coloured clouds, z up; ID.png (or .jpg) is beside them, where labelCloud looks for it
    [PART/]labels/ID.json       the boxes, in the cloud's frame; _classes.json: classes and the form of all labels
    [PART/]calib/ID.txt         transform from the cloud's frame to the camera
    frames.csv                  the origin of each frame

labelCloud rotates its viewport, and by default also boxes, about z. Clouds are therefore written in the level frame at
the camera (x ahead, y left, z against gravity). Start labelCloud in the folder (or in the folder of a part).
"""

from __future__ import annotations

import colorsys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from scipy.spatial.transform import RigidTransform

from annotator.files import new_folder
from annotator.formats.dataset_writing import DatasetItem, FrameIds, encoded_image, writing
from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, dump_frames, has_frames
from annotator.formats.labelcloud.boxes import centroid_object, vertices_object
from annotator.formats.labelcloud.calibration import dump_calibration
from annotator.formats.labelcloud.model import (
    CENTROID_REL,
    CLASSES_FILE,
    VERTICES,
    ClassEntry,
    ClassesFile,
    Creator,
    LabelFile,
)
from annotator.formats.losses import Losses, Lost, count_lost
from annotator.formats.ply import write_ply
from annotator.geometry.projection import straightened
from annotator.geometry.transforms import level_pose
from annotator.types import Frame, PointCloud
from annotator.types.errors import FormatError

CLOUDS, LABELS, CALIBRATIONS = "pointclouds", "labels", "calib"
NOT_HELD = (Lost.SCORE, Lost.TRACK, Lost.STATE, Lost.ATTRIBUTE, Lost.SAID, Lost.LENS, Lost.TIME, Lost.ORIGIN)
LEVEL_FRAME = "level frame at the camera: x ahead, y left, z up, metres"
# Golden ratio: hues that differ by this fraction of the circle stay distinct for any number of classes.
GOLDEN = 0.618034


def write_labelcloud(
    out: Path,
    items: Iterable[DatasetItem],
    classes: Sequence[str],
    losses: Losses,
    version: str,
    *,
    vertices: bool = False,
    image_format: Literal["png", "jpg"] = "png",
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Writes the folder `out` atomically and returns the number of boxes of each class.

    Args:
        items: the frames, read one by one; if reading one raises, `out` is unchanged.
        classes: all class names, in order.
        losses: counts what the format cannot store.
        version: annotator's version.
        vertices: write boxes as corners instead of centre, sizes and angles.
        overwrite: replace an older export of this format.

    Raises:
        FormatError: `out` exists, there is no frame, a frame occurs twice, or writing fails.
    """
    ids, origins, counts = FrameIds(), list[FrameOrigin](), Counter[str]()
    with new_folder(out, lambda folder: overwrite and _is_dataset(folder)) as part:
        for item in items:
            count_lost(losses, item, NOT_HELD)
            if item.frame.up is None:
                losses.add(Lost.LEVEL)
            frame_id = ids.add(out, item)
            with writing(out):
                _write_frame(part / (item.split or ""), frame_id, item, vertices, image_format)
            origins.append(FrameOrigin(frame_id, item.recording, item.frame.key, item.split))
            counts.update(label.label for label in item.labels)
        if not origins:
            raise FormatError(out, "there is no frame to export; the export was not written")
        with writing(out):
            content = _classes(classes, VERTICES if vertices else CENTROID_REL, version)
            for split in dict.fromkeys(origin.split for origin in origins):
                (part / (split or "") / LABELS / CLASSES_FILE).write_text(content, encoding="utf-8")
            (part / FRAMES_CSV).write_text(dump_frames(origins), encoding="utf-8", newline="")
    return counts


def _is_dataset(folder: Path) -> bool:
    """True for an export of annotator: a project created in labelCloud has no frames.csv."""
    return has_frames(folder) and any(
        next(folder.glob(pattern), None) for pattern in (f"{LABELS}/{CLASSES_FILE}", f"*/{LABELS}/{CLASSES_FILE}")
    )


def _write_frame(
    folder: Path, frame_id: str, item: DatasetItem, vertices: bool, image_format: Literal["png", "jpg"]
) -> None:
    """Writes the frame's four files."""
    for name in (CLOUDS, LABELS, CALIBRATIONS):
        (folder / name).mkdir(parents=True, exist_ok=True)
    T_level_camera = level_pose(item.frame.up)
    camera, rgb = straightened(item.frame.camera, item.frame.rgb)
    (folder / CLOUDS / f"{frame_id}.{image_format}").write_bytes(encoded_image(rgb, image_format))
    write_ply(folder / CLOUDS / f"{frame_id}.ply", _level(item.frame, T_level_camera), LEVEL_FRAME)
    calibration = dump_calibration(camera, T_level_camera.inv())
    (folder / CALIBRATIONS / f"{frame_id}.txt").write_text(calibration, encoding="utf-8")
    dump = vertices_object if vertices else centroid_object
    content = LabelFile(
        folder=CLOUDS,
        filename=f"{frame_id}.ply",
        path=f"{CLOUDS}/{frame_id}.ply",
        objects=tuple(dump(label.label, label.box.transformed(T_level_camera)) for label in item.labels),
    )
    text = content.model_dump_json(indent=1, exclude_none=True) + "\n"
    (folder / LABELS / f"{frame_id}.json").write_text(text, encoding="utf-8")


def _level(frame: Frame, T_level_camera: RigidTransform) -> PointCloud:
    return replace(
        frame.cloud, xyz_m=T_level_camera.apply(frame.cloud.xyz_m).astype("float32"), pixel_index=None, normals=None
    )


def _classes(names: Sequence[str], form: str, version: str) -> str:
    """Returns the text of `_classes.json`; labelCloud needs at least one class."""
    entries = tuple(ClassEntry(name=name, id=number, color=_color(number)) for number, name in enumerate(names))
    content = ClassesFile(classes=entries, format=form, created_with=Creator(name="annotator", version=version))
    return content.model_dump_json(indent=1) + "\n"


def _color(number: int) -> str:
    red, green, blue = colorsys.hsv_to_rgb(number * GOLDEN % 1.0, 0.75, 1.0)
    return f"#{round(red * 255):02x}{round(green * 255):02x}{round(blue * 255):02x}"
