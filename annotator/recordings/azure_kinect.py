"""Azure Kinect recordings (`.mkv`), read without the SDK.

Tracks COLOR (MJPEG, NV12, YUY2 or BGRA), DEPTH and IR (16 bits a pixel, big-endian, depth in millimetres), IMU; the
calibration is attached. Tags tell when the recording began on the device's clock, and by how much depth was delayed.

A frame's camera is the colour camera; its cloud is what that camera sees of the depth image (`kinect_cloud`), and up is
known where the accelerometer says that the device stood still (`kinect_imu`).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float64, UInt8, UInt16

from annotator.recordings.kinect_attachments import REMEDY, tagged_ns, tags_and_calibration
from annotator.recordings.kinect_calibration import KinectCalibration, Size, parse_calibration
from annotator.recordings.kinect_captures import Capture, find_captures
from annotator.recordings.kinect_cloud import seen_points
from annotator.recordings.kinect_color import FORMATS, decode_color
from annotator.recordings.kinect_imu import blocks_near, parse_samples, up_at_rest
from annotator.recordings.matroska import Block, MatroskaIndex, Track, read_index, read_tracks
from annotator.recordings.recording import KeyedFrames, NotFound
from annotator.types import Frame, PointCloud
from annotator.types.errors import FrameError, RecordingError

TRACKS = frozenset({"COLOR", "DEPTH"})
LOOKED_FOR = "an .mkv file with tracks COLOR and DEPTH and an attached calibration"


@dataclass(frozen=True, eq=False)
class AzureKinect(KeyedFrames):
    """A `Recording` of an Azure Kinect.

    A frame is a moment with a colour and a depth image, named by the number of its colour image; where the sensor has
    dropped one of the two there is no frame. Times are those of the device's clock.

    Attributes:
        fourcc: the colour images' format.
        start_ns: device time of the recording's beginning.
        infrared: the infrared images' blocks.
        inertial: the accelerometer's blocks, in the order of time.
    """

    captures: tuple[Capture, ...]
    calibration: KinectCalibration
    fourcc: str
    start_ns: int
    infrared: tuple[Block, ...]
    inertial: tuple[Block, ...]
    format: ClassVar[str] = "azure_kinect"
    is_sequence: ClassVar[bool] = True

    @property
    def name(self) -> str:
        return self.path.resolve().stem

    @property
    def times_ns(self) -> tuple[int, ...]:
        """When each colour image was taken, on the device's clock."""
        return tuple(self.start_ns + capture.color.time_ns for capture in self.captures)

    def frame(self, i: int) -> Frame:
        """Frame `i`; its cloud has `rgb`.

        Raises:
            FrameError: an image is damaged or cut off, or there is no point in the colour image.
            IndexError: there is no such frame.
        """
        key = self.key(i)
        # the image is decoded beside the geometry: each takes a good part of the time
        with ThreadPoolExecutor(1) as beside:
            decoding = beside.submit(self.color_image, i)
            xyz_m, pixel = seen_points(self.calibration, self.depth_image(i))
            color = decoding.result()
        cloud = PointCloud(xyz_m, rgb=color.reshape(-1, 3).take(pixel, axis=0))
        if len(cloud) == 0:
            raise FrameError(
                self.path,
                f"frame {key}: no depth pixel lies in the colour image, the cloud is empty",
                "record the scene again within the sensor's range, or go on with the other frames",
            )
        time_ns = self.start_ns + self.captures[i].color.time_ns
        return Frame(key, i, self.calibration.color, color, cloud, up=self.up(i), timestamp_ns=time_ns)

    def up(self, i: int) -> Float64[np.ndarray, "3"] | None:
        """Against gravity in the colour camera's frame, unit length; None where the device moved, or nobody measured.

        Raises:
            FrameError: the file cannot be read.
            IndexError: there is no such frame.
        """
        key, turn, time_ns = self.key(i), self.calibration.color_from_accelerometer, self.captures[i].color.time_ns
        # a file that was cut off may end within the last of them
        blocks = blocks_near(self.inertial, time_ns)
        contents = zip(self._contents(key, blocks), blocks, strict=True)
        samples = [parse_samples(data, block.is_laced) for data, block in contents if len(data) == block.size]
        if turn is None or not samples:
            return None
        up = up_at_rest(np.concatenate(samples), self.start_ns + time_ns)
        return None if up is None else np.asarray(turn.apply(up))

    def color_image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        """Colour image `i`, RGB order.

        Raises:
            FrameError: it is damaged or cut off.
            IndexError: there is no such frame.
        """
        key, camera = self.key(i), self.calibration.color
        data = self._read(key, "colour", self.captures[i].color)
        try:
            return decode_color(self.fourcc, data, camera.width_px, camera.height_px)
        except ValueError as error:
            raise FrameError(self.path, f"frame {key}: colour image: {error}", REMEDY) from error

    def depth_image(self, i: int) -> UInt16[np.ndarray, "h w"]:
        """Depth image `i` as the depth camera saw it, millimetres, 0 = none.

        Raises:
            FrameError: it is damaged or cut off.
            IndexError: there is no such frame.
        """
        return self._raw_image(self.key(i), "depth", self.captures[i].depth)

    def infrared_image(self, i: int) -> UInt16[np.ndarray, "h w"] | None:
        """The infrared image that was taken with depth image `i`, or None where there is none.

        Raises:
            FrameError: it is damaged or cut off.
            IndexError: there is no such frame.
        """
        key, depth = self.key(i), self.captures[i].depth
        block = next((block for block in self.infrared if depth and block.time_ns == depth.time_ns), None)
        return None if block is None else self._raw_image(key, "infrared", block)

    def _raw_image(self, key: str, what: str, block: Block | None) -> UInt16[np.ndarray, "h w"]:
        """16 bits a pixel, big-endian, of the depth camera's size."""
        if block is None:
            raise FrameError(self.path, f"frame {key}: the file ends before its {what} image", REMEDY)
        camera = self.calibration.depth
        data = self._read(key, what, block)
        expected = 2 * camera.width_px * camera.height_px
        if len(data) != expected:
            raise FrameError(
                self.path, f"frame {key}: the {what} image has {len(data)} bytes instead of {expected}", REMEDY
            )
        return np.frombuffer(data, ">u2").astype(np.uint16).reshape(camera.height_px, camera.width_px)

    def _read(self, key: str, what: str, block: Block) -> bytes:
        if block.is_laced:
            raise FrameError(self.path, f"frame {key}: the {what} image shares its block with others", "record it anew")
        (data,) = self._contents(key, [block])
        if len(data) < block.size:
            raise FrameError(self.path, f"frame {key}: the file ends in the middle of its {what} image", REMEDY)
        return data

    def _contents(self, key: str, blocks: Sequence[Block]) -> list[bytes]:
        """As much of each block as there is."""
        found = []
        try:
            with self.path.open("rb") as file:
                for block in blocks:
                    file.seek(block.offset)
                    found.append(file.read(block.size))
        except OSError as error:
            raise FrameError(self.path, f"frame {key}: cannot be read ({error.strerror})", REMEDY) from error
        return found


def is_azure_kinect(path: Path) -> bool:
    """Whether a file's head says that it is such a recording; opening it finds every image, which takes longer.

    Raises:
        OSError: it cannot be read.
    """
    return _is_mkv(path) and {track.name for track in read_tracks(path) or ()} >= TRACKS


def open_azure_kinect(path: Path) -> AzureKinect | NotFound:
    """The Azure Kinect recording at `path`, where it is one; its headers are read, and no image.

    Raises:
        RecordingError: it has no frame, no usable calibration, or a colour format that no Azure Kinect has.
    """
    if not _is_mkv(path):
        return NotFound(LOOKED_FOR)
    known = path.stat()
    index = _index(path, known.st_mtime_ns, known.st_size)
    if index is None:
        raise RecordingError(f"{path}: is no Matroska file, or its beginning is damaged; {REMEDY}")
    tracks = {track.name: track for track in index.tracks}
    color, depth = tracks.get("COLOR"), tracks.get("DEPTH")
    if color is None or depth is None:
        have = ", ".join(tracks) or "none"
        raise RecordingError(
            f"{path}: has no tracks COLOR and DEPTH (it has: {have}); record with an Azure Kinect, in a mode with both"
        )
    tags, attached = tags_and_calibration(path)
    captures = find_captures(index, color, depth, tagged_ns(tags, "K4A_DEPTH_DELAY_NS"))
    if not captures:
        raise RecordingError(f"{path}: no frames; expected colour and depth images of the same moments")
    return AzureKinect(
        path=path,
        keys=tuple(f"{number:06d}" for number in captures),
        captures=tuple(captures.values()),
        calibration=_calibration(path, attached, _size(depth), _size(color)),
        fourcc=_fourcc(path, color),
        start_ns=tagged_ns(tags, "K4A_START_OFFSET_NS"),
        infrared=_blocks(index, tracks.get("IR")),
        inertial=tuple(sorted(_blocks(index, tracks.get("IMU")), key=lambda block: block.time_ns)),
    )


def _is_mkv(path: Path) -> bool:
    return path.suffix.lower() == ".mkv" and path.is_file()


@lru_cache(maxsize=32)
def _index(path: Path, changed_ns: int, size: int) -> MatroskaIndex | None:
    """Kept, since a recording that is added is opened several times."""
    return read_index(path)


def _calibration(path: Path, attached: bytes, depth: Size, color: Size) -> KinectCalibration:
    try:
        return parse_calibration(attached, depth, color)
    except ValueError as error:
        raise RecordingError(f"{path}: its calibration cannot be used: {error}; {REMEDY}") from error


def _size(track: Track) -> Size:
    return track.width_px, track.height_px


def _fourcc(path: Path, track: Track) -> str:
    """The colour format: at byte 16 of the track's BITMAPINFOHEADER, or said by the codec's name."""
    named = {"V_MJPEG": "MJPG", "V_UNCOMPRESSED": track.private[:4].decode("ascii", "replace")}
    fourcc = named.get(track.codec) or track.private[16:20].decode("ascii", "replace")
    if fourcc not in FORMATS:
        raise RecordingError(
            f"{path}: colour images of the format {fourcc or track.codec!r}; "
            f"an Azure Kinect records {', '.join(FORMATS)}"
        )
    return fourcc


def _blocks(index: MatroskaIndex, track: Track | None) -> tuple[Block, ...]:
    return tuple(block for block in index.blocks if track and block.track == track.number)
