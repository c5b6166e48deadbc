"""The generated scenes of the pictures, and the 2D boxes that an operator would draw on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import inside_image, project
from annotator.project import open_project
from annotator.recordings import open_recording
from annotator.recordings.clouds.virtual_camera import virtual_image
from annotator.synthetic.arrangements import street
from annotator.synthetic.mesh import joined
from annotator.synthetic.render import Lidar, colour_image, render, scan
from annotator.types import Box2D, Camera, Frame, PointCloud, Truth
from annotator.workflows.recorded.reading import load_truth

# Objects with fewer LiDAR points are left out.
MIN_POINTS = 40
SAME_IOU = 0.1
STREET_CAMERA = Camera(960, 400, 720.0, 720.0, 479.5, 199.5)
LIDAR_ABOVE_CAMERA_M = 0.15
SKY = (176, 200, 224)
# Of `street_drive`: metres between two of its frames, and the turns from the world to a LiDAR (x ahead, y left, z up)
# and to a camera that looks ahead (x right, y down, z ahead).
STEP_M = 0.6
R_LIDAR_WORLD = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
R_AHEAD_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def true_boxes(recording: Path, index: int) -> tuple[Camera, list[Box2D]]:
    """The camera, and the 2D boxes around the true 3D boxes of a frame, from left to right."""
    frame, truths = recorded(recording, index)
    return frame.camera, sorted(image_boxes(frame.camera, truths), key=lambda box: box.x_min)


def unlabelled_boxes(project: Path, recording: Path, frame_id: int) -> tuple[Camera, list[Box2D]]:
    """Like `true_boxes`, without the objects that have a 3D box in the project; `frame_id` counts from 1."""
    frame, truths = recorded(recording, frame_id - 1)
    with open_project(project) as opened:
        known = [label.box for label in opened.labels.of_frame(frame_id)]
    missing = [truth for truth in truths if all(iou_3d(box, truth.box) < SAME_IOU for box in known)]
    return frame.camera, sorted(image_boxes(frame.camera, missing), key=lambda box: box.x_min)


def image_boxes(camera: Camera, truths: list[Truth]) -> list[Box2D]:
    """The 2D boxes around true 3D boxes on the image."""
    found = (box_on_image(camera, truth.box, truth.label) for truth in truths)
    return [box for box in found if box is not None]


def recorded(recording: Path, index: int) -> tuple[Frame, list[Truth]]:
    """A frame of a recording, and its true objects."""
    opened = open_recording(recording)
    frame = opened.frame(index)
    return frame, list(load_truth(opened, index, frame))


def street_frame(seed: int, has_camera: bool) -> tuple[Frame, list[Truth]]:
    """A street, seen by a LiDAR of 64 rings, with or without a camera.

    Args:
        has_camera: False: the image is rendered from the points, as for a recording without images.
    """
    random = np.random.default_rng(seed)
    scene = street(random)
    actors = scene.actors
    eye = scene.T_world_camera.translation + np.array([0.0, 0.0, LIDAR_ABOVE_CAMERA_M])
    pose = RigidTransform.from_components(eye, Rotation.identity())
    half_width = np.arctan(STREET_CAMERA.width_px / 2 / STREET_CAMERA.fx)
    mesh = joined([*scene.still, *(actor.mesh for actor in actors)])
    points = scan(Lidar(), pose, float(half_width), mesh, scene.palette, scene.lights, random)
    T_camera_world = scene.T_world_camera.inv()
    cloud = PointCloud(T_camera_world.apply(points.xyz_m).astype(np.float32), None, points.reflectance)
    seen = inside_image(STREET_CAMERA, project(STREET_CAMERA, cloud.xyz_m)) & (cloud.xyz_m[:, 2] > 0)
    counts = np.bincount(points.track[seen], minlength=len(actors) + 1)
    truths = [Truth(actor.label, actor.box(T_camera_world)) for actor in actors if counts[actor.track] >= MIN_POINTS]
    cloud = cloud.select(seen)
    if has_camera:
        ideal = render(STREET_CAMERA, scene.T_world_camera, mesh, scene.palette, scene.lights)
        ideal.rgb[ideal.depth_m == 0] = SKY
        rgb = colour_image(ideal, random)
    else:
        rgb = virtual_image(STREET_CAMERA, cloud)
    up = T_camera_world.rotation.apply([0.0, 0.0, 1.0])
    return Frame(str(seed), 0, STREET_CAMERA, rgb, cloud, None, up), truths


def street_drive(path: Path, seed: int, frames: int) -> list[list[Truth]]:
    """Writes a drive past a still street: the clouds of a LiDAR alone, x ahead, y left, z up, metres.

    Returns:
        The objects of each frame, in the axes of a camera at the LiDAR that looks ahead.
    """
    random = np.random.default_rng(seed)
    scene = street(random)
    mesh = joined([*scene.still, *(actor.mesh for actor in scene.actors)])
    path.mkdir(parents=True)
    found = []
    for index in range(frames):
        eye = scene.T_world_camera.translation + np.array([0.0, STEP_M * index, LIDAR_ABOVE_CAMERA_M])
        pose = RigidTransform.from_translation(eye)
        points = scan(Lidar(), pose, np.pi, mesh, scene.palette, scene.lights, random)
        cloud = np.c_[(points.xyz_m - eye) @ R_LIDAR_WORLD.T, points.reflectance].astype(np.float32)
        np.save(path / f"{index:06d}.npy", cloud)
        counts = np.bincount(points.track, minlength=len(scene.actors) + 1)
        T_ahead_world = RigidTransform.from_rotation(Rotation.from_matrix(R_AHEAD_WORLD)) * pose.inv()
        seen = [actor for actor in scene.actors if counts[actor.track] >= MIN_POINTS]
        found.append([Truth(actor.label, actor.box(T_ahead_world), actor.track) for actor in seen])
    return found
