"""Handles in the middles of the selected box's faces: a dragged one moves its face, the opposite one stays."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float64

from annotator.geometry.oriented_box import CORNER_SIGNS
from annotator.types import OrientedBox

if TYPE_CHECKING:
    import viser

    OnFace = Callable[[viser.SceneNodeDragEvent[viser.BatchedMeshHandle]], Coroutine[None, None, None]]

Vector = Float64[np.ndarray, "3"]

HANDLES = "/selected/faces"
# Directions of the faces in the box's axes.
FACES = np.concatenate([np.eye(3), -np.eye(3)])
COLOR = (255, 255, 255)
# Side of a handle: a share of the box's mean side, which no short side makes larger than itself.
SIDE_SHARE, SIDE_OF_SHORTEST = 0.07, 0.5
# The shortest box that a drag leaves, metres.
LEAST_M = 0.02
# A cube's sides by its corners, and as triangles.
QUADS = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
TRIANGLES = QUADS[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def moved_face(box: OrientedBox, face: int, eye_m: Vector, grabbed_m: Vector, pointer_m: Vector) -> OrientedBox:
    """The box with one face moved along its normal, from below the pointer where it was grabbed to where it is now.

    Args:
        face: row of `FACES`.
        eye_m: of the viewer; with the two others, points on the rays of the pointer.
    """
    normal = box.rotation @ FACES[face]

    def along_m(point_m: Vector) -> float:
        """Where the box's axis comes closest to the ray through a point."""
        ray = (point_m - eye_m) / np.linalg.norm(point_m - eye_m)
        cosine, start = float(normal @ ray), box.center_m - eye_m
        return float(cosine * (ray @ start) - normal @ start) / max(1 - cosine**2, 1e-3)

    axis = face % 3
    grown_m = max(along_m(pointer_m) - along_m(grabbed_m), LEAST_M - float(box.size_m[axis]))
    size_m = box.size_m.copy()
    size_m[axis] += grown_m
    return OrientedBox.from_parts(box.center_m + 0.5 * grown_m * normal, box.rotation, size_m)


class FaceHandles:
    """The handles of one viser server, in the axes of the selected box, whose node is their parent."""

    def __init__(self, api: viser.SceneApi, on_drag: OnFace) -> None:
        self._api, self._on_drag = api, on_drag
        self._handles: viser.BatchedMeshHandle | None = None

    def show(self, size_m: Float[np.ndarray, "3"] | None) -> None:
        """Shows the handles of a box of this size; None hides them."""
        if size_m is None:
            if self._handles is not None:
                self._handles.visible = False
            return
        side_m = min(SIDE_SHARE * float(size_m.mean()), SIDE_OF_SHORTEST * float(size_m.min()))
        positions, scales = (0.5 * FACES * size_m).astype(np.float32), np.full(len(FACES), side_m, np.float32)
        if self._handles is None:
            # only these are lit: lines and points have colours of their own
            self._api.add_light_ambient("/light", intensity=3.0)
            self._handles = self._api.add_batched_meshes_simple(
                HANDLES,
                (0.5 * CORNER_SIGNS).astype(np.float32),
                TRIANGLES,
                np.tile(np.array([1.0, 0, 0, 0], np.float32), (len(FACES), 1)),
                positions,
                batched_scales=scales,
                batched_colors=COLOR,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
                side="double",
            )
            self._handles.on_drag(self._on_drag)
        self._handles.batched_positions, self._handles.batched_scales = positions, scales
        self._handles.visible = True
