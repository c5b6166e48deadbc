"""annotator's exports in OpenLABEL, or one part of a divided one: unrelated single frames.

RECORDING.json         one document per recording: frames with files, times and intrinsics [and labels]
images/ID.png|jpg      clouds/ID.ply, in the camera's frame
frames.csv             the frames' origins, here or above the parts

The keys are the ids. Documents of other programs are not opened: their clouds may be in any frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.file_names import normal, stem_of
from annotator.files import open_file
from annotator.recordings.exports.files import REMEDY, exported_files, exported_frame, read_document
from annotator.recordings.listing import IMAGE_SUFFIXES, sorted_keys, stems
from annotator.recordings.plausible import LARGEST_SIDE_PX, are_plausible, is_pinhole
from annotator.recordings.recording import KeyedFrames, NotFound
from annotator.types import Camera, Frame
from annotator.types.checks import LATEST_NS, too_late
from annotator.types.errors import FrameError

LOOKED_FOR = "OpenLABEL documents with images/, clouds/ and frames.csv (an export in the format openlabel)"
ORIGINS = "frames.csv"
CAMERA, CLOUD, PLACE = "camera", "cloud", "base_to_world"
# Axes of the base: x forward, y left, z up.
T_BASE_CAMERA = RigidTransform.from_matrix(np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))
# Documents of annotator have this word, and its name, near their beginning.
HEAD_BYTES, HEAD = 1024, (b'"openlabel"', b'"annotator"')


class DocumentFrame(NamedTuple):
    """A frame of a document: its files, its intrinsics and pose as in the file, and its time."""

    document: Path
    image: str
    cloud: str
    intrinsics: Any
    timestamp_ns: int | None
    place: Any


@dataclass(frozen=True, eq=False)
class OpenLabelFolder(KeyedFrames):
    """A `Recording` of exported OpenLABEL documents; labels are in the camera's frame.

    Attributes:
        documents: the documents; they are large, and read with the first frame.
    """

    documents: tuple[Path, ...]
    format: ClassVar[str] = "openlabel"
    is_sequence: ClassVar[bool] = False

    def document(self, key: str) -> Path:
        """Returns the document of a frame, which has its labels.

        Raises:
            FrameError: a document is damaged, or none has the frame.
        """
        return self.documents[0] if len(self.documents) == 1 else self._listed(key).document

    def files(self, i: int) -> tuple[Path, ...]:
        listed = self._listed(self.key(i))
        return exported_files(self.path, (listed.image, listed.cloud))

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; its up direction is unknown.

        Raises:
            FrameError: a missing or broken file.
            IndexError: there is no such frame.
        """
        key = self.key(i)
        listed = self._listed(key)
        camera = _camera(listed.document, key, listed.intrinsics)
        world = None if listed.place is None else _pose(listed.document, key, listed.place)
        return exported_frame(key, i, self.files(i), camera, None, listed.timestamp_ns, world)

    def _listed(self, key: str) -> DocumentFrame:
        listed = self._frames.get(normal(key))
        if listed is None:
            names = ", ".join(document.name for document in self.documents)
            raise FrameError(self.path / "images" / key, f"is in no document ({names})", REMEDY)
        return listed

    @cached_property
    def _frames(self) -> dict[str, DocumentFrame]:
        frames: dict[str, DocumentFrame] = {}
        for document in self.documents:
            try:
                for frame in _frames(document, read_document(document)["openlabel"]):
                    frames[normal(stem_of(frame.image))] = frame
            except (KeyError, TypeError, AttributeError, ValueError) as error:
                problem = f"is not a document of annotator ({type(error).__name__} {str(error)[:60]})"
                raise FrameError(document, problem, REMEDY) from error
        return frames


def open_openlabel(path: Path) -> OpenLabelFolder | NotFound:
    """Opens the exported documents in the folder `path`; `NotFound` if there are none.

    Raises:
        RecordingError: there is no frame.
    """
    images = path / "images"
    if not (images.is_dir() and (path / "clouds").is_dir()):
        return NotFound(LOOKED_FOR)
    if not any((folder / ORIGINS).is_file() for folder in (path, path.parent)):
        return NotFound(LOOKED_FOR)
    documents = tuple(file for file in sorted(path.glob("*.json")) if _is_ours(file))
    if not documents:
        return NotFound(LOOKED_FOR)
    return OpenLabelFolder(path, sorted_keys(path, stems(images, IMAGE_SUFFIXES), "images/KEY.png"), documents)


def _is_ours(file: Path) -> bool:
    with suppress(OSError), open_file(file) as stream:
        head = stream.read(HEAD_BYTES)
        return all(word in head for word in HEAD)
    return False


def _frames(document: Path, content: Any) -> Iterator[DocumentFrame]:
    """Yields the frames of a document in order; a KeyError or TypeError says what it lacks."""
    common = content["streams"][CAMERA]["stream_properties"]["intrinsics_pinhole"]
    for number in sorted(content["frames"], key=int):
        properties = content["frames"][number]["frame_properties"]
        camera, cloud = properties["streams"][CAMERA], properties["streams"][CLOUD]
        intrinsics = camera["stream_properties"].get("intrinsics_pinhole", common)
        time = properties.get("timestamp")
        yield DocumentFrame(
            document,
            str(camera["uri"]),
            str(cloud["uri"]),
            intrinsics,
            None if time is None else _nanoseconds(str(time)),
            properties.get("transforms", {}).get(PLACE),
        )


def _nanoseconds(seconds: str) -> int:
    """Returns whole nanoseconds; a float would lose some."""
    whole, _, rest = seconds.partition(".")
    time_ns = int(whole[:20]) * 10**9 + int((rest[:9] or "0").ljust(9, "0"))
    if time_ns > LATEST_NS:
        raise ValueError(too_late(seconds, "s"))
    if time_ns < 0:
        raise ValueError(f"the time {seconds[:40]} is negative")
    return time_ns


def _pose(document: Path, key: str, record: Any) -> RigidTransform:
    """Returns the camera's pose from that of the base."""
    try:
        data = record["transform_src_to_dst"]
        place, turn = (np.array(data[name], np.float64) for name in ("translation", "quaternion"))
        if not (are_plausible(place) and are_plausible(turn)):
            raise ValueError("numbers too large")
        return RigidTransform.from_components(place, Rotation.from_quat(turn)) * T_BASE_CAMERA
    except (KeyError, TypeError, ValueError) as error:
        raise FrameError(document, f"frame {key}: its {PLACE} is invalid ({str(error)[:80]})", REMEDY) from error


def _camera(document: Path, key: str, record: Any) -> Camera:
    try:
        K = np.array(record["camera_matrix"], np.float64).reshape(3, 4)[:, :3]
        size = int(record["width_px"]), int(record["height_px"])
        distortion = tuple(float(value) for value in record["distortion_coeffs"])
        if not is_pinhole(K) or not 0 < min(size) <= max(size) <= LARGEST_SIDE_PX:
            raise ValueError("not a pinhole camera")
        fx, fy, cx, cy = (float(K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        # the format needs at least five coefficients
        return Camera(*size, fx, fy, cx, cy, distortion if any(distortion) else ())
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FrameError(document, f"frame {key}: its intrinsics are invalid ({str(error)[:80]})", REMEDY) from error
