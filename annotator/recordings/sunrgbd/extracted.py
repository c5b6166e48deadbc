"""SUN RGB-D in VoteNet's layout: unrelated single frames.

image/KEY.jpg  calib/KEY.txt  depth/KEY.mat (`instance`: n x 6, x y z r g b)  or  points/KEY.npz
[label/KEY.txt, read by annotator.formats]
Clouds and labels are in the frame "upright depth" (`calibration.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float32, Int32

from annotator.file_names import spelled
from annotator.files import open_file
from annotator.frame_limits import VARIABLE, frame_memory
from annotator.geometry.projection import project
from annotator.mat_file import MatFileError, MatSizeError, read_mat
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.clouds.columns import RawCloud, from_columns
from annotator.recordings.image_file import read_color_image
from annotator.recordings.listing import IMAGE_SUFFIXES, frame_file, joined, sorted_keys, stems, unread_note
from annotator.recordings.recording import KeyedFrames, NotFound
from annotator.recordings.sunrgbd.calibration import read_extracted_calibration
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

LOOKED_FOR = "folders image/, calib/ and depth/ (with .mat files) or points/ (.npz)"
# What is read here and by annotator.formats.
READ = ("image", "calib", "depth", "points", "label", "*_data_idx.txt", "SUNRGBDMeta*.mat", "frames.csv", "classes.txt")
CLOUD_REMEDY = "extract it again from the data set"
# A cloud is organised if its points project to pixel centres within this distance.
ON_PIXEL_PX = 0.05
# About ten million points.


@dataclass(frozen=True, eq=False)
class SunRgbdExtracted(KeyedFrames):
    """A `Recording` of VoteNet's layout.

    Attributes:
        clouds: the folder of the clouds.
    """

    clouds: Path
    format: ClassVar[str] = "sunrgbd_extracted"
    is_sequence: ClassVar[bool] = False

    @property
    def notes(self) -> tuple[str, ...]:
        note = unread_note(self.path, READ, "label/KEY.txt")
        return () if note is None else (note,)

    def files(self, i: int) -> tuple[Path, Path]:
        key, suffix = self.key(i), ".mat" if self.clouds.name == "depth" else ".npz"
        image = frame_file(self.path / "image", key, IMAGE_SUFFIXES, f"{self.clouds.name}/{key}{suffix}")
        return image, frame_file(self.clouds, key, (suffix,), f"image/{image.name}")

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; labels are in upright depth (`T_camera_label`).

        `depth_m` and `pixel_index` are set if each point has a pixel of its own.

        Raises:
            FrameError: a missing or broken file.
            IndexError: there is no such frame.
        """
        key, (image_path, cloud_path) = self.key(i), self.files(i)
        calibration = read_extracted_calibration(spelled(self.path / "calib", f"{key}.txt"))
        image = read_color_image(image_path, has_depth=True)
        rgb = image.rgb
        camera = calibration.camera(rgb.shape[1], rgb.shape[0])
        raw = _read_mat(cloud_path) if cloud_path.suffix.lower() == ".mat" else read_cloud(cloud_path)
        xyz_m = calibration.T_camera_upright.apply(raw.xyz_m)
        cloud, depth_m = _organised(camera, xyz_m, raw, rgb)
        return Frame(
            key,
            i,
            camera,
            rgb,
            cloud,
            depth_m,
            calibration.up,
            calibration.T_camera_upright,
            exif_orientation=image.exif_orientation,
        )


def open_sunrgbd_extracted(path: Path) -> SunRgbdExtracted | NotFound:
    """Opens the folder in VoteNet's layout at `path`; `NotFound` if it is not one.

    Raises:
        RecordingError: the folders exist but have no frame.
    """
    if not ((path / "image").is_dir() and (path / "calib").is_dir()):
        return NotFound(LOOKED_FOR)
    for clouds, suffix in ((path / "depth", ".mat"), (path / "points", ".npz")):
        names = stems(clouds, (suffix,)) if clouds.is_dir() else set()
        calibrated = stems(path / "calib", (".txt",)) if names else set()
        # a cloud folder with KITTI's calibration differs only in the content of calib/
        if names and calibrated and not _is_kitti(path / "calib" / f"{min(calibrated)}.txt"):
            keys = joined(names, stems(path / "image", IMAGE_SUFFIXES))
            return SunRgbdExtracted(path, sorted_keys(path, keys, LOOKED_FOR), clouds)
    return NotFound(LOOKED_FOR)


def _is_kitti(path: Path) -> bool:
    with open_file(path) as file:
        return b":" in file.read(200)


def _read_mat(path: Path) -> RawCloud:
    """Reads the cloud of a MATLAB file of version 5 to 7.

    Raises:
        FrameError: the file is damaged, or has no `instance` of n x 6 numbers.
    """
    try:
        table = read_mat(path, "instance", frame_memory() // 2, numbers_only=True)
    except OSError as error:
        raise FrameError(path, f"cannot be read ({error.strerror})", CLOUD_REMEDY) from error
    except MatSizeError as error:
        raise FrameError(path, f"is too large: it {error}", f"raise {VARIABLE} (MiB), or save fewer points") from error
    except MatFileError as error:
        raise FrameError(path, f"cannot be read as a MATLAB file: it {error}", CLOUD_REMEDY) from error
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] != 6:
        raise FrameError(path, "has no variable `instance` of n x 6 numbers (x y z r g b)", CLOUD_REMEDY)
    return from_columns(path, dict(zip(("x", "y", "z", "red", "green", "blue"), table.T, strict=True)))


def _organised(
    camera: Camera, xyz_m: np.ndarray, raw: RawCloud, rgb: np.ndarray
) -> tuple[PointCloud, Float32[np.ndarray, "h w"] | None]:
    """Returns the cloud in the camera frame, and its depth image if it is organised (else None)."""
    xyz = xyz_m.astype(np.float32)
    px = project(camera, xyz_m)
    nearest = np.rint(px)
    size = np.array([camera.width_px, camera.height_px])
    with np.errstate(invalid="ignore"):
        on_pixel = (np.abs(px - nearest) < ON_PIXEL_PX).all(axis=1) & ((nearest >= 0) & (nearest < size)).all(axis=1)
    if not on_pixel.all():
        return PointCloud(xyz, rgb=_colors(raw, px, rgb), reflectance=raw.reflectance), None
    pixel: Int32[np.ndarray, "n"] = (nearest[:, 1] * camera.width_px + nearest[:, 0]).astype(np.int32)
    depth_m = np.zeros(camera.height_px * camera.width_px, np.float32)
    depth_m[pixel] = xyz[:, 2]
    if np.count_nonzero(depth_m) < len(pixel):
        return PointCloud(xyz, rgb=_colors(raw, px, rgb), reflectance=raw.reflectance), None
    cloud = PointCloud(xyz, rgb=_colors(raw, px, rgb), reflectance=raw.reflectance, pixel_index=pixel)
    return cloud, depth_m.reshape(camera.height_px, camera.width_px)


def _colors(raw: RawCloud, px: np.ndarray, rgb: np.ndarray) -> np.ndarray | None:
    """Returns the points' colours, else those of their pixels; None if a point has no pixel."""
    if raw.rgb is not None:
        return raw.rgb
    if not np.isfinite(px).all():
        return None
    u, v = np.clip(np.rint(px), 0, np.array(rgb.shape[1::-1]) - 1).astype(np.int64).T
    return rgb[v, u]
