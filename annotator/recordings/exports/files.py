"""The files of an exported frame: image and cloud in the camera's frame; and JSON documents."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.file_names import OutsideError, inside
from annotator.files import read_file
from annotator.recordings.clouds.cloud_file import CLOUD_SUFFIXES, read_cloud
from annotator.recordings.image_file import read_color_image
from annotator.text import decoded
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

REMEDY = "export the dataset again"
# A document may describe a whole recording.
MOST_DOCUMENT_BYTES = 2**28


def read_document(path: Path) -> Any:
    """Returns the content of a JSON file.

    Raises:
        FrameError: it cannot be read, or is not JSON.
    """
    try:
        return json.loads(decoded(read_file(path, MOST_DOCUMENT_BYTES)))
    except (OSError, ValueError, RecursionError) as error:
        raise FrameError(path, f"cannot be read as JSON ({str(error)[:80]})", REMEDY) from error


def exported_files(folder: Path, names: Iterable[str]) -> tuple[Path, ...]:
    """Returns the paths of files that a document names.

    Raises:
        FrameError: one is outside the dataset.
    """
    try:
        return tuple(inside(folder, name) for name in names)
    except OutsideError as error:
        raise FrameError(folder, f"has a frame whose file {error}", REMEDY) from error


def exported_frame(
    key: str,
    index: int,
    files: tuple[Path, ...],
    camera: Camera,
    up: Float64[np.ndarray, "3"] | None,
    timestamp_ns: int | None,
    T_world_camera: RigidTransform | None,
) -> Frame:
    """Reads the image and the cloud of a frame.

    Args:
        files: image and cloud.

    Raises:
        FrameError: a file is missing or broken, or the image has another size than the camera.
    """
    image, cloud = files
    picture = read_color_image(image, (camera.width_px, camera.height_px))
    _check_size(image, picture.rgb, camera)
    if cloud.suffix.lower() not in CLOUD_SUFFIXES:
        raise FrameError(cloud, f"is none of {' '.join(CLOUD_SUFFIXES)}", REMEDY)
    raw = read_cloud(cloud)
    points = PointCloud(raw.xyz_m.astype(np.float32), rgb=raw.rgb, reflectance=raw.reflectance)
    return Frame(
        key,
        index,
        camera,
        picture.rgb,
        points,
        up=up,
        timestamp_ns=timestamp_ns,
        T_world_camera=T_world_camera,
        exif_orientation=picture.exif_orientation,
    )


def _check_size(path: Path, rgb: UInt8[np.ndarray, "h w 3"], camera: Camera) -> None:
    height, width = rgb.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise FrameError(
            path, f"has {width} x {height} pixels, but its camera {camera.width_px} x {camera.height_px}", REMEDY
        )
