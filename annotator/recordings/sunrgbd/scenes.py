"""SUN RGB-D's raw scenes: one folder with one frame each; or any folder above them, such as the whole data set.

SCENE/intrinsics.txt  SCENE/image/*.jpg  SCENE/depth/*.png  SCENE/depth_bfx/*.png  SCENE/extrinsics/*.txt
[SCENE/annotation3Dfinal/index.json, read by annotator.formats]

Depth images store millimetres, rotated left by three bits. The sensor's own images (`depth/`) are read, as in VoteNet;
those with filled holes (`depth_bfx/`) only if `depth/` has none.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from annotator.geometry.projection import pixel_colors, unproject_depth
from annotator.recordings.image_file import read_color_image, read_depth
from annotator.recordings.listing import IMAGE_SUFFIXES, REMEDIES, path_errors, sorted_keys, unread_note
from annotator.recordings.recording import KeyedFrames, NotFound
from annotator.recordings.rotated_depth import decode_depth
from annotator.recordings.sunrgbd.calibration import read_scene_calibration
from annotator.types import Frame, PointCloud
from annotator.types.errors import FrameError

LOOKED_FOR = "scene folders (intrinsics.txt, image/, depth/, extrinsics/), or folders of them"
MARK = "intrinsics.txt"
# The data set's top folders, one per camera. They are searched several levels deep, any other folder only one level.
CAMERA_FOLDERS = frozenset({"kv1", "kv2", "realsense", "xtion"})
MOST_LEVELS = 5
SCENE_MARKS = ("image", "extrinsics")
DEPTH_FOLDERS = ("depth", "depth_bfx")
LABELS = "annotation3Dfinal/index.json"
# What is read here and by annotator.formats.
READ = (MARK, *SCENE_MARKS, *DEPTH_FOLDERS, "annotation3Dfinal")
KEY_SEPARATOR = "__"


@dataclass(frozen=True, eq=False)
class SunRgbdScenes(KeyedFrames):
    """A `Recording` of raw scenes, unrelated to each other. A frame's key is its scene's path, with `__` for `/`.

    Attributes:
        folders: the scenes' folders, in the order of the keys; strings, since creating ten thousand Paths is slow.
    """

    folders: tuple[str, ...]
    format: ClassVar[str] = "sunrgbd_scenes"
    is_sequence: ClassVar[bool] = False

    @property
    def notes(self) -> tuple[str, ...]:
        """Names what the first scene has besides."""
        note = unread_note(Path(self.folders[0]), READ, LABELS)
        return () if note is None else (f"in the first scene, {note}",)

    @cached_property
    def scenes(self) -> tuple[Path, ...]:
        """The folders of all frames."""
        return tuple(map(Path, self.folders))

    def scene(self, key: str) -> Path:
        """Returns the folder of a frame."""
        return Path(self._by_key[key])

    @cached_property
    def _by_key(self) -> dict[str, str]:
        return dict(zip(self.keys, self.folders, strict=True))

    def files(self, i: int) -> tuple[Path, Path, Path, Path]:
        self.key(i)
        scene = Path(self.folders[i])
        image, depth = _latest(scene, ("image",), IMAGE_SUFFIXES), _latest(scene, DEPTH_FOLDERS, (".png",))
        return scene / MARK, _latest(scene, ("extrinsics",), (".txt",)), image, depth

    def frame(self, i: int) -> Frame:
        """Reads frame `i` with `depth_m`; labels are in upright depth (`T_camera_label`).

        Raises:
            FrameError: a missing or broken file, or no depth at all.
            IndexError: there is no such frame.
        """
        key = self.key(i)
        intrinsics, extrinsics, image_path, depth_path = self.files(i)
        calibration = read_scene_calibration(intrinsics, extrinsics)
        image = read_color_image(image_path, has_depth=True)
        rgb = image.rgb
        raw = read_depth(depth_path)
        if raw.shape != rgb.shape[:2]:
            raise FrameError(
                depth_path,
                f"is {raw.shape[1]} x {raw.shape[0]} pixels, but the image is {rgb.shape[1]} x {rgb.shape[0]}",
                "copy both again",
            )
        camera, depth_m = calibration.camera(rgb.shape[1], rgb.shape[0]), decode_depth(raw)
        xyz_m, pixel = unproject_depth(camera, depth_m)
        if len(xyz_m) == 0:
            raise FrameError(
                depth_path, "no pixel has a depth, so the cloud is empty", "copy it again, or remove the scene"
            )
        cloud = PointCloud(xyz_m, rgb=pixel_colors(rgb, pixel), pixel_index=pixel)
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


def open_sunrgbd_scenes(path: Path) -> SunRgbdScenes | NotFound:
    """Lists the raw scenes at or below `path`; `NotFound` if there are none."""
    if not path.is_dir():
        return NotFound(LOOKED_FOR)
    if _is_scene(str(path)):
        return SunRgbdScenes(path, (path.resolve().name,), (str(path),))
    with path_errors(path):
        is_data_set = path.resolve().name in CAMERA_FOLDERS or any((path / name).is_dir() for name in CAMERA_FOLDERS)
        levels = MOST_LEVELS if is_data_set else 1
        folders = dict(_scenes(str(path), levels))
    if not folders:
        return NotFound(LOOKED_FOR)
    keys = sorted_keys(path, set(folders), LOOKED_FOR)
    return SunRgbdScenes(path, keys, tuple(folders[key] for key in keys))


def _scenes(root: str, levels: int) -> Iterator[tuple[str, str]]:
    """Yields key and folder of all scenes below a folder."""
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
    """Returns the file of a scene's subfolder; the last one if there are several (they are named by date).

    Raises:
        FrameError: no such file, or the folder cannot be read.
    """
    for name in folders:
        folder = scene / name
        try:
            files = (
                sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes) if folder.is_dir() else []
            )
        except OSError as error:
            raise FrameError(folder, f"cannot be read: {error.strerror}", REMEDIES.get(error.errno or 0, "")) from error
        if files:
            return files[-1]
    raise FrameError(
        scene / folders[0], f"has no {' or '.join(suffixes)} file", "copy the scene again from the data set"
    )
