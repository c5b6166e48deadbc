"""Reads the colour and depth images of recordings, and single images of videos (through PyAV).

Of colours and grey with more than 8 bits, black stays at 0, and the lowest usual depth that holds the brightest
number is white: the numbers of 10 or 12 bits stand in 16 as they are, and would look black. Grey of ROS messages is
infrared or thermal light as a rule: from the darkest to the brightest hundredth. The first images of a recording
decide for all of them, so that it does not flicker.

An image of a video is decoded from the last complete one (keyframe) before it. The decoder stays open, so that the next
image costs one step.

SUN RGB-D's depth images are millimetres whose 16 bits are rotated left by three (SUNRGBDtoolbox, `read3dPoints.m`).
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from annotator.files import check_file
from annotator.frame_limits import most_pixels, read_frame_file, require_memory
from annotator.geometry.projection import in_metres, measured
from annotator.image_bytes import UPRIGHT, Size, decode_image, described, is_turned, orientation_of, turned
from annotator.recordings.clouds.columns import FIRST, depth_bits, files_like
from annotator.recordings.listing import file_errors
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError


@dataclass(frozen=True)
class Levels:
    """The numbers that become black and white."""

    low: float
    high: float

    def with_all(self, others: list[Levels]) -> Levels:
        both = [self, *others]
        return Levels(min(each.low for each in both), max(each.high for each in both))


def depth_levels(pixels: np.ndarray) -> Levels:
    """Returns the levels of the lowest depth that holds all pixels: 8, 10, 12, 14 or 16 bits."""
    return Levels(0.0, 2.0 ** depth_bits(float(pixels.max(initial=0))) - 1)


def contrast_levels(pixels: np.ndarray) -> Levels:
    """Returns the levels from the darkest to the brightest hundredth."""
    low, high = np.percentile(pixels, (1, 99))
    return Levels(float(low), float(high))


def pixels_as_eight_bits(pixels: np.ndarray, levels: Levels) -> UInt8[np.ndarray, "..."]:
    """Returns pixels as 8 bits; those of a full depth lose their lower bits."""
    share = 256 / max(levels.high - levels.low + 1, 2)
    return np.clip((pixels - np.float64(levels.low)) * share, 0, 255).astype(np.uint8)


@lru_cache(maxsize=64)
def _of_folder(folder: Path, suffix: str, changed_ns: int) -> list[Levels]:
    found = []
    for path in files_like(folder / f"any{suffix}")[:FIRST]:
        # a damaged one is told by its own frame
        with suppress(FrameError):
            pixels = _colors(path)[1]
            found += [depth_levels(pixels)] if pixels.dtype != np.uint8 else []
    return found


REMEDY = "copy the file again from its source, or remove the frame"


@dataclass(frozen=True, eq=False)
class ColorImage:
    """A colour image, RGB order, and its EXIF orientation if that is not applied, else 1."""

    rgb: UInt8[np.ndarray, "h w 3"]
    exif_orientation: int = UPRIGHT

    def frame(self, key: str, i: int, camera: Camera, cloud: PointCloud, **more: Any) -> Frame:
        return Frame(key, i, camera, self.rgb, cloud, exif_orientation=self.exif_orientation, **more)


def read_color_image(path: Path, size: Size | None = None, *, has_depth: bool = False) -> ColorImage:
    """Reads the image of a calibrated camera, turned as the calibration fits (`annotator.image_bytes`).

    More than 8 bits are reduced to 8, by one depth for the images of a folder.

    Args:
        size: width and height of the calibration; None if it does not say it.
        has_depth: a depth image of the same camera has no EXIF orientation.
    """
    import cv2

    data, pixels = _colors(path)
    if pixels.dtype != np.uint8:
        levels = _of_folder(path.parent, path.suffix, path.parent.stat().st_mtime_ns)
        pixels = pixels_as_eight_bits(pixels, depth_levels(pixels).with_all(levels))
    rgb: np.ndarray = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    orientation = orientation_of(data)
    turn = is_turned(orientation, (rgb.shape[1], rgb.shape[0]), size)
    if turn is None and not has_depth:
        raise FrameError(
            path,
            f"it has the {described(orientation)}, and its calibration may be for the image as stored or as shown",
            "save the images as the calibration needs them, without this tag",
        )
    return ColorImage(turned(rgb, orientation)) if turn else ColorImage(rgb, orientation)


def _colors(path: Path) -> tuple[bytes, np.ndarray]:
    import cv2

    return _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)


def read_depth(path: Path) -> UInt16[np.ndarray, "h w"]:
    """Reads a depth image in its raw units."""
    return _plane(path, np.uint16, "a depth image", "save the sensor's depth as a 16-bit grey PNG, millimetres")


# Depths below 8.192 m become multiples of eight, which few plain values are.
LEAST_MULTIPLES = 0.9
# Read as they are, their far parts are beyond this, metres: farther than depth cameras see.
FAR_M, FAR_SHARE = 8.192, 0.95


def decode_depth(raw: UInt16[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Returns the metres of a SUN RGB-D depth image: its millimetres are rotated left by three bits."""
    return in_metres(raw >> np.uint16(3) | raw << np.uint16(13), 1000.0)


def looks_rotated(raw: UInt16[np.ndarray, "h w"], depth_scale: float) -> bool:
    """True if a depth image of so many units per metre is rather one of SUN RGB-D."""
    known = measured(raw)
    count = np.count_nonzero(known)
    # counted without a copy of the values: nearly all images end here
    if count == 0 or 1 - np.count_nonzero((raw & np.uint16(7)).astype(bool) & known) / count < LEAST_MULTIPLES:
        return False
    return bool(np.quantile(raw[known], FAR_SHARE) / depth_scale > FAR_M)


def read_confidence(path: Path) -> UInt8[np.ndarray, "h w"]:
    return _plane(path, np.uint8, "an image of confidence", REMEDY)


def _plane(path: Path, dtype: type[np.generic], what: str, remedy: str) -> np.ndarray:
    import cv2

    raw = _decoded(path, cv2.IMREAD_UNCHANGED, give_points=True)[1]
    if raw.ndim != 2 or raw.dtype != dtype:
        channels, bits = 1 if raw.ndim == 2 else raw.shape[2], 8 * np.dtype(dtype).itemsize
        raise FrameError(
            path,
            f"{what} must be {bits}-bit with one channel, not {8 * raw.itemsize}-bit with {channels}",
            remedy,
        )
    return raw


def _decoded(path: Path, flags: int, give_points: bool = False) -> tuple[bytes, np.ndarray]:
    with file_errors(path, REMEDY):
        data = read_frame_file(path)
        return data, decode_image(data, flags, give_points=give_points)


# An edit list of the container would leave images out that have depth.
CONTAINER_OPTIONS = {"ignore_editlist": "1"}
# Damage is an error, instead of an image that is partly made up. H.264 decoders would refuse sound files in the
# strictest mode, too.
STRICT, STRICTEST = "crccheck+bitstream+buffer", "explode"
THREADS = 4


class VideoFile:
    """A video file's images, by number in the order of display. It can be used by several threads.

    `size` is their width and height, pixels.
    """

    def __init__(self, path: Path) -> None:
        import av

        self.path = path
        self._lock = Lock()
        self._decoder: Iterator[tuple[int, Any]] | None = None
        self._next = 0
        try:
            check_file(path)
            with av.open(str(path), format="mp4", options=CONTAINER_OPTIONS) as container:
                if not container.streams.video:
                    raise ValueError("it has no video")
                stream = container.streams.video[0]
                if stream.codec_context is None:
                    raise ValueError("its compression is unknown")
                self.size = stream.codec_context.width, stream.codec_context.height
                found = [
                    (packet.pts, packet.dts, packet.is_keyframe)
                    for packet in container.demux(stream)
                    if packet.size and packet.pts is not None
                ]
        except (av.error.FFmpegError, OverflowError) as error:
            raise ValueError(f"not a readable video ({_brief(error)})") from error
        require_memory(pixels=self.size[0] * self.size[1])
        shown = sorted({pts for pts, _, _ in found})
        self._number = {pts: number for number, pts in enumerate(shown)}
        self._keyframes = sorted(
            (self._number[pts], dts if dts is not None else pts) for pts, dts, is_key in found if is_key
        )

    def __len__(self) -> int:
        return len(self._number)

    def image(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        """Decodes an image, RGB order; a rotation that the file asks players for is not applied."""
        import av

        if not 0 <= number < len(self):
            raise ValueError(f"there is no image {number}; it has {len(self)}")
        with self._lock:
            try:
                return self._decoded(number)
            except (av.error.FFmpegError, OverflowError) as error:
                self._decoder = None
                raise ValueError(f"image {number} cannot be decoded ({_brief(error)})") from error

    def _decoded(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        first = bisect_right(self._keyframes, number, key=lambda keyframe: keyframe[0]) - 1
        keyframe, dts = self._keyframes[first] if first >= 0 else (0, None)
        if self._decoder is None or not keyframe <= self._next <= number:
            self._decoder = self._images_from(keyframe, dts)
        for found, image in self._decoder:
            self._next = found + 1
            if found == number and not image.is_corrupt:
                rgb: np.ndarray = image.to_ndarray(format="rgb24")
                if rgb.shape[1::-1] != self.size:
                    raise ValueError(f"image {number} has {rgb.shape[1]} x {rgb.shape[0]} pixels, unlike the others")
                return rgb
            if found >= number:
                break
        self._decoder = None
        raise ValueError(f"image {number} is damaged")

    def _images_from(self, keyframe: int, dts: int | None) -> Iterator[tuple[int, Any]]:
        """Decodes images with their numbers, from a keyframe on, or from the file's beginning."""
        import av

        check_file(self.path)
        with av.open(str(self.path), format="mp4", options=CONTAINER_OPTIONS) as container:
            stream = container.streams.video[0]
            strictness = STRICTEST if stream.codec_context.name == "hevc" else STRICT
            stream.codec_context.options = {"err_detect": strictness, "max_pixels": str(most_pixels())}
            stream.codec_context.thread_count = THREADS
            stream.thread_type = "AUTO"
            if dts is not None:
                container.seek(dts, stream=stream)
            for packet in container.demux(stream):
                # images that are shown before the keyframe but stored after it also need the ones before it
                if packet.pts is not None and self._number.get(packet.pts, -1) < keyframe:
                    continue
                for image in packet.decode():
                    if image.pts in self._number:
                        yield self._number[image.pts], image


def open_video(path: Path) -> VideoFile:
    """Returns the video at `path`; the last few of a process stay open."""
    stat = path.stat()
    # by process, since decoders cannot be shared with a fork
    return _opened(path, stat.st_mtime_ns, stat.st_size, os.getpid())


@lru_cache(maxsize=4)
def _opened(path: Path, changed_ns: int, size: int, process: int) -> VideoFile:
    return VideoFile(path)


def _brief(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)
