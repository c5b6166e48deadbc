"""What the page shows of a bag before it is added: its topics, and the cloud of its first frame over the image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from annotator.geometry.projection import inside_image, project
from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.ros.topics import TopicReport
from annotator.types import Frame
from annotator.types.errors import InputError, MissingExtraError
from annotator.workflows.inspect import bag_topics

WIDTH_PX = 640
JPEG_QUALITY = 80
NEAREST_M = 0.05


@dataclass(frozen=True)
class BagPreview:
    """A bag as it would be read.

    Attributes:
        frames: their number; 0 if it cannot be read.
        notes: what the reader says about it.
        problem: why it cannot be read; "" if it can.
        jpeg: its first frame; None if that cannot be read.
    """

    topics: tuple[TopicReport, ...]
    frames: int
    notes: tuple[str, ...]
    problem: str
    jpeg: bytes | None


def preview_bag(path: Path, options: ReaderOptions) -> BagPreview:
    """Opens a bag and draws its first frame.

    Raises:
        RecordingError: its files cannot be read.
        MissingExtraError: the library that reads bags is not installed.
    """
    topics = bag_topics(path, options)
    try:
        recording = open_recording(path, options)
        jpeg, problem = _drawn(recording.frame(0)), ""
    except MissingExtraError:
        raise
    except InputError as error:
        return BagPreview(topics, 0, (), str(error), None)
    return BagPreview(topics, len(recording), recording.notes, problem, jpeg)


def _drawn(frame: Frame) -> bytes:
    """Returns the image with the points of the cloud, near ones red, as a JPEG file."""
    import cv2

    scale = min(WIDTH_PX / frame.camera.width_px, 1.0)
    size = (max(round(frame.camera.width_px * scale), 1), max(round(frame.camera.height_px * scale), 1))
    picture = cv2.cvtColor(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
    xyz_m = frame.cloud.xyz_m[frame.cloud.xyz_m[:, 2] > NEAREST_M]
    px = project(frame.camera, xyz_m)
    seen = np.flatnonzero(inside_image(frame.camera, px))
    # near points last, so that they are visible
    seen = seen[np.argsort(-xyz_m[seen, 2], kind="stable")]
    column, row = np.floor((px[seen] + 0.5) * scale).astype(np.int64).T
    near = np.linspace(0, 255, len(seen)).astype(np.uint8)
    colors = cv2.applyColorMap(near[:, None], cv2.COLORMAP_JET)[:, 0]
    picture[np.clip(row, 0, size[1] - 1), np.clip(column, 0, size[0] - 1)] = colors
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])
