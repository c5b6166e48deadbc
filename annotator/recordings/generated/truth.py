"""The exact answer to a generated frame: boxes, masks, and how much of each object can be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int16, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.recordings.generated.mesh import Mesh
from annotator.recordings.generated.scene import Actor
from annotator.recordings.generated.silhouette import silhouette
from annotator.types import Camera, OrientedBox

# An object of which less can be seen is left out: nobody could label it.
LEAST_VISIBLE = 0.1
LEAST_PIXELS = 100


@dataclass(frozen=True, eq=False)
class TrueObject:
    """One object that can be seen in a frame.

    Attributes:
        track: its number over the recording.
        label: its class.
        box: tightest around all of its surface (hidden parts included) along its own axes, camera frame.
        visible: share of its silhouette, parts beyond the image's border included, that can be seen.
    """

    track: int
    label: str
    box: OrientedBox
    visible: float


def true_objects(
    camera: Camera, T_camera_world: RigidTransform, actors: tuple[Actor, ...], track: Int16[np.ndarray, "h w"]
) -> tuple[list[TrueObject], UInt8[np.ndarray, "h w"]]:
    """The objects that can be seen, and the mask with their numbers in the list, from 1; 0 elsewhere."""
    objects: list[TrueObject] = []
    mask = np.zeros(track.shape, np.uint8)
    for actor in actors:
        seen = track == actor.track
        pixels = int(seen.sum())
        if pixels < LEAST_PIXELS:
            continue
        visible = min(1.0, pixels / max(_silhouette_px(camera, T_camera_world, actor.mesh), 1))
        if visible >= LEAST_VISIBLE:
            objects.append(TrueObject(actor.track, actor.label, actor_box(actor, T_camera_world), visible))
            mask[seen] = len(objects)
    return objects, mask


def actor_box(actor: Actor, T_camera_world: RigidTransform) -> OrientedBox:
    """The tightest box along the actor's own axes around all vertices, camera frame."""
    local = actor.mesh.vertices.astype(np.float64) @ actor.axes
    low, high = local.min(axis=0), local.max(axis=0)
    in_world = OrientedBox.from_parts(actor.axes @ ((low + high) / 2), actor.axes, high - low)
    return in_world.transformed(T_camera_world)


def _silhouette_px(camera: Camera, T_camera_world: RigidTransform, mesh: Mesh) -> int:
    """Pixels that the mesh would cover if nothing were in front and the image were twice as wide and high."""
    outline = silhouette(camera, T_camera_world, mesh, max(camera.width_px, camera.height_px) // 2)
    return camera.width_px * camera.height_px if outline is None else int(outline.sum())
