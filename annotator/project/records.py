"""Lossless JSON records of the shared value types, for the columns of the tables.

pydantic serialises dataclasses of plain numbers (`Box2D`, `Suggestion`) directly. An `OrientedBox` is
stored as centre, rotation matrix and size, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Literal, TypeVar

import numpy as np
from jaxtyping import UInt8
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticSerializationError
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.types import Box2D, OrientedBox, PseudoView, Suggestion
from annotator.types.bases import SaidRecord, Strict
from annotator.types.errors import RESTORE, ProjectError
from annotator.types.label import Matrix3

ROTATION_TOLERANCE = 1e-6


class Exact(Strict):
    """NaN and infinity (a signal without a value) are written as strings, since JSON has no such numbers."""

    model_config = ConfigDict(ser_json_inf_nan="strings")


Stored = TypeVar("Stored")


def parsed(read: Callable[[str], Stored], text: str) -> Stored:
    """Parses the JSON of a database column with `read`."""
    try:
        return read(text)
    except (ValueError, LookupError, TypeError) as error:
        reason = " ".join(str(error).split())[:100]
        raise ProjectError(f"a row of the project's database is damaged ({reason}); {RESTORE}") from error


def _rotation(matrix: Matrix3) -> Matrix3:
    # without numpy, which takes several times as long for so few numbers
    (a, b, c), (d, e, f), (g, h, i) = matrix
    lengths = (a * a + d * d + g * g, b * b + e * e + h * h, c * c + f * f + i * i)
    angles = (a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i)
    is_unit = all(abs(length - 1) <= ROTATION_TOLERANCE for length in lengths)
    is_square = all(abs(angle) <= ROTATION_TOLERANCE for angle in angles)
    if not (is_unit and is_square and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0):
        raise ValueError("not a rotation matrix (orthonormal, determinant +1)")
    return matrix


Rotation3 = Annotated[Matrix3, AfterValidator(_rotation)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class BoxRecord(Exact):
    """An `OrientedBox`: centre and size in metres, columns of `rotation` = box axes, camera frame."""

    center_m: tuple[Finite, Finite, Finite]
    rotation: Rotation3
    size_m: tuple[Positive, Positive, Positive]

    @classmethod
    def of(cls, box: OrientedBox) -> BoxRecord:
        """The record of a box."""
        matrix = box.pose
        return cls.model_validate(
            {"center_m": matrix[:3, 3].tolist(), "rotation": matrix[:3, :3].tolist(), "size_m": box.size_m.tolist()}
        )

    def box(self) -> OrientedBox:
        """The box, bit for bit."""
        rows = [[*axes, center] for axes, center in zip(self.rotation, self.center_m, strict=True)]
        return OrientedBox(np.array([*rows, [0.0, 0.0, 0.0, 1.0]]), np.array(self.size_m))


class WorldBox(BoxRecord):
    """A box in the frame of the world, of an object that stands still."""

    in_world: Literal[True] = True


# The source of our own proposals beside those of other software.
OWN = "annotator"


class StoredSaid(SaidRecord, Exact):
    """What one source said of an object, where its row no longer says it.

    Attributes:
        source: name of the detector, person or file; `OWN` for annotator's own proposals.
        given: all values that the row has been given, with those that other sources of the object lend it.
    """

    box: BoxRecord
    attributes: dict[str, bool | int | Finite | str] = Field(default_factory=dict)
    file_track_id: int | None = None
    given: dict[str, bool | int | Finite | str] = Field(default_factory=dict)


class ViewGeometry(Exact):
    """Pose and scale of a pseudo-view, as in `PseudoView`.

    Attributes:
        axes: rows = the view's x, y, z axes as unit vectors in the camera frame.
        metres_per_px: one uniform scale.
        origin_m: view coordinates, metres, of the centre of pixel (0, 0).
        image_box: the box on the camera image whose frustum the view shows, if known; views with the same image box
            belong to the same object.
    """

    axes: Rotation3
    metres_per_px: Positive
    origin_m: tuple[Finite, Finite]
    image_box: Box2D | None = None
    look_px: int = Field(0, ge=0)

    @classmethod
    def of(cls, view: PseudoView) -> ViewGeometry:
        """The geometry of a pseudo-view."""
        values = {"axes": view.axes.tolist(), "metres_per_px": view.metres_per_px, "origin_m": view.origin_m.tolist()}
        return cls.model_validate(values | {"look_px": view.look_px})

    def view(self, rgb: UInt8[np.ndarray, "h w 3"]) -> PseudoView:
        """The pseudo-view with this picture; its points are not known."""
        points = np.zeros((0, 3), np.float32)
        return PseudoView(rgb, np.array(self.axes), self.metres_per_px, np.array(self.origin_m), points, self.look_px)


_SUGGESTION: TypeAdapter[Suggestion] = TypeAdapter(Suggestion)
BOX_2D: TypeAdapter[Box2D] = TypeAdapter(Box2D)
BOXES_2D: TypeAdapter[tuple[Box2D, ...]] = TypeAdapter(tuple[Box2D, ...], config=ConfigDict(extra="forbid"))


def suggestion_json(suggestion: Suggestion | None) -> str | None:
    """A suggestion as JSON for a database column, or None."""
    return None if suggestion is None else _SUGGESTION.dump_json(suggestion).decode()


def suggestion_of(content: str | None) -> Suggestion | None:
    """The suggestion of a database column, or None."""
    return None if content is None else parsed(_SUGGESTION.validate_json, content)


@contextmanager
def storable(what: str) -> Iterator[None]:
    """Converts pydantic's errors into errors for the user."""
    try:
        yield
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        where = ".".join(map(str, detail["loc"]))
        raise ProjectError(f"{what} cannot be stored: {where}: {detail['msg']}") from error
    except PydanticSerializationError as error:
        raise ProjectError(f"{what} cannot be stored: {error}") from error


class FramePose(Strict):
    """Where a frame's camera was, estimated.

    Attributes:
        pose: `T_world_camera` of the recorded camera: place, metres, and quaternion w x y z; None = it was not found.
        overlap, rmse, grip: its certainty, as in `annotator.geometry.odometry.Placed`.
    """

    key: str
    pose: tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite] | None
    overlap: Finite
    rmse: Finite
    grip: Finite

    @staticmethod
    def of(key: str, T: RigidTransform | None, overlap: float, rmse: float, grip: float) -> FramePose:
        """Rounds to a hundredth of a millimetre and to a millionth of a degree: there may be 100,000 frames."""
        pose = None
        if T is not None:
            pose = (*T.translation.round(5).tolist(), *T.rotation.as_quat(scalar_first=True).round(8).tolist())
        return FramePose(key=key, pose=pose, overlap=round(overlap, 3), rmse=round(rmse, 5), grip=round(grip, 3))

    def transform(self) -> RigidTransform | None:
        if self.pose is None:
            return None
        turn = Rotation.from_quat(self.pose[3:], scalar_first=True)
        return RigidTransform.from_components(self.pose[:3], turn)


FRAME_POSES: TypeAdapter[tuple[FramePose, ...]] = TypeAdapter(tuple[FramePose, ...])
