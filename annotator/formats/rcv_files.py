"""The JSON of an `rcv` dataset, metres, radians and pixels throughout; and its README.md, which describes it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from annotator.formats.json_file import BoundedTrack
from annotator.types import BoxKind, ReviewState, Source, Suggestion
from annotator.types.messages import amount

FORMAT_NAME = "annotator-rcv"
FORMAT_VERSION = 1
FRAME_OF_REFERENCE = "camera: the colour camera, right-handed, x right, y down, z forward, metres"
BOX_AXES = "x along the length, y along the width, z along the height, origin at the centre"
CORNER_ORDER = ("---", "+--", "++-", "-+-", "--+", "+-+", "+++", "-++")
PIXELS = "continuous; the centre of the first pixel is (0, 0)"
DISTORTION = "OpenCV: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]; empty for an ideal pinhole"

# Limit for metres, pixels and radians; squares of such numbers stay finite.
LARGEST = 1e9
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=LARGEST, allow_inf_nan=False)]
Values = dict[str, bool | int | Number | str]
Vector3 = tuple[Number, Number, Number]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Row8 = tuple[Number, Number, Number, Number, Number, Number, Number, Number]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RcvCamera(_Record):
    """Intrinsics of the colour camera; `distortion` as in `DISTORTION`."""

    width_px: int = Field(gt=0)
    height_px: int = Field(gt=0)
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    distortion: tuple[Number, ...] = ()


class RcvSaid(_Record):
    """What one source, such as a detector, said of an object before its review; the box as in `RcvObject`."""

    source: str = Field(min_length=1, max_length=200)
    label: str = Field(min_length=1)
    score: float | None = Field(None, ge=0, le=1)
    track_id: BoundedTrack | None = None
    box_kind: BoxKind = BoxKind.BOX
    center: Vector3
    size: tuple[Positive, Positive, Positive]
    quaternion: tuple[Number, Number, Number, Number]


class RcvObject(_Record):
    """One object of a frame.

    `center`, `rotation` (columns = box axes in the camera frame) and `size` (length, width, height) are the box;
    `quaternion` (w, x, y, z) and `corners` (Eq. (1): rows x, y, z, 1; columns in `CORNER_ORDER`) repeat it.
    """

    uid: str = Field(min_length=1)
    label: str = Field(min_length=1)
    score: float | None = Field(ge=0, le=1)
    source: Source
    state: ReviewState
    author: str
    time_ns: int
    track_id: BoundedTrack | None
    expected_iou_loss: float | None = Field(None, ge=0, le=1)
    suggestion: Suggestion | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: Values = Field(default_factory=dict)
    said: tuple[RcvSaid, ...] = ()
    center: Vector3
    size: tuple[Positive, Positive, Positive]
    rotation: Matrix3
    quaternion: tuple[Number, Number, Number, Number]
    corners: tuple[Row8, Row8, Row8, Row8]


class RcvPose(_Record):
    """A pose: it maps coordinates p of the camera to `rotation(quaternion) p + translation`."""

    translation: Vector3
    quaternion: tuple[Number, Number, Number, Number]


class RcvLabels(_Record):
    """`labels/ID.json`: one frame.

    `key`, `index` and `recording` are the frame's origin; `up` is the unit vector against gravity in the camera frame,
    None if unknown. `attributes` are values of the frame itself. `world` is the camera's pose in the map coordinates of
    the recording, None without such.
    """

    id: str
    recording: str
    key: str
    index: int = Field(ge=0)
    timestamp_ns: int | None
    image: str
    cloud: str
    points: int = Field(ge=0)
    frame_of_reference: str
    up: Vector3 | None
    camera: RcvCamera
    world: RcvPose | None = None
    attributes: Values = Field(default_factory=dict)
    objects: tuple[RcvObject, ...]


class RcvDetector(_Record):
    """A 2D detector that contributed to the boxes; `role` is its input, such as image or view."""

    role: str
    name: str
    fingerprint: str


class RcvOptions(_Record):
    """How an export is written: lossless PNG, or JPEG at the given quality."""

    image_format: Literal["png", "jpg"] = "png"
    jpeg_quality: int = Field(95, ge=1, le=100)


class RcvConventions(_Record):
    """The conventions of the numbers, in words."""

    frame_of_reference: str = FRAME_OF_REFERENCE
    box_axes: str = BOX_AXES
    rotation: str = "columns = box axes in the camera frame"
    quaternion: str = "w x y z"
    corners: str = "4 x 8, rows x y z 1, columns in corner_order (signs along the box's x y z)"
    corner_order: tuple[str, ...] = CORNER_ORDER
    pixels: str = PIXELS
    distortion: str = DISTORTION


class RcvCameraUse(_Record):
    """A camera and the recordings in which it occurs."""

    camera: RcvCamera
    recordings: tuple[str, ...]


class RcvCounts(_Record):
    """The numbers of frames, points, and objects by class, review state and source."""

    frames: int
    objects: int
    points: int
    frames_by_recording: dict[str, int]
    objects_by_recording: dict[str, int]
    objects_by_class: dict[str, int]
    objects_by_state: dict[ReviewState, int]
    objects_by_source: dict[Source, int]


class RcvManifest(_Record):
    """`dataset.json`: the whole dataset; `frames` lists the ids in order."""

    format: Literal["annotator-rcv"]
    version: Literal[1]
    generator: str
    classes: tuple[str, ...]
    conventions: RcvConventions
    detectors: tuple[RcvDetector, ...]
    options: RcvOptions
    cameras: tuple[RcvCameraUse, ...]
    counts: RcvCounts
    frames: tuple[str, ...]


# The template of the README.md.
README = Path(__file__).with_name("rcv_readme.md")
CLOUD_NOTE = ", then, if the sensor measures them, uchar `red green blue` and float `reflectance` (0..1)"


def readme_text(manifest: RcvManifest) -> str:
    """Returns the README.md for a dataset with this manifest."""
    counts, options = manifest.counts, manifest.options
    jpeg = options.image_format == "jpg"
    tables = [
        _table("class", "objects", counts.objects_by_class),
        _table("review state", "objects", {str(state): n for state, n in counts.objects_by_state.items()}),
        _table("recording", "frames", counts.frames_by_recording),
        _table("recording", "objects", counts.objects_by_recording),
        _table("detector", "name and fingerprint", {d.role: f"{d.name} {d.fingerprint}" for d in manifest.detectors}),
    ]
    return README.read_text(encoding="utf-8").format(
        objects=amount(counts.objects, "object"),
        frames=amount(counts.frames, "frame"),
        generator=manifest.generator,
        format=manifest.format,
        version=manifest.version,
        image=options.image_format,
        image_note=f", JPEG quality {options.jpeg_quality}" if jpeg else ", lossless",
        cloud_note=CLOUD_NOTE,
        classes=", ".join(f"`{name}`" for name in manifest.classes),
        corner_order="  ".join(manifest.conventions.corner_order),
        example=manifest.frames[0],
        tables="\n".join(table for table in tables if table),
    )


def _table(first: str, second: str, rows: dict[str, int] | dict[str, str]) -> str:
    """Returns a Markdown table of two columns; "" without rows."""
    if not rows:
        return ""
    cells = [tuple(str(cell).replace("|", "\\|") for cell in row) for row in rows.items()]
    lines = [f"| {first} | {second} |", "|---|---|", *(f"| {key} | {value} |" for key, value in cells)]
    return "\n".join(lines) + "\n"
