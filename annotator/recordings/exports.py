"""Datasets that annotator exported, opened as recordings again: unrelated single frames.

rcv, its own format
    dataset.json           the frames' ids, in order; they need not be consecutive
    labels/ID.json         the frame's camera, up direction, time and files [and its labels, read by annotator.formats]
    images/ID.png|jpg      clouds/ID.ply, in the camera's frame
OpenLABEL, or one part of a divided export
    RECORDING.json         one document per recording: frames with files, times and intrinsics [and labels]
    images/ID.png|jpg      clouds/ID.ply, in the camera's frame
    frames.csv             the frames' origins, here or above the parts

The keys are the ids. OpenLABEL of other programs is not opened: its clouds may be in any frame.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from pydantic import AfterValidator, Field
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import open_file, read_file, read_text_file
from annotator.recordings.clouds.cloud_file import CLOUD_SUFFIXES, read_cloud
from annotator.recordings.image_file import read_color_image
from annotator.recordings.listing import IMAGE_SUFFIXES, file_errors, require_size, sorted_keys, stems
from annotator.recordings.plausible import is_pinhole, pinhole
from annotator.recordings.recording import Recording
from annotator.recordings.rgbd_folder import Four, Number, Positive, Side, unit_up
from annotator.text import OutsideError, decoded, inside, normal, stem_of
from annotator.types import Camera, Frame, PointCloud
from annotator.types.bases import FileRecord
from annotator.types.checks import in_time, seconds_ns
from annotator.types.errors import FrameError, RecordingError

REMEDY = "export the dataset again"
# A document may describe a whole recording.
MOST_DOCUMENT_BYTES = 2**28


def read_document(path: Path) -> Any:
    try:
        return json.loads(decoded(read_file(path, MOST_DOCUMENT_BYTES)))
    except (OSError, ValueError, RecursionError) as error:
        raise FrameError(path, f"cannot be read as JSON ({str(error)[:80]})", REMEDY) from error


class Described(NamedTuple):
    camera: Camera
    up: Float64[np.ndarray, "3"] | None
    timestamp_ns: int | None
    T_world_camera: RigidTransform | None


@dataclass(frozen=True, eq=False)
class ExportFolder(Recording):
    """A `Recording` of an export; labels are in the camera's frame."""

    is_sequence: ClassVar[bool] = False

    @abstractmethod
    def named(self, key: str) -> tuple[str, ...]:
        """Returns the names of a frame's files; the image and the cloud are the last ones."""

    @abstractmethod
    def described(self, key: str) -> Described:
        """Returns what a frame's document says."""

    @cached_property
    def pose_source(self) -> str | None:
        try:
            return None if self.described(self.keys[0]).T_world_camera is None else "the export"
        except FrameError:  # the frame reports it
            return None

    def pose(self, i: int) -> RigidTransform | None:
        return self.described(self.key(i)).T_world_camera

    def files(self, i: int) -> tuple[Path, ...]:
        try:
            return tuple(inside(self.path, name) for name in self.named(self.key(i)))
        except OutsideError as error:
            raise FrameError(self.path, f"has a frame whose file {error}", REMEDY) from error

    def frame(self, i: int) -> Frame:
        key = self.key(i)
        *_, image, cloud = self.files(i)
        camera, up, timestamp_ns, T_world_camera = self.described(key)
        size = camera.width_px, camera.height_px
        picture = read_color_image(image, size)
        require_size(image, picture.rgb, size, "its camera has", REMEDY)
        if cloud.suffix.lower() not in CLOUD_SUFFIXES:
            raise FrameError(cloud, f"is none of {' '.join(CLOUD_SUFFIXES)}", REMEDY)
        raw = read_cloud(cloud)
        points = PointCloud(raw.xyz_m.astype(np.float32), rgb=raw.rgb, reflectance=raw.reflectance)
        moment = {"timestamp_ns": timestamp_ns, "T_world_camera": T_world_camera, "in_map": T_world_camera is not None}
        return picture.frame(key, i, camera, points, up=up, **moment)


Vector = tuple[Number, Number, Number]
ORIGINS = "frames.csv"
CAMERA, CLOUD, PLACE = "camera", "cloud", "base_to_world"
# Axes of the base: x forward, y left, z up.
T_BASE_CAMERA = RigidTransform.from_matrix(np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))
# Documents of annotator have this word, and its name, near their beginning.
HEAD_BYTES, HEAD = 1024, (b'"openlabel"', b'"annotator"')


class IntrinsicsRecord(FileRecord):
    """The camera of a document; `camera_matrix` is 3 x 4, row by row."""

    width_px: Side
    height_px: Side
    camera_matrix: Annotated[tuple[Number, ...], Field(min_length=12, max_length=12)]
    distortion_coeffs: tuple[Number, ...]

    def camera(self) -> Camera:
        """Raises ValueError if it is not a pinhole camera."""
        K = np.array(self.camera_matrix).reshape(3, 4)[:, :3]
        if not is_pinhole(K):
            raise ValueError("its intrinsics are not those of a pinhole camera")
        # the format needs at least five coefficients
        distortion = self.distortion_coeffs if any(self.distortion_coeffs) else ()
        return pinhole(K, self.width_px, self.height_px, distortion)


class PoseRecord(FileRecord):
    """A pose; the quaternion is w x y z in rcv, x y z w in OpenLABEL."""

    translation: Vector
    quaternion: Four

    def transform(self, *, w_first: bool) -> RigidTransform:
        """Raises ValueError for a quaternion of length zero."""
        rotation = Rotation.from_quat(self.quaternion, scalar_first=w_first)
        return RigidTransform.from_components(self.translation, rotation)


class TransformRecord(FileRecord):
    transform_src_to_dst: PoseRecord


class DocumentFrame(NamedTuple):
    """A frame of a document: its files, its intrinsics and pose as in the file, and its time."""

    document: Path
    image: str
    cloud: str
    intrinsics: Any
    timestamp_ns: int | None
    place: Any


@dataclass(frozen=True, eq=False)
class OpenLabelFolder(ExportFolder):
    """A `Recording` of exported OpenLABEL documents, which are large, and read with the first frame."""

    documents: tuple[Path, ...]
    format: ClassVar[str] = "openlabel"

    def document(self, key: str) -> Path:
        return self.documents[0] if len(self.documents) == 1 else self._listed(key).document

    def named(self, key: str) -> tuple[str, ...]:
        listed = self._listed(key)
        return listed.image, listed.cloud

    def described(self, key: str) -> Described:
        """Returns what the document says; the up direction is unknown."""
        listed = self._listed(key)
        with file_errors(listed.document, REMEDY, f"frame {key}: "):
            camera = IntrinsicsRecord.model_validate(listed.intrinsics).camera()
            world = None
            if listed.place is not None:
                place = TransformRecord.model_validate(listed.place).transform_src_to_dst
                world = place.transform(w_first=False) * T_BASE_CAMERA
        return Described(camera, None, listed.timestamp_ns, world)

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


def open_openlabel(path: Path) -> OpenLabelFolder | None:
    """Opens the exported documents in the folder `path`; None if there are none."""
    images = path / "images"
    if not (images.is_dir() and (path / "clouds").is_dir()):
        return None
    if not any((folder / ORIGINS).is_file() for folder in (path, path.parent)):
        return None
    documents = tuple(file for file in sorted(path.glob("*.json")) if _is_ours(file))
    if not documents:
        return None
    return OpenLabelFolder(path, sorted_keys(path, stems(images, IMAGE_SUFFIXES), "images/KEY.png"), documents)


def _is_ours(file: Path) -> bool:
    with suppress(OSError), open_file(file) as stream:
        head = stream.read(HEAD_BYTES)
        return all(word in head for word in HEAD)
    return False


def _frames(document: Path, content: Any) -> Iterator[DocumentFrame]:
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
            None if time is None else seconds_ns(str(time)),
            properties.get("transforms", {}).get(PLACE),
        )


MANIFEST, LABELS = "dataset.json", "labels"
FORMAT_NAME = "annotator-rcv"


class ManifestFile(FileRecord):
    """What frames need of `dataset.json`; an id is a file name."""

    format: Literal["annotator-rcv"]
    version: Literal[1]
    frames: tuple[Annotated[str, Field(pattern=r"^[^/\\\x00]+$")], ...]


class CameraRecord(FileRecord):
    """The camera of a frame, pixels; `distortion` as `Camera`."""

    width_px: Side
    height_px: Side
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    distortion: tuple[Number, ...] = ()


class FrameFile(FileRecord):
    image: str
    cloud: str
    camera: CameraRecord
    up: Vector | None = None
    world: PoseRecord | None = None
    timestamp_ns: Annotated[int, AfterValidator(in_time)] | None = None


@dataclass(frozen=True, eq=False)
class RcvFolder(ExportFolder):
    format: ClassVar[str] = "rcv"

    def named(self, key: str) -> tuple[str, ...]:
        record = self._record(key)
        return f"{LABELS}/{key}.json", record.image, record.cloud

    def described(self, key: str) -> Described:
        path, record = self.path / LABELS / f"{key}.json", self._record(key)
        with file_errors(path, REMEDY, "does not describe a frame: "):
            camera = Camera(**record.camera.model_dump())
            world = None if record.world is None else record.world.transform(w_first=True)
        up = None if record.up is None else unit_up(path, record.up, REMEDY)
        return Described(camera, up, record.timestamp_ns, world)

    def _record(self, key: str) -> FrameFile:
        path = self.path / LABELS / f"{key}.json"
        with file_errors(path, REMEDY):
            return FrameFile.model_validate_json(read_text_file(path))


def open_rcv(path: Path) -> RcvFolder | None:
    """Opens the `rcv` dataset at `path`; None if it is not one."""
    manifest = path / MANIFEST
    if not manifest.is_file():
        return None
    content = read_document(manifest)
    if not isinstance(content, dict) or content.get("format") != FORMAT_NAME:
        return None
    with file_errors(manifest, REMEDY, kind=RecordingError):
        keys = ManifestFile.model_validate(content).frames
    if len(set(keys)) < len(keys):
        raise RecordingError(f"{manifest}: a frame is listed twice; {REMEDY}")
    sorted_keys(path, set(keys), f"frames in {MANIFEST}")  # raises without frames; the manifest has their order
    return RcvFolder(path, keys)
