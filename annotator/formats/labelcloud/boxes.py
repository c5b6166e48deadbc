"""Boxes in labelCloud's form.

Source: labelCloud 1.1.1, `model/bbox.py`, `utils/math3d.py` and `io/labels/`. A box is rotated about x, then y, then z
of the cloud's frame: R = Rz Ry Rx; sizes are full, length along x, width along y, height along z. `centroid_rel` has
radians in (-pi, pi], `centroid_abs` degrees in 0..360. `vertices` are the corners (-,-,-), (-,+,-), (+,+,-), (+,-,-) in
signs along the box's x, y, z, then the same four on top. Numbers have eight decimals, as in labelCloud's default
settings.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.labelcloud.model import Axes, BoxObject, Dimensions
from annotator.formats.units import BEYOND, MOST_RAD
from annotator.types import OrientedBox
from annotator.types.messages import amount

DECIMALS = 8
SIGNS = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
CORNERS = np.array([[x, y, z] for z in (-1, 1) for x, y in SIGNS]) / 2
# So many angles in degrees are not all below half a turn in radians.
LEAST_SMALL = 10
# Tolerance for corners: rounding to millimetres, or this fraction of the box's smallest side.
OFF_BOX_M, OFF_BOX_SHARE = 2e-3, 1e-2


def centroid_object(name: str, box: OrientedBox) -> BoxObject:
    """Returns a box of the cloud's frame as `centroid_rel`."""
    return BoxObject(
        name=name,
        centroid=_axes(box.center_m),
        dimensions=Dimensions(
            **dict(zip(("length", "width", "height"), map(_rounded, box.size_m.tolist()), strict=True))
        ),
        rotations=_axes(angles_xyz(box.rotation)),
    )


def vertices_object(name: str, box: OrientedBox) -> BoxObject:
    """Returns a box of the cloud's frame as `vertices`."""
    rows = box.T_camera_box.apply(CORNERS * box.size_m).tolist()
    return BoxObject(name=name, vertices=tuple((_rounded(x), _rounded(y), _rounded(z)) for x, y, z in rows))


def box_of(entry: BoxObject, degrees: bool) -> OrientedBox:
    """Returns the box of an object, in the cloud's frame.

    Args:
        degrees: True for angles in degrees; not used for vertices.

    Raises:
        ValueError: the vertices are not those of a box, in labelCloud's order.
    """
    if entry.vertices is not None:
        return _of_vertices(np.array(entry.vertices))
    if entry.centroid is None or entry.dimensions is None or entry.rotations is None:
        raise ValueError("a box needs centroid, dimensions and rotations, or vertices")
    angles = [entry.rotations.z, entry.rotations.y, entry.rotations.x]
    center = np.array([entry.centroid.x, entry.centroid.y, entry.centroid.z])
    size = entry.dimensions
    return OrientedBox.at(
        RigidTransform.from_components(center, Rotation.from_euler("ZYX", angles, degrees=degrees)),
        np.array([size.length, size.width, size.height]),
    )


def angles_xyz(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3"]:
    """Returns the angles x, y, z of R = Rz Ry Rx, radians in [-pi, pi].

    If the box's x axis is vertical (gimbal lock), only the sum or difference of x and z is determined. y and x are
    therefore computed from the rotation that remains after z, so that all three together are exact.
    """
    z = math.atan2(rotation[1, 0], rotation[0, 0])
    rest = Rotation.from_rotvec([0.0, 0.0, -z]).as_matrix() @ rotation
    return np.array([math.atan2(-rest[1, 2], rest[1, 1]), math.atan2(-rest[2, 0], rest[0, 0]), z])


def in_degrees(angles: Iterable[float]) -> bool | None:
    """Returns True for degrees (`centroid_abs`), False for radians, None if both are possible.

    Raises:
        ValueError: some can only be degrees, others only radians.
    """
    lowest, highest = 0.0, 0.0
    for angle in angles:
        lowest, highest = min(lowest, angle), max(highest, angle)
    half = math.pi + 10.0**-DECIMALS
    if lowest < -half or (lowest < 0 and highest > half):
        raise ValueError(f"angles from {lowest} to {highest} are neither radians in -pi..pi nor degrees in 0..360")
    if lowest < 0 or highest == 0:
        return False
    return True if highest > half else None


def contradiction(angles: Sequence[float], *, degrees: bool) -> str | None:
    """Returns what shows that angles are not in the unit that `_classes.json` names; None if nothing does.

    labelCloud writes degrees in 0..360. Negative degrees are those of another program; if all are within half a turn in
    radians, they are radians. So are many angles of which none is larger.

    Args:
        degrees: the unit that the file names; False: radians.
    """
    others = [angle for angle in angles if angle != 0]
    if not others:
        return None
    worst, count = max(others, key=abs), amount(len(others), "angle")
    if not degrees and abs(worst) > MOST_RAD:
        beyond = sum(abs(angle) > MOST_RAD for angle in others)
        return f"{worst:g} is no angle in radians ({beyond} of {count} other than 0 {BEYOND})"
    half = math.pi + 10.0**-DECIMALS
    if degrees and abs(worst) <= half and (min(others) < 0 or len(others) >= LEAST_SMALL):
        return f"{count} other than 0, all within -pi..pi, look like radians"
    return None


def _of_vertices(corners: Float64[np.ndarray, "8 3"]) -> OrientedBox:
    """Returns the box through eight corners; each side is the mean of its four parallel edges."""
    center = corners.mean(axis=0)
    edges = 2 * np.sign(CORNERS).T @ (corners - center) / 8
    size = np.linalg.norm(edges, axis=1)
    if not (size > 0).all():
        raise ValueError("the vertices lie in one plane")
    axes = (edges / size[:, None]).T
    if np.linalg.det(axes) <= 0:
        raise ValueError("the vertices are not in labelCloud's order (seen from above, the first four are clockwise)")
    box = OrientedBox.at(RigidTransform.from_components(center, Rotation.from_matrix(axes)), size)
    off = float(np.abs(box.T_camera_box.apply(CORNERS * size) - corners).max())
    if off > max(OFF_BOX_M, OFF_BOX_SHARE * float(size.min())):
        raise ValueError(f"the vertices lie up to {off:.3f} m off the corners of a box")
    return box


def _axes(values: Float64[np.ndarray, "3"]) -> Axes:
    x, y, z = map(_rounded, values.tolist())
    return Axes(x=x, y=y, z=z)


def _rounded(value: float) -> float:
    # + 0.0: no negative zero
    return round(value, DECIMALS) + 0.0
