"""Generated recordings on disk: an RGB-D folder, or one of scans (`drive`); the exact truth in a separate folder.

color/KEY.jpg  depth/KEY.png  camera_intrinsic.json  gravity.json    as from a camera
points/KEY.npy  timestamps.csv                                       as from a LiDAR: x y z reflectance
poses.csv                                                            of a camera or LiDAR that moves; they may drift
generated.json                                                       the parameters of the generator
truth/boxes.json  truth/mask/KEY.png  truth/poses.csv                the exact ground truth; no masks of scans
"""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import new_folder
from annotator.geometry.oriented_box import box_corners
from annotator.image_bytes import encoded_image
from annotator.synthetic.arrangements import Actor
from annotator.synthetic.drive import drive_scene
from annotator.synthetic.mesh import joined
from annotator.synthetic.people import PERIOD_S
from annotator.synthetic.render import (
    Lidar,
    Sensor,
    colour_image,
    depth_image,
    render,
    scan,
    whole_points,
    whole_px,
)
from annotator.synthetic.scene import Moment, Scene, hands_scene, objects_scene, people_scene, tour_scene
from annotator.types import Camera
from annotator.types.errors import ConfigError

# Minimum visibility of labelled objects: share of the silhouette, and pixels.
LEAST_VISIBLE = 0.1
LEAST_PIXELS = 100
VERSION = 3
MOST_DRIFT = 0.2
# Minimum number of points on an object of a scan.
LEAST_POINTS = 10
LIDAR = Lidar()
# The field of view of common RGB-D cameras: 525 px at a width of 640.
FOCAL_PER_WIDTH = 525 / 640

PRESETS: dict[str, Callable[[np.random.Generator], Scene]] = {
    "people": people_scene,
    "hands": hands_scene,
    "objects": objects_scene,
    "tour": tour_scene,
    "drive": drive_scene,
}
MOVING = ("tour", "drive")

Report = Callable[[int, int], None]


def write_generated(
    path: Path,
    preset: str,
    frames: int,
    seed: int,
    width: int = 640,
    height: int = 480,
    report: Report | None = None,
    drift: float = 0.0,
) -> None:
    """Writes a generated recording; the folder is created only when the recording is complete.

    Args:
        frames: number of frames, at ten per second.
        seed: the same seed gives the same bytes.
        width, height: image size, pixels; scans have none.
        report: called with (frames done, frames) after each frame.
        drift: of the poses of a camera or LiDAR that moves, share of the way.
    """
    if preset not in PRESETS:
        raise ConfigError(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}")
    if frames < 1:
        raise ConfigError(f"frames must be at least 1, not {frames}")
    if seed < 0:
        raise ConfigError(f"the seed must be 0 or more, not {seed}")
    if width < 16 or height < 16:
        raise ConfigError(f"the image must have at least 16 x 16 pixels, not {width} x {height}")
    if not 0 <= drift <= MOST_DRIFT:
        raise ConfigError(f"the drift must be a share of the way, 0 to {MOST_DRIFT}, not {drift:g}")
    if drift and preset not in MOVING:
        raise ConfigError(f"the camera of {preset} stands still, so that its poses do not drift; leave the drift out")
    with new_folder(path, lambda _: False) as folder:
        scene = PRESETS[preset](np.random.default_rng([VERSION, seed]))
        # with the same version, these reproduce the recording byte for byte
        parameters = {"version": VERSION, "preset": preset, "seed": seed, "frames": frames, "period_s": PERIOD_S}
        parameters |= {"drift": drift} if drift else {}
        (folder / "generated.json").write_text(json.dumps(parameters, indent=1) + "\n")
        camera = None if preset == "drive" else _camera(folder, scene, width, height)
        for name in ("points", "truth") if camera is None else ("color", "depth", "truth/mask"):
            (folder / name).mkdir(parents=True)
        boxes, poses = {}, list[RigidTransform]()
        for i in range(frames):
            random, moment = np.random.default_rng([VERSION, seed, i]), next(scene.moments)
            poses.append(scene.T_world_camera if moment.T_world_camera is None else moment.T_world_camera)
            if camera is None:
                boxes[f"{i:06}"] = _write_scan(folder / "points" / f"{i:06}.npy", scene, moment, poses[-1], random)
            else:
                boxes[f"{i:06}"] = _write_frame(folder, f"{i:06}", camera, scene, moment, poses[-1], random)
            if report is not None:
                report(i + 1, frames)
        _write_json(folder / "truth" / "boxes.json", boxes)
        if camera is None:
            times = [f"{key},{round((i + 1) * PERIOD_S * 1e9)}" for i, key in enumerate(boxes)]
            (folder / "timestamps.csv").write_text("\n".join(["key,timestamp_ns", *times]) + "\n")
        if moment.T_world_camera is not None:
            _write_poses(folder / "truth" / "poses.csv", poses)
            _write_poses(folder / "poses.csv", drifting(poses, drift))


def _camera(folder: Path, scene: Scene, width: int, height: int) -> Camera:
    """The camera of a recording, whose files are written."""
    focal = FOCAL_PER_WIDTH * width
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    matrix = {"width": width, "height": height, "intrinsic_matrix": camera.matrix.T.ravel().tolist()}
    _write_json(folder / "camera_intrinsic.json", matrix)
    up = scene.T_world_camera.rotation.inv().apply([0.0, 0.0, 1.0])
    _write_json(folder / "gravity.json", {"up": up.tolist()})
    return camera


def drifting(poses: list[RigidTransform], drift: float) -> list[RigidTransform]:
    """Poses as odometry has them: each step is too long, and turned about the vertical, both by a share of the way."""
    found = poses[:1]
    for first, second in pairwise(poses):
        step = second.translation - first.translation
        turned = Rotation.from_euler("z", 0.5 * drift * np.linalg.norm(step))
        # what went before has turned the step, too
        so_far = found[-1].rotation * first.rotation.inv()
        place = found[-1].translation + (1 + drift) * so_far.apply(step)
        found.append(RigidTransform.from_components(place, turned * so_far * second.rotation))
    return found


def _write_poses(path: Path, poses: list[RigidTransform]) -> None:
    rows = (np.r_[T.translation, T.rotation.as_quat(scalar_first=True)] for T in poses)
    # rounded, so that the text does not depend on the last bits
    lines = [f"{i:06}," + ",".join(f"{value + 0.0:.9f}" for value in row) for i, row in enumerate(rows)]
    path.write_text("\n".join(["key,x,y,z,qw,qx,qy,qz", *lines]) + "\n")


def _write_frame(
    folder: Path,
    key: str,
    camera: Camera,
    scene: Scene,
    moment: Moment,
    pose: RigidTransform,
    random: np.random.Generator,
) -> list[dict[str, object]]:
    """Writes the images of a frame and its mask: the positions of the objects in the list, from 1; 0 elsewhere."""
    mesh = joined([scene.still, *moment.rest, *(actor.mesh for actor in moment.actors)])
    ideal = render(camera, pose, mesh, scene.palette, scene.lights)
    objects: list[dict[str, object]] = []
    mask = np.zeros(ideal.track.shape, np.uint8)
    for actor in moment.actors:
        shown = ideal.track == actor.track
        if shown.sum() >= LEAST_PIXELS:
            visible = min(1.0, float(shown.sum()) / max(whole_px(camera, pose, actor.mesh), 1))
            if visible >= LEAST_VISIBLE:
                objects.append(_entry(actor, pose.inv(), visible))
                mask[shown] = len(objects)
    (folder / "depth" / f"{key}.png").write_bytes(encoded_image(depth_image(ideal, Sensor(), random)))
    (folder / "color" / f"{key}.jpg").write_bytes(encoded_image(colour_image(ideal, random), "jpg"))
    (folder / "truth" / "mask" / f"{key}.png").write_bytes(encoded_image(mask))
    return objects


def _write_scan(
    path: Path, scene: Scene, moment: Moment, pose: RigidTransform, random: np.random.Generator
) -> list[dict[str, object]]:
    """Writes a scan, in the LiDAR's frame; returns its objects."""
    mesh = joined([scene.still, *(actor.mesh for actor in moment.actors)])
    points, T_lidar_world = scan(LIDAR, pose, np.pi, mesh, scene.palette, scene.lights, random), pose.inv()
    xyz_m = T_lidar_world.apply(points.xyz_m).astype(np.float32)
    np.save(path, np.column_stack([xyz_m, points.reflectance]))
    objects = list[dict[str, object]]()
    for actor in moment.actors:
        shown = int((points.track == actor.track).sum())
        if (
            shown >= LEAST_POINTS
            and (visible := min(1.0, shown / whole_points(LIDAR, pose, actor.mesh))) >= LEAST_VISIBLE
        ):
            objects.append(_entry(actor, T_lidar_world, visible))
    return objects


def _entry(actor: Actor, T_camera_world: RigidTransform, visible: float) -> dict[str, object]:
    """`visible`: share of its silhouette, which includes parts beyond the image border."""
    box = actor.box(T_camera_world)
    places = {"center": box.center_m, "size": box.size_m, "rotation": box.rotation, "corners": box_corners(box)}
    # rounded to a nanometre, so that the text does not depend on the last bits
    rounded = {name: np.round(values, 9).tolist() for name, values in places.items()}
    return {"label": actor.label, **rounded, "track": actor.track, "visible": round(visible, 3)}


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content) + "\n")
