"""Writes a dataset that the nuscenes-devkit opens, one frame in memory at a time.

    v1.0-annotator/*.json            the tables; splits.json names the scenes of each part
    samples/CAM_FRONT/ID.png         rectified images (or .jpg)
    samples/LIDAR_TOP/ID.pcd.bin     clouds
    maps/none.png                    the map that the tables require: one black pixel
    frames.csv                       the origin of each frame

Scenes are recordings, instances are tracks. Ego and LiDAR frame are the same: the level frame at the camera (x ahead, y
left, z against gravity). The global frame is that of the recording's map coordinates; without such, it is the ego
frame, because the camera's motion is unknown.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import SerializeAsAny, TypeAdapter

from annotator.files import new_folder
from annotator.formats.dataset_writing import DatasetItem, FrameIds, encoded_image, writing
from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, dump_frames, has_frames
from annotator.formats.losses import Losses, Lost, count_lost
from annotator.formats.nuscenes.shapes import scan
from annotator.formats.nuscenes.tables import CAMERA, LIDAR, MAP_FILE, Tables
from annotator.geometry.projection import straightened
from annotator.geometry.transforms import level_pose
from annotator.nuscenes_tables import Record
from annotator.types.errors import FormatError

VERSION = "v1.0-annotator"
SPLITS = "splits.json"
NOT_HELD = (Lost.SCORE, Lost.STATE, Lost.SAID, Lost.LENS, Lost.DEPTH_COLOR)
_ROWS = TypeAdapter(list[SerializeAsAny[Record]])


def write_nuscenes(
    out: Path,
    items: Iterable[DatasetItem],
    classes: Sequence[str],
    losses: Losses,
    *,
    image_format: Literal["png", "jpg"] = "png",
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Writes the folder `out` atomically and returns the number of boxes of each class.

    Args:
        items: the frames of each recording in order, read one by one; if reading one raises, `out` is unchanged.
        classes: all class names, in order.
        losses: counts what the format cannot store.
        overwrite: replace an older export of this format.

    Raises:
        FormatError: `out` exists, there is no frame, a frame occurs twice, or writing fails.
    """
    ids, origins, counts = FrameIds(), list[FrameOrigin](), Counter[str]()
    tables = Tables(classes)
    with new_folder(out, lambda folder: overwrite and _is_dataset(folder)) as part:
        with writing(out):
            for folder in (VERSION, f"samples/{CAMERA}", f"samples/{LIDAR}", "maps"):
                (part / folder).mkdir(parents=True)
            (part / MAP_FILE).write_bytes(_black_pixel())
        for item in items:
            count_lost(losses, item, NOT_HELD)
            losses.add_values(item.attributes)
            if item.frame.up is None:
                losses.add(Lost.LEVEL)
            frame_id = ids.add(out, item)
            files = {
                CAMERA: f"samples/{CAMERA}/{frame_id}.{image_format}",
                LIDAR: f"samples/{LIDAR}/{frame_id}.pcd.bin",
            }
            T_level_camera = level_pose(item.frame.up)
            camera, rgb = straightened(item.frame.camera, item.frame.rgb)
            with writing(out):
                (part / files[CAMERA]).write_bytes(encoded_image(rgb, image_format))
                (part / files[LIDAR]).write_bytes(scan(item.frame.cloud, T_level_camera).tobytes())
            tables.add(item, camera, T_level_camera, files)
            origins.append(FrameOrigin(frame_id, item.recording, item.frame.key, item.split))
            counts.update(label.label for label in item.labels)
        if not origins:
            raise FormatError(out, "there is no frame to export; the export was not written")
        with writing(out):
            _write_tables(part / VERSION, tables)
            (part / FRAMES_CSV).write_text(dump_frames(origins), encoding="utf-8", newline="")
    return counts


def _black_pixel() -> bytes:
    """Returns the PNG file of a map without content."""
    import cv2

    _, data = cv2.imencode(".png", np.zeros((1, 1), np.uint8))
    return bytes(data.tobytes())


def _write_tables(folder: Path, tables: Tables) -> None:
    for name, rows in tables.finish().items():
        (folder / f"{name}.json").write_bytes(_ROWS.dump_json(list(rows), indent=0) + b"\n")
    splits: dict[str, list[str]] = {}
    for (_, split), name in tables.scene_names().items():
        if split is not None:
            splits.setdefault(split, []).append(name)
    if splits:
        (folder / SPLITS).write_text(json.dumps(splits, indent=1) + "\n", encoding="utf-8")


def _is_dataset(folder: Path) -> bool:
    """True for an export of annotator: nuScenes itself has no frames.csv."""
    return has_frames(folder) and (folder / VERSION / "sample.json").is_file()
