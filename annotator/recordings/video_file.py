"""Single images of a video file, through PyAV.

An image is decoded from the last complete one (keyframe) before it. The decoder stays open, so that the next image
costs one step.
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import UInt8

from annotator.files import check_file
from annotator.frame_limits import most_pixels, require_memory

# An edit list of the container would leave images out that have depth.
CONTAINER_OPTIONS = {"ignore_editlist": "1"}
# Damage is an error, instead of an image that is partly made up. H.264 decoders would refuse sound files in the
# strictest mode, too.
STRICT, STRICTEST = "crccheck+bitstream+buffer", "explode"
THREADS = 4


class VideoFile:
    """A video file's images, by number in the order of display. It can be used by several threads.

    Attributes:
        path: the file.
        size: width and height, pixels.
    """

    def __init__(self, path: Path) -> None:
        """Lists the images, without decoding them."""
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
