"""SUN RGB-D recordings: VoteNet's extraction, and raw scenes; unrelated single frames.

extracted  image/KEY.jpg  calib/KEY.txt  depth/KEY.mat (`instance`: n x 6, x y z r g b)  or  points/KEY.npz
           [label/KEY.txt, read by annotator.formats]
scenes     one folder with one frame each; or any folder above them, such as the whole data set
           SCENE/intrinsics.txt  SCENE/image/*.jpg  SCENE/depth/*.png  SCENE/depth_bfx/*.png  SCENE/extrinsics/*.txt
           [SCENE/annotation3Dfinal/index.json, read by annotator.formats]

The data set counts pixels from 1, so 1 is subtracted from its principal point. Labels and extracted clouds are in the
frame "upright depth": x right, y forward, z up, origin at the camera, tilt removed. A camera's point is mapped there
by `Rtilt * [X, Z, -Y]`. Raw scenes have extrinsics E instead, with `Rtilt = A E B`; A and B only convert between
camera axes and upright axes, so E alone levels the camera (SUNRGBDtoolbox, `readframeSUNRGBD.m`).

Of raw scenes, the sensor's own depth images (`depth/`) are read, as in VoteNet; those with filled holes (`depth_bfx/`)
only if `depth/` has none.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.fenced_files import read_mat
from annotator.files import open_file
from annotator.frame_limits import VARIABLE, frame_memory
from annotator.geometry.projection import pixel_colors, project, unproject_depth
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.clouds.columns import RawCloud, from_columns
from annotator.recordings.image_file import ColorImage, decode_depth, read_color_image, read_depth
from annotator.recordings.kitti import calibration_text, matrix_of
from annotator.recordings.listing import (
    IMAGE_SUFFIXES,
    file_errors,
    frame_file,
    joined,
    path_errors,
    require_size,
    sorted_keys,
    stems,
)
from annotator.recordings.plausible import is_pinhole, is_rotation, pinhole
from annotator.recordings.recording import Recording
from annotator.text import spelled
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

REMEDY = "copy the calibration again from the data set"
# From camera axes (x right, y down, z forward) to upright ones (x right, y forward, z up), both without tilt.
UPRIGHT_OF_LEVEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
MOST_OFF_ROTATION = 1e-2
# Of K: pixels are counted from 1.
FIRST_PIXEL = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 0]])


@dataclass(frozen=True, eq=False)
class SunCalibration:
    """The camera of one frame.

    Attributes:
        matrix: (3, 3) K, pixels counted from 1.
        T_camera_upright: from upright depth to the camera.
    """

    matrix: Float64[np.ndarray, "3 3"]
    T_camera_upright: RigidTransform

    def camera(self, width_px: int, height_px: int) -> Camera:
        return pinhole(self.matrix - FIRST_PIXEL, width_px, height_px)

    @property
    def up(self) -> Float64[np.ndarray, "3"]:
        """The unit vector against gravity, in the camera frame."""
        return np.asarray(self.T_camera_upright.rotation.apply([0.0, 0.0, 1.0]))


def read_extracted_calibration(path: Path) -> SunCalibration:
    """Reads a `calib/KEY.txt`: a line of Rtilt and a line of K, both column by column."""
    lines = [line for line in calibration_text(path).splitlines() if line.strip()]
    if len(lines) < 2:
        raise FrameError(path, f"must have two lines, Rtilt and K, not {len(lines)}", REMEDY)
    Rtilt, K = (
        matrix_of(path, name, line.split(), (3, 3)).T for name, line in zip(("Rtilt", "K"), lines, strict=False)
    )
    return _calibration(path, K, Rtilt @ UPRIGHT_OF_LEVEL)


def read_scene_calibration(intrinsics: Path, extrinsics: Path) -> SunCalibration:
    """Reads the calibration of a raw scene: K, and a 3 x 4 matrix whose first three columns are E; row by row."""
    K = matrix_of(intrinsics, "K", calibration_text(intrinsics).split(), (3, 3))
    E = matrix_of(extrinsics, "the matrix", calibration_text(extrinsics).split(), (3, 4))[:, :3]
    return _calibration(intrinsics, K, UPRIGHT_OF_LEVEL @ E, extrinsics)


def _calibration(path: Path, K: np.ndarray, R: np.ndarray, of_tilt: Path | None = None) -> SunCalibration:
    """Builds the calibration; `R` turns camera axes to upright ones, and may be of another file, `of_tilt`."""
    if not is_rotation(R, MOST_OFF_ROTATION):
        raise FrameError(of_tilt or path, "the tilt is not a rotation", REMEDY)
    if not is_pinhole(K):
        raise FrameError(path, "K is not a pinhole camera (fx 0 cx / 0 fy cy / 0 0 1)", REMEDY)
    return SunCalibration(K, RigidTransform.from_rotation(Rotation.from_matrix(R.T)))


# A cloud is organised if its points project to pixel centres within this distance.
ON_PIXEL_PX = 0.05


@dataclass(frozen=True, eq=False)
class SunRgbdExtracted(Recording):
    """A `Recording` of VoteNet's layout."""

    clouds: Path
    format: ClassVar[str] = "sunrgbd_extracted"
    is_sequence: ClassVar[bool] = False

    def files(self, i: int) -> tuple[Path, Path]:
        key, suffix = self.key(i), ".mat" if self.clouds.name == "depth" else ".npz"
        image = frame_file(self.path / "image", key, IMAGE_SUFFIXES, f"{self.clouds.name}/{key}{suffix}")
        return image, frame_file(self.clouds, key, (suffix,), f"image/{image.name}")

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; labels are in upright depth (`T_camera_label`).

        `depth_m` and `pixel_index` are set if each point has a pixel of its own.
        """
        key, (image_path, cloud_path) = self.key(i), self.files(i)
        calibration = read_extracted_calibration(spelled(self.path / "calib", f"{key}.txt"))
        image = read_color_image(image_path, has_depth=True)
        rgb = image.rgb
        camera = calibration.camera(rgb.shape[1], rgb.shape[0])
        raw = _read_mat(cloud_path) if cloud_path.suffix.lower() == ".mat" else read_cloud(cloud_path)
        xyz_m = calibration.T_camera_upright.apply(raw.xyz_m)
        cloud, depth_m = _organised(camera, xyz_m, raw, rgb)
        return _frame(key, i, calibration, image, cloud, depth_m)


def _frame(
    key: str, i: int, calibration: SunCalibration, image: ColorImage, cloud: PointCloud, depth_m: np.ndarray | None
) -> Frame:
    camera, up = calibration.camera(*image.rgb.shape[1::-1]), calibration.up
    return image.frame(key, i, camera, cloud, depth_m=depth_m, up=up, T_camera_label=calibration.T_camera_upright)


def open_sunrgbd_extracted(path: Path) -> SunRgbdExtracted | None:
    """Opens the folder in VoteNet's layout at `path`; None if it is not one."""
    if not ((path / "image").is_dir() and (path / "calib").is_dir()):
        return None
    for clouds, suffix in ((path / "depth", ".mat"), (path / "points", ".npz")):
        names = stems(clouds, (suffix,)) if clouds.is_dir() else set()
        calibrated = stems(path / "calib", (".txt",)) if names else set()
        # a cloud folder with KITTI's calibration differs only in the content of calib/
        if names and calibrated and not _is_kitti(path / "calib" / f"{min(calibrated)}.txt"):
            keys = joined(names, stems(path / "image", IMAGE_SUFFIXES))
            return SunRgbdExtracted(path, sorted_keys(path, keys, "image/KEY.jpg"), clouds)
    return None


def _is_kitti(path: Path) -> bool:
    with open_file(path) as file:
        return b":" in file.read(200)


def _read_mat(path: Path) -> RawCloud:
    with file_errors(path, f"extract it again from the data set, or raise {VARIABLE}"):
        table = read_mat(path, "instance", frame_memory() // 2)
        if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] != 6:
            raise ValueError("has no variable `instance` of n x 6 numbers (x y z r g b)")
        return from_columns(dict(zip(("x", "y", "z", "red", "green", "blue"), table.T, strict=True)))


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
    depth_m, pixel = np.zeros(camera.height_px * camera.width_px, np.float32), None
    if on_pixel.all():
        pixel = (nearest[:, 1] * camera.width_px + nearest[:, 0]).astype(np.int32)
        depth_m[pixel] = xyz[:, 2]
    is_organised = pixel is not None and np.count_nonzero(depth_m) == len(pixel)
    cloud = PointCloud(xyz, _colors(raw, px, rgb), raw.reflectance, pixel if is_organised else None)
    return cloud, depth_m.reshape(camera.height_px, camera.width_px) if is_organised else None


def _colors(raw: RawCloud, px: np.ndarray, rgb: np.ndarray) -> np.ndarray | None:
    """Returns the points' colours, else those of their pixels; None if a point has no pixel."""
    if raw.rgb is not None:
        return raw.rgb
    if not np.isfinite(px).all():
        return None
    u, v = np.clip(np.rint(px), 0, np.array(rgb.shape[1::-1]) - 1).astype(np.int64).T
    return rgb[v, u]


MARK = "intrinsics.txt"
# The data set's top folders, one per camera. They are searched several levels deep, any other folder only one level.
CAMERA_FOLDERS = frozenset({"kv1", "kv2", "realsense", "xtion"})
MOST_LEVELS = 5
SCENE_MARKS = ("image", "extrinsics")
DEPTH_FOLDERS = ("depth", "depth_bfx")
KEY_SEPARATOR = "__"


@dataclass(frozen=True, eq=False)
class SunRgbdScenes(Recording):
    """A `Recording` of raw scenes, unrelated to each other. A frame's key is its scene's path, with `__` for `/`."""

    folders: dict[str, str] = field(repr=False)
    format: ClassVar[str] = "sunrgbd_scenes"
    is_sequence: ClassVar[bool] = False

    def scene(self, key: str) -> Path:
        return Path(self.folders[key])

    def files(self, i: int) -> tuple[Path, Path, Path, Path]:
        scene = self.scene(self.key(i))
        image, depth = _latest(scene, ("image",), IMAGE_SUFFIXES), _latest(scene, DEPTH_FOLDERS, (".png",))
        return scene / MARK, _latest(scene, ("extrinsics",), (".txt",)), image, depth

    def frame(self, i: int) -> Frame:
        """Reads frame `i` with `depth_m`; labels are in upright depth (`T_camera_label`)."""
        key = self.key(i)
        intrinsics, extrinsics, image_path, depth_path = self.files(i)
        calibration = read_scene_calibration(intrinsics, extrinsics)
        image = read_color_image(image_path, has_depth=True)
        rgb = image.rgb
        raw = read_depth(depth_path)
        require_size(depth_path, raw, rgb.shape[1::-1], "the colour image has", "copy both again")
        camera, depth_m = calibration.camera(rgb.shape[1], rgb.shape[0]), decode_depth(raw)
        xyz_m, pixel = unproject_depth(camera, depth_m)
        if len(xyz_m) == 0:
            raise FrameError(
                depth_path, "no pixel has a depth, so the cloud is empty", "copy it again, or remove the scene"
            )
        cloud = PointCloud(xyz_m, rgb=pixel_colors(rgb, pixel), pixel_index=pixel)
        return _frame(key, i, calibration, image, cloud, depth_m)


def open_sunrgbd_scenes(path: Path) -> SunRgbdScenes | None:
    """Lists the raw scenes at or below `path`; None if there are none."""
    if not path.is_dir():
        return None
    if _is_scene(str(path)):
        return SunRgbdScenes(path, (path.resolve().name,), {path.resolve().name: str(path)})
    with path_errors(path):
        is_data_set = path.resolve().name in CAMERA_FOLDERS or any((path / name).is_dir() for name in CAMERA_FOLDERS)
        levels = MOST_LEVELS if is_data_set else 1
        folders = dict(_scenes(str(path), levels))
    if not folders:
        return None
    return SunRgbdScenes(path, sorted_keys(path, set(folders), MARK), folders)


def _scenes(root: str, levels: int) -> Iterator[tuple[str, str]]:
    waiting = [(root, "", 1)]
    while waiting:
        folder, prefix, level = waiting.pop()
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.startswith(".") or not entry.is_dir():
                    continue
                key = prefix + entry.name
                if _is_scene(entry.path):
                    yield key, entry.path
                elif level < levels:
                    waiting.append((entry.path, key + KEY_SEPARATOR, level + 1))


def _is_scene(folder: str) -> bool:
    marks = (f"{folder}/{mark}" for mark in SCENE_MARKS)
    return os.path.exists(f"{folder}/{MARK}") and all(map(os.path.isdir, marks))  # noqa: PTH110


def _latest(scene: Path, folders: tuple[str, ...], suffixes: tuple[str, ...]) -> Path:
    """Returns the file of a scene's subfolder; the last one if there are several (they are named by date)."""
    for name in folders:
        folder = scene / name
        with file_errors(folder, "copy the scene again from the data set"):
            names = folder.iterdir() if folder.is_dir() else ()
            files = sorted(file for file in names if file.suffix.lower() in suffixes)
        if files:
            return files[-1]
    raise FrameError(
        scene / folders[0], f"has no {' or '.join(suffixes)} file", "copy the scene again from the data set"
    )
