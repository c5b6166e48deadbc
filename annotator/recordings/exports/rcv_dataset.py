"""annotator's own dataset format `rcv`: unrelated single frames.

dataset.json           the frames' ids, in order
labels/ID.json         the frame's camera, up direction, time and files [and its labels, read by annotator.formats]
images/ID.png|jpg      clouds/ID.ply, in the camera's frame

The dataset does not say whether its frames are consecutive, so they are not taken as a sequence.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import read_text_file
from annotator.recordings.exports.files import REMEDY, exported_files, exported_frame, read_document
from annotator.recordings.listing import sorted_keys
from annotator.recordings.recording import KeyedFrames, NotFound
from annotator.recordings.rgbd_camera import Number, Positive, Side
from annotator.types import Camera, Frame
from annotator.types.checks import in_time
from annotator.types.errors import FrameError, RecordingError
from annotator.types.messages import first_problem

MANIFEST, LABELS = "dataset.json", "labels"
FORMAT_NAME = "annotator-rcv"
LOOKED_FOR = f"{MANIFEST} with labels/, images/ and clouds/ (an export in the format rcv)"
LEAST_LENGTH = 1e-6
Vector = tuple[Number, Number, Number]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class ManifestFile(_Record):
    """What frames need of `dataset.json`; an id is a file name."""

    format: Literal["annotator-rcv"]
    version: Literal[1]
    frames: tuple[Annotated[str, Field(pattern=r"^[^/\\\x00]+$")], ...]


class CameraRecord(_Record):
    """The camera of a frame, pixels; `distortion` as `Camera`."""

    width_px: Side
    height_px: Side
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    distortion: tuple[Number, ...] = ()


class PoseRecord(_Record):
    """The camera's pose in map coordinates; quaternion w x y z."""

    translation: Vector
    quaternion: tuple[Number, Number, Number, Number]

    def transform(self) -> RigidTransform:
        """Raises ValueError for a quaternion of length zero."""
        rotation = Rotation.from_quat(self.quaternion, scalar_first=True)
        return RigidTransform.from_components(np.array(self.translation), rotation)


class FrameFile(_Record):
    """What a frame needs of `labels/ID.json`."""

    image: str
    cloud: str
    camera: CameraRecord
    up: Vector | None = None
    world: PoseRecord | None = None
    timestamp_ns: Annotated[int, AfterValidator(in_time)] | None = None


@dataclass(frozen=True, eq=False)
class RcvFolder(KeyedFrames):
    """A `Recording` of an `rcv` dataset; labels are in the camera's frame."""

    format: ClassVar[str] = "rcv"
    is_sequence: ClassVar[bool] = False

    def files(self, i: int) -> tuple[Path, ...]:
        path, record = self._record(self.key(i))
        return path, *exported_files(self.path, (record.image, record.cloud))

    def frame(self, i: int) -> Frame:
        """Reads frame `i`.

        Raises:
            FrameError: a missing or broken file.
            IndexError: there is no such frame.
        """
        key = self.key(i)
        path, record = self._record(key)
        try:
            camera = Camera(**record.camera.model_dump())
            world = None if record.world is None else record.world.transform()
        except ValueError as error:
            raise FrameError(path, f"does not describe a frame ({error})", REMEDY) from error
        up = None if record.up is None else np.array(record.up)
        if up is not None:
            length = np.linalg.norm(up)
            if length < LEAST_LENGTH:
                raise FrameError(path, "up has length 0", REMEDY)
            up = up / length
        files = exported_files(self.path, (record.image, record.cloud))
        return exported_frame(key, i, files, camera, up, record.timestamp_ns, world)

    def _record(self, key: str) -> tuple[Path, FrameFile]:
        """Returns the path and the content of a frame's file."""
        path = self.path / LABELS / f"{key}.json"
        try:
            return path, FrameFile.model_validate_json(read_text_file(path))
        except OSError as error:
            raise FrameError(path, f"cannot be read ({error.strerror})", REMEDY) from error
        except ValueError as error:  # pydantic's errors, too
            raise FrameError(path, f"does not describe a frame ({_first_line(error)})", REMEDY) from error


def open_rcv(path: Path) -> RcvFolder | NotFound:
    """Opens the `rcv` dataset at `path`; `NotFound` if it is not one.

    Raises:
        RecordingError: its manifest is damaged, or it has no frames.
    """
    manifest = path / MANIFEST
    if not manifest.is_file():
        return NotFound(LOOKED_FOR)
    content = read_document(manifest)
    if not isinstance(content, dict) or content.get("format") != FORMAT_NAME:
        return NotFound(LOOKED_FOR)
    try:
        keys = ManifestFile.model_validate(content).frames
    except ValidationError as error:
        raise RecordingError(f"{manifest}: {_first_line(error)}; {REMEDY}") from error
    if len(set(keys)) < len(keys):
        raise RecordingError(f"{manifest}: a frame is listed twice; {REMEDY}")
    sorted_keys(path, set(keys), f"frames in {MANIFEST}")  # raises without frames; the manifest has their order
    return RcvFolder(path, keys)


def _first_line(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    return first_problem(error)
