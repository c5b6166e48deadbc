"""Writes frames one at a time to a folder that `open_recording` reads; it is a valid recording after every frame.

Frames whose cloud is that of their depth image become an RGB-D folder, colour as JPEG and depth in whole millimetres:

    color/KEY.jpg  depth/KEY.png  camera_intrinsic.json  gravity.json  timestamps.csv

All others become a folder of clouds in the camera's frame:

    color/KEY.jpg  clouds/KEY.npz  camera_intrinsic.json  gravity.json  timestamps.csv
"""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.files import TABLE_BYTES, read_text_file
from annotator.geometry.projection import SATURATED, camera_key
from annotator.image_bytes import encoded_image
from annotator.recordings import frame_times
from annotator.recordings.rgbd_folder import FILE_NAME as CAMERA_FILE
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import RecordingError

# Fast compression; files are a few percent larger.
PNG_COMPRESSION = 1
# Readers take higher numbers for no measurement (`SATURATED`).
MM_PER_M, MOST_MM = 1000.0, SATURATED[0] - 1
COLOR, DEPTH, CLOUDS, GRAVITY = "color", "depth", "clouds", "gravity.json"
# Suffix of files that are being written; readers ignore it.
UNFINISHED = ".part"
# A folder has a single direction of gravity; if frames differ by more, gravity.json is removed.
SAME_UP_RAD = np.deg2rad(2.0)


class FrameWriter:
    """Writes the frames of one camera to a folder, which exists. An image is written last and makes its frame valid."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.frames = 0
        self._camera: Camera | None = None
        self._has_depth = False
        self._up: Float64[np.ndarray, "3"] | None = None

    def add(self, frame: Frame, timestamp_ns: int) -> str:
        """Writes a frame and returns its key; RecordingError: the camera has changed, or writing fails."""
        key = f"{self.frames:06d}"
        try:
            if self._camera is None:
                self._begin(frame)
            self._require_same(frame)
            self._follow_gravity(frame.up)
            if self._has_depth:
                assert frame.depth_m is not None  # checked by `_require_same`
                _put(self.folder / DEPTH / f"{key}.png", _png(frame.depth_m))
            else:
                _put(self.folder / CLOUDS / f"{key}.npz", _npz(frame.cloud))
            with (self.folder / frame_times.FILE_NAME).open("a", encoding="utf-8") as times:
                times.write(f"{key},{timestamp_ns}\n")
            _put(self.folder / COLOR / f"{key}.jpg", encoded_image(frame.rgb, "jpg"))
        except OSError as error:
            raise RecordingError(
                f"{self.folder}: frame {key} cannot be written ({error.strerror or error}); "
                "free some space, or record to another disk"
            ) from error
        self.frames += 1
        return key

    def _begin(self, frame: Frame) -> None:
        self._camera, self._has_depth, self._up = frame.camera, _is_depth_image(frame), frame.up
        for name in (COLOR, DEPTH if self._has_depth else CLOUDS):
            (self.folder / name).mkdir()
        intrinsics = {
            "width": frame.camera.width_px,
            "height": frame.camera.height_px,
            "intrinsic_matrix": frame.camera.matrix.T.ravel().tolist(),
            "distortion": list(frame.camera.distortion),
        }
        (self.folder / CAMERA_FILE).write_text(json.dumps(intrinsics) + "\n", encoding="utf-8")
        (self.folder / frame_times.FILE_NAME).write_text(frame_times.HEADER + "\n", encoding="utf-8")
        if frame.up is not None:
            (self.folder / GRAVITY).write_text(json.dumps({"up": frame.up.tolist()}) + "\n", encoding="utf-8")

    def _require_same(self, frame: Frame) -> None:
        assert self._camera is not None
        if camera_key(frame.camera) != camera_key(self._camera) or _is_depth_image(frame) != self._has_depth:
            raise RecordingError(
                f"{self.folder}: frame {frame.key} has a different camera; a recording has only one; "
                "stop recording before the camera changes"
            )

    def _follow_gravity(self, up: Float64[np.ndarray, "3"] | None) -> None:
        """Removes the folder's gravity.json once a frame has a different direction of gravity, or none."""
        if self._up is None:
            return
        if up is None or float(up @ self._up) < np.cos(SAME_UP_RAD):
            self._up = None
            (self.folder / GRAVITY).unlink(missing_ok=True)


def trim(folder: Path) -> int:
    """Removes the incomplete last frame of a killed writer and returns the number of complete frames."""
    complete = {path.stem for path in (folder / COLOR).glob("*.jpg")} if (folder / COLOR).is_dir() else set()
    parts = [*folder.glob(f"{DEPTH}/*"), *folder.glob(f"{CLOUDS}/*"), *folder.glob(f"{COLOR}/*")]
    for path in parts:
        if path.stem not in complete or path.suffix == UNFINISHED:
            path.unlink()
    times = folder / frame_times.FILE_NAME
    if times.is_file():
        lines = read_text_file(times, TABLE_BYTES, errors="replace").splitlines(keepends=True)
        valid = [text for text in lines[1:] if text.endswith("\n") and text.rpartition(",")[0] in complete]
        times.write_text("".join([frame_times.HEADER + "\n", *valid]), encoding="utf-8")
    return len(complete)


def _is_depth_image(frame: Frame) -> bool:
    return frame.depth_m is not None and frame.cloud.pixel_index is not None


def _put(path: Path, content: bytes) -> None:
    """Writes a file by renaming a temporary one, so that a killed process leaves no partial file."""
    unfinished = path.with_suffix(UNFINISHED)
    unfinished.write_bytes(content)
    unfinished.replace(path)


def _png(depth_m: np.ndarray) -> bytes:
    """Encodes depth in whole millimetres; values beyond `MOST_MM` become 0 (no depth)."""
    import cv2

    depth_mm = np.rint(depth_m * np.float32(MM_PER_M))
    depth_mm[depth_mm > MOST_MM] = 0
    _, data = cv2.imencode(".png", depth_mm.astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])
    return bytes(data)


def _npz(cloud: PointCloud) -> bytes:
    columns = [cloud.xyz_m] if cloud.reflectance is None else [cloud.xyz_m, cloud.reflectance[:, None]]
    points = np.concatenate(columns, axis=1).astype(np.float32)
    stream = io.BytesIO()
    if cloud.rgb is None:
        np.savez(stream, points=points)
    else:
        np.savez(stream, points=points, colors=cloud.rgb)
    return stream.getvalue()
