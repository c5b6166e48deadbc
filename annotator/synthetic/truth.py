"""The exact ground truth of a generated frame: boxes, masks and visibility."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int16, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.synthetic.mesh import Mesh
from annotator.synthetic.render import silhouette
from annotator.synthetic.scene import Actor
from annotator.types import Camera, OrientedBox

# Minimum visibility of labelled objects: share of the silhouette, and pixels.
LEAST_VISIBLE = 0.1
LEAST_PIXELS = 100


@dataclass(frozen=True, eq=False)
class TrueObject:
    """One visible object of a frame.

    Attributes:
        track: track id within the recording.
        label: class name.
        box: tightest box along the object's own axes around its whole surface, hidden parts included; camera frame.
        visible: visible share of its silhouette, which includes parts beyond the image border.
    """

    track: int
    label: str
    box: OrientedBox
    visible: float


def true_objects(
    camera: Camera, T_camera_world: RigidTransform, actors: tuple[Actor, ...], track: Int16[np.ndarray, "h w"]
) -> tuple[list[TrueObject], UInt8[np.ndarray, "h w"]]:
    """The visible objects, and a mask with their positions in the list, from 1; 0 elsewhere."""
    objects: list[TrueObject] = []
    mask = np.zeros(track.shape, np.uint8)
    for actor in actors:
        shown = track == actor.track
        pixels = int(shown.sum())
        if pixels < LEAST_PIXELS:
            continue
        visible = min(1.0, pixels / max(_silhouette_px(camera, T_camera_world, actor.mesh), 1))
        if visible >= LEAST_VISIBLE:
            objects.append(TrueObject(actor.track, actor.label, actor_box(actor, T_camera_world), visible))
            mask[shown] = len(objects)
    return objects, mask


def actor_box(actor: Actor, T_camera_world: RigidTransform) -> OrientedBox:
    """The tightest box along the actor's own axes around all its vertices, camera frame."""
    local = actor.mesh.vertices.astype(np.float64) @ actor.axes
    low, high = local.min(axis=0), local.max(axis=0)
    in_world = OrientedBox.from_parts(actor.axes @ ((low + high) / 2), actor.axes, high - low)
    return in_world.transformed(T_camera_world)


def _silhouette_px(camera: Camera, T_camera_world: RigidTransform, mesh: Mesh) -> int:
    """The number of pixels that the mesh covers without occlusion on an image extended on all sides."""
    outline = silhouette(camera, T_camera_world, mesh, max(camera.width_px, camera.height_px) // 2)
    return camera.width_px * camera.height_px if outline is None else int(outline.sum())
