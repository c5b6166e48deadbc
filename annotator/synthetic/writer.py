"""Generated recordings on disk: an RGB-D folder for `rgbd_folder`; the exact truth in a separate folder.

color/KEY.jpg  depth/KEY.png  camera_intrinsic.json  gravity.json    as from a camera
generated.json                                                       the parameters of the generator
truth/boxes.json  truth/mask/KEY.png                                 the exact ground truth
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Int16, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.files import new_folder
from annotator.geometry.oriented_box import box_corners
from annotator.image_bytes import encoded_image
from annotator.synthetic.mesh import Mesh
from annotator.synthetic.render import Sensor, Stage, colour_image, depth_image, silhouette
from annotator.synthetic.scene import PERIOD_S, Actor, Scene, hands_scene, objects_scene, people_scene
from annotator.types import Camera, OrientedBox
from annotator.types.errors import ConfigError

# Minimum visibility of labelled objects: share of the silhouette, and pixels.
LEAST_VISIBLE = 0.1
LEAST_PIXELS = 100


def _true_objects(
    camera: Camera, T_camera_world: RigidTransform, actors: tuple[Actor, ...], track: Int16[np.ndarray, "h w"]
) -> tuple[list[dict[str, object]], UInt8[np.ndarray, "h w"]]:
    """The visible objects as in `boxes.json`, and a mask with their positions in the list, from 1; 0 elsewhere."""
    objects: list[dict[str, object]] = []
    mask = np.zeros(track.shape, np.uint8)
    for actor in actors:
        shown = track == actor.track
        pixels = int(shown.sum())
        if pixels < LEAST_PIXELS:
            continue
        visible = min(1.0, pixels / max(_silhouette_px(camera, T_camera_world, actor.mesh), 1))
        if visible >= LEAST_VISIBLE:
            objects.append(_entry(actor, actor_box(actor, T_camera_world), visible))
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


VERSION = 1
# The field of view of common RGB-D cameras: 525 px at a width of 640.
FOCAL_PER_WIDTH = 525 / 640

PRESETS: dict[str, Callable[[np.random.Generator], Scene]] = {
    "people": people_scene,
    "hands": hands_scene,
    "objects": objects_scene,
}

Report = Callable[[int, int], None]


def write_generated(
    path: Path,
    preset: str,
    frames: int,
    seed: int,
    width: int = 640,
    height: int = 480,
    report: Report | None = None,
) -> None:
    """Writes a generated recording; the folder is created only when the recording is complete.

    Args:
        frames: number of frames, at ten per second.
        seed: the same seed gives the same bytes.
        width, height: image size, pixels.
        report: called with (frames done, frames) after each frame.
    """
    _check(preset, frames, seed, width, height)
    with new_folder(path, lambda _: False) as part:
        _write(part, preset, frames, seed, _camera(width, height), report)


def _check(preset: str, frames: int, seed: int, width: int, height: int) -> None:
    if preset not in PRESETS:
        raise ConfigError(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}")
    if frames < 1:
        raise ConfigError(f"frames must be at least 1, not {frames}")
    if seed < 0:
        raise ConfigError(f"the seed must be 0 or more, not {seed}")
    if width < 16 or height < 16:
        raise ConfigError(f"the image must have at least 16 x 16 pixels, not {width} x {height}")


def _camera(width: int, height: int) -> Camera:
    focal = FOCAL_PER_WIDTH * width
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _write(folder: Path, preset: str, frames: int, seed: int, camera: Camera, report: Report | None) -> None:
    scene = PRESETS[preset](np.random.default_rng([VERSION, seed]))
    for name in ("color", "depth", "truth/mask"):
        (folder / name).mkdir(parents=True)
    # with the same version, these reproduce the recording byte for byte
    parameters = {"version": VERSION, "preset": preset, "seed": seed, "frames": frames, "period_s": PERIOD_S}
    (folder / "generated.json").write_text(json.dumps(parameters, indent=1) + "\n")
    intrinsics = {"width": camera.width_px, "height": camera.height_px}
    column_major = camera.matrix.T.ravel().tolist()
    _write_json(folder / "camera_intrinsic.json", {**intrinsics, "intrinsic_matrix": column_major})
    up = scene.T_world_camera.rotation.inv().apply([0.0, 0.0, 1.0])
    _write_json(folder / "gravity.json", {"up": up.tolist()})
    stage = Stage(camera, scene.T_world_camera, scene.still, scene.palette, scene.lights)
    boxes = {}
    for i in range(frames):
        key = f"{i:06}"
        random = np.random.default_rng([VERSION, seed, i])
        boxes[key] = _write_frame(folder, key, stage, scene, random)
        if report is not None:
            report(i + 1, frames)
    _write_json(folder / "truth" / "boxes.json", boxes)


def _write_frame(
    folder: Path, key: str, stage: Stage, scene: Scene, random: np.random.Generator
) -> list[dict[str, object]]:
    moment = next(scene.moments)
    ideal = stage.render([*moment.rest, *(actor.mesh for actor in moment.actors)])
    objects, mask = _true_objects(stage.camera, scene.T_world_camera.inv(), moment.actors, ideal.track)
    sensor = Sensor()
    (folder / "depth" / f"{key}.png").write_bytes(encoded_image(depth_image(ideal, sensor, random)))
    (folder / "color" / f"{key}.jpg").write_bytes(encoded_image(colour_image(ideal, sensor, random), "jpg"))
    (folder / "truth" / "mask" / f"{key}.png").write_bytes(encoded_image(mask))
    return objects


def _entry(actor: Actor, box: OrientedBox, visible: float) -> dict[str, object]:
    """`visible`: share of its silhouette, which includes parts beyond the image border."""
    return {
        "label": actor.label,
        "center": _rounded(box.center_m),
        "size": _rounded(box.size_m),
        "rotation": _rounded(box.rotation),
        "corners": _rounded(box_corners(box)),
        "track": actor.track,
        "visible": round(visible, 3),
    }


def _rounded(values: np.ndarray) -> list[object]:
    """Rounded to a nanometre, so that the text does not depend on the last bits."""
    return list(np.round(values, 9).tolist())


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content) + "\n")
