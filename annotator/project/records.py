"""The shared value types as JSON: what goes into an event, and comes back exactly.

Dataclasses of plain numbers (`Box2D`, `StepTrace`, `LostObject` ...) go through pydantic as they are. An `OrientedBox`
goes as a `BoxTrace`: centre, rotation matrix and size as they lie in memory, so that not one bit changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticSerializationError
from scipy.spatial.transform import RigidTransform

from annotator.types import Box2D, OrientedBox, Proposal, PseudoView, Quality, StepTrace
from annotator.types.errors import ProjectError
from annotator.types.proposal import Matrix3

ROTATION_TOLERANCE = 1e-6

# NaN and infinity (a quality that has no value) are written as strings: JSON has no word for them
EXACT = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")


def _rotation(matrix: Matrix3) -> Matrix3:
    array = np.array(matrix)
    if not (np.abs(array.T @ array - np.eye(3)).max() <= ROTATION_TOLERANCE and np.linalg.det(array) > 0):
        raise ValueError("not a rotation matrix (orthonormal, determinant +1)")
    return matrix


Rotation3 = Annotated[Matrix3, AfterValidator(_rotation)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class BoxRecord(BaseModel):
    """An `OrientedBox`: centre and size in metres, columns of `rotation` = box axes, camera frame."""

    model_config = EXACT

    center_m: tuple[Finite, Finite, Finite]
    rotation: Rotation3
    size_m: tuple[Positive, Positive, Positive]

    @classmethod
    def of(cls, box: OrientedBox) -> BoxRecord:
        """The record of a box.

        Raises:
            pydantic.ValidationError: a pose that is not a rotation and a shift.
        """
        matrix = box.T_camera_box.as_matrix()
        return cls.model_validate(
            {"center_m": matrix[:3, 3].tolist(), "rotation": matrix[:3, :3].tolist(), "size_m": box.size_m.tolist()}
        )

    def box(self) -> OrientedBox:
        """The box, equal to the last bit."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.center_m
        # the validator has looked at the rotation; making it orthonormal again would change its last bits
        return OrientedBox(RigidTransform(matrix, normalize=False), np.array(self.size_m))


class ProposalRecord(BaseModel):
    """A `Proposal` with its whole trace."""

    model_config = EXACT

    label: str
    score: Finite
    box: BoxRecord
    image_box: Box2D
    trace: tuple[StepTrace, ...]
    quality: Quality

    @classmethod
    def of(cls, proposal: Proposal) -> ProposalRecord:
        """The record of a proposal."""
        return cls(
            label=proposal.label,
            score=proposal.score,
            box=BoxRecord.of(proposal.box),
            image_box=proposal.image_box,
            trace=proposal.trace,
            quality=proposal.quality,
        )

    def proposal(self) -> Proposal:
        """The proposal, equal in every number."""
        return Proposal(self.label, self.score, self.box.box(), self.image_box, self.trace, self.quality)


class ViewGeometry(BaseModel):
    """How a pseudo-view lies in space, as in `PseudoView`.

    Attributes:
        axes: rows = the view's x, y, z axes as unit vectors in the camera frame.
        metres_per_px: one uniform scale.
        origin_m: view coordinates, metres, of the centre of pixel (0, 0).
        image_box: the box on the camera image whose frustum the view shows, where known; it tells whose views belong
            together.
        look_px: as in `PseudoView`.
    """

    model_config = EXACT

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


_BOX_2D: TypeAdapter[Box2D] = TypeAdapter(Box2D)
BOXES_2D: TypeAdapter[tuple[Box2D, ...]] = TypeAdapter(tuple[Box2D, ...], config=ConfigDict(extra="forbid"))


def box_2d_json(box: Box2D | None) -> str | None:
    """A 2D box as it lies in a column, or None."""
    return None if box is None else _BOX_2D.dump_json(box).decode()


def box_2d_of(content: str | None) -> Box2D | None:
    """The 2D box that a column holds, or None."""
    return None if content is None else _BOX_2D.validate_json(content)


@contextmanager
def storable(what: str) -> Iterator[None]:
    """Turn pydantic's refusal of a value into an error for the user.

    Raises:
        ProjectError: `what` holds a value that would not come back as it was.
    """
    try:
        yield
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        where = ".".join(map(str, detail["loc"]))
        raise ProjectError(f"{what} cannot be stored: {where}: {detail['msg']}") from error
    except PydanticSerializationError as error:
        raise ProjectError(f"{what} cannot be stored: {error}") from error
