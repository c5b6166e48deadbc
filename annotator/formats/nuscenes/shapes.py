"""Boxes, poses and points in nuScenes' form.

Source: nuscenes-devkit, `utils/data_classes.py`: sizes are width, length, height; a box's x axis points along its
length, y along its width, z along its height, as in annotator; quaternions are w x y z; a scan is float32 x y z
intensity ring, the intensity in 0..255.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.nuscenes.model import Quaternion, Vector3
from annotator.nuscenes_tables import pose
from annotator.types import OrientedBox, PointCloud

MOST_INTENSITY = 255.0


def vector(values: np.ndarray) -> Vector3:
    """Returns three numbers for JSON, without negative zeros."""
    x, y, z = (values + 0.0).tolist()
    return (x, y, z)


def quaternion(rotation: Rotation) -> Quaternion:
    """Returns w x y z, w not negative."""
    w, x, y, z = (rotation.as_quat(canonical=True, scalar_first=True) + 0.0).tolist()
    return (w, x, y, z)


def width_length_height(box: OrientedBox) -> Vector3:
    """Returns the full sizes in nuScenes' order."""
    length, width, height = box.size_m.tolist()
    return (width, length, height)


def box_from(translation: Vector3, rotation: Quaternion, size_wlh: Vector3) -> OrientedBox:
    """Returns the box of an annotation, global frame.

    Raises:
        ValueError: the rotation is not a unit quaternion.
    """
    width, length, height = size_wlh
    return OrientedBox.at(pose(translation, rotation), np.array([length, width, height]))


def scan(cloud: PointCloud, T_level_camera: RigidTransform) -> Float32[np.ndarray, "n 5"]:
    """Returns the points in the level frame with intensity (0 if unknown) and ring (0)."""
    intensity = np.zeros(len(cloud)) if cloud.reflectance is None else cloud.reflectance * MOST_INTENSITY
    return np.column_stack([T_level_camera.apply(cloud.xyz_m), intensity, np.zeros(len(cloud))]).astype("<f4")
