"""Azure Kinect recordings (`.mkv`), read without the SDK.

Tracks COLOR (MJPEG, NV12, YUY2 or BGRA), DEPTH and IR (16 bits per pixel, big-endian, depth in millimetres), IMU; the
calibration is attached. Tags hold the recording's start on the device's clock and the delay of the depth images. YUV is
BT.601 with values from 16 to 235, as in the SDK.

A frame's camera is the colour camera. Its cloud holds the points of the depth image that this camera sees
(`two_cameras.py`). `up` is known while the device is at rest.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float64, UInt8, UInt16

from annotator.files import open_file
from annotator.frame_limits import frame_memory
from annotator.geometry.projection import pixel_colors
from annotator.image_bytes import decode_image
from annotator.recordings.frame_times import nearest
from annotator.recordings.kinect.calibration import (
    KinectCalibration,
    blocks_near,
    parse_calibration,
    parse_samples,
    up_at_rest,
)
from annotator.recordings.kinect.matroska import MOST_NS, TRACKS, Block, MatroskaIndex, Track, read_index
from annotator.recordings.listing import file_errors
from annotator.recordings.recording import Recording
from annotator.types import Frame, PointCloud
from annotator.types.errors import FrameError, RecordingError

REMEDY = "copy the recording again from its source"


def tagged_ns(tags: dict[str, str], name: str) -> int:
    """Returns a tag's nanoseconds; 0 if it is damaged, or missing as in files of older recorders."""
    try:
        time_ns = int(tags.get(name, "0"))
    except ValueError:
        return 0
    return time_ns if abs(time_ns) <= MOST_NS else 0


DEFAULT_PERIOD_NS = 33_333_333


def find_captures(index: MatroskaIndex, color: Track, depth: Track, delay_ns: int) -> dict[int, tuple[Block, Block]]:
    """Pairs each colour image with the nearest depth image within half a period; by the colour image's number."""
    colors, depths = ([block for block in index.blocks if block.track == track.number] for track in (color, depth))
    if not colors or not depths:
        return {}
    within_ns = (color.period_ns or depth.period_ns or DEFAULT_PERIOD_NS) // 2
    times = np.array([block.time_ns - delay_ns for block in depths], np.int64)
    color_ns = np.array([block.time_ns for block in colors], np.int64)
    near = nearest(color_ns, times)
    return {
        int(number): (colors[number], depths[near[number]])
        for number in np.flatnonzero(np.abs(times[near] - color_ns) < within_ns)
    }


# FourCC of a track -> half bytes per pixel; None for compressed formats.
FORMATS: dict[str, int | None] = {"MJPG": None, "NV12": 3, "YUY2": 4, "BGRA": 8}


def decode_color(fourcc: str, data: bytes, width_px: int, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the RGB image in the bytes of one block."""
    import cv2

    halves = FORMATS[fourcc]
    if halves is None:
        bgr = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if bgr.shape[:2] != (height_px, width_px):
            raise ValueError(f"it is not an image of {width_px} x {height_px} pixels")
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))
    expected = width_px * height_px * halves // 2
    if len(data) != expected:
        raise ValueError(f"it has {len(data)} bytes, but {width_px} x {height_px} pixels of {fourcc} have {expected}")
    raw = np.frombuffer(data, np.uint8).reshape(height_px * 3 // 2 if halves == 3 else height_px, width_px, -1)
    code = {"NV12": cv2.COLOR_YUV2RGB_NV12, "YUY2": cv2.COLOR_YUV2RGB_YUY2, "BGRA": cv2.COLOR_BGRA2RGB}[fourcc]
    return np.asarray(cv2.cvtColor(raw, code))


NAMES = frozenset({"COLOR", "DEPTH"})


@dataclass(frozen=True, eq=False)
class AzureKinect(Recording):
    """A `Recording` of an Azure Kinect.

    A frame is a moment with a colour and a depth image, named by the number of its colour image. Moments with only one
    of the two are not frames. Times are those of the device's clock.

    Attributes:
        captures: the colour and the depth image of each frame.
        start_ns: device time of the recording's start.
        inertial: the accelerometer's blocks, sorted by time.
    """

    captures: tuple[tuple[Block, Block], ...]
    calibration: KinectCalibration
    fourcc: str
    start_ns: int
    inertial: tuple[Block, ...]
    format: ClassVar[str] = "azure_kinect"
    is_sequence: ClassVar[bool] = True

    @cached_property
    def times_ns(self) -> tuple[int, ...]:
        return tuple(self.start_ns + color.time_ns for color, _ in self.captures)

    def frame(self, i: int) -> Frame:
        key = self.key(i)
        # the image is decoded in parallel with the geometry: both take a similar time
        with ThreadPoolExecutor(1) as executor:
            decoding = executor.submit(self.color_image, i)
            xyz_m, pixel = self.calibration.seen_points(self.depth_image(i))
            color = decoding.result()
        if len(xyz_m) == 0:
            raise FrameError(
                self.path,
                f"frame {key}: no depth pixel lies in the colour image, so the cloud is empty",
                "record the scene again within the sensor's range, or use the other frames",
            )
        cloud = PointCloud(xyz_m, rgb=pixel_colors(color, pixel))
        return Frame(key, i, self.calibration.color, color, cloud, up=self.up(i), timestamp_ns=self.times_ns[i])

    def up(self, i: int) -> Float64[np.ndarray, "3"] | None:
        """Returns the unit vector against gravity in the colour camera's frame; None if it moved or there is no IMU."""
        rotation, time_ns = self.calibration.color_from_accelerometer, self.captures[i][0].time_ns
        blocks = blocks_near(self.inertial, time_ns)
        if rotation is None or not blocks:
            return None
        contents = zip(self._contents(self.key(i), blocks), blocks, strict=True)
        # a truncated file may end within the last block
        samples = [parse_samples(data, block.is_laced) for data, block in contents if len(data) == block.size]
        up = up_at_rest(np.concatenate([np.empty((0, 4)), *samples]), self.start_ns + time_ns)
        return None if up is None else np.asarray(rotation.apply(up))

    def color_image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        key, camera = self.key(i), self.calibration.color
        data = self._read(key, "colour", self.captures[i][0])
        with file_errors(self.path, REMEDY, f"frame {key}: colour image: "):
            return decode_color(self.fourcc, data, camera.width_px, camera.height_px)

    def depth_image(self, i: int) -> UInt16[np.ndarray, "h w"]:
        """Reads depth image `i` in the depth camera's pixels, millimetres, 0 = no depth."""
        key, camera = self.key(i), self.calibration.depth
        data, expected = self._read(key, "depth", self.captures[i][1]), 2 * camera.width_px * camera.height_px
        if len(data) != expected:
            problem = f"frame {key}: the depth image has {len(data)} bytes instead of {expected}"
            raise FrameError(self.path, problem, REMEDY)
        return np.frombuffer(data, ">u2").astype(np.uint16).reshape(camera.height_px, camera.width_px)

    def _read(self, key: str, what: str, block: Block) -> bytes:
        (data,) = self._contents(key, [block])
        if len(data) < block.size:
            raise FrameError(self.path, f"frame {key}: the file ends in the middle of its {what} image", REMEDY)
        return data

    def _contents(self, key: str, blocks: Sequence[Block]) -> list[bytes]:
        """Reads the blocks, as far as the file reaches."""
        with file_errors(self.path, REMEDY, f"frame {key}: "), open_file(self.path) as file:
            end, contents = file.seek(0, os.SEEK_END), []
            for block in blocks:
                file.seek(block.offset)
                # a damaged size must not allocate more memory than the file needs
                contents.append(file.read(max(min(block.size, end - block.offset, frame_memory()), 0)))
        return contents


def is_azure_kinect(path: Path) -> bool:
    """True if a file's head has the tracks of such a recording; much faster than opening it."""
    index = read_index(path, until=TRACKS) if _is_mkv(path) else None
    return index is not None and index.tracks.keys() >= NAMES


def open_azure_kinect(path: Path) -> AzureKinect | None:
    """Opens the Azure Kinect recording at `path`, reading headers only; None if it is not one."""
    if not _is_mkv(path):
        return None
    stat = path.stat()
    index = _index(path, stat.st_mtime_ns, stat.st_size)
    if index is None:
        raise RecordingError(f"{path}: is not a Matroska file, or its beginning is damaged; {REMEDY}")
    tracks, tags = index.tracks, index.tags
    if not tracks.keys() >= NAMES:
        raise RecordingError(
            f"{path}: has no tracks COLOR and DEPTH (it has: {', '.join(tracks) or 'none'}); record with an Azure "
            "Kinect, in a mode with both"
        )
    color, depth = tracks["COLOR"], tracks["DEPTH"]
    attached = index.attachments.get(tags.get("K4A_CALIBRATION_FILE", "calibration.json"))
    if attached is None:
        raise RecordingError(f"{path}: has no calibration attached; record it with the Azure Kinect SDK's recorder")
    captures = find_captures(index, color, depth, tagged_ns(tags, "K4A_DEPTH_DELAY_NS"))
    if not captures:
        raise RecordingError(f"{path}: no frames; expected colour and depth images of the same moments")
    with file_errors(path, REMEDY, "its calibration cannot be used: ", RecordingError):
        sizes = ((track.width_px, track.height_px) for track in (depth, color))
        calibration = parse_calibration(attached, *sizes)
    inertial = (block for block in index.blocks if "IMU" in tracks and block.track == tracks["IMU"].number)
    return AzureKinect(
        path=path,
        keys=tuple(f"{number:06d}" for number in captures),
        captures=tuple(captures.values()),
        calibration=calibration,
        fourcc=_fourcc(path, color),
        start_ns=tagged_ns(tags, "K4A_START_OFFSET_NS"),
        inertial=tuple(sorted(inertial, key=lambda block: block.time_ns)),
    )


def _is_mkv(path: Path) -> bool:
    return path.suffix.lower() == ".mkv" and path.is_file()


@lru_cache(maxsize=32)
def _index(path: Path, changed_ns: int, size: int) -> MatroskaIndex | None:
    """Returns the cached index: adding a recording opens it several times."""
    return read_index(path)


def _fourcc(path: Path, track: Track) -> str:
    """Returns the colour format: from byte 16 of the track's BITMAPINFOHEADER, or from the codec's name."""
    named = {"V_MJPEG": "MJPG", "V_UNCOMPRESSED": track.private[:4].decode("ascii", "replace")}
    fourcc = named.get(track.codec) or track.private[16:20].decode("ascii", "replace")
    if fourcc not in FORMATS:
        raise RecordingError(
            f"{path}: the colour format {fourcc or track.codec!r} is unknown; record with one of {', '.join(FORMATS)}"
        )
    return fourcc
