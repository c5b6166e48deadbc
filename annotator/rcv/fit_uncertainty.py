"""How uncertain a fitted box is: the IoU that it is expected to lose to the errors of its measured edges."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

# Mean absolute value of a Gaussian variable, in its standard deviations.
MEAN_ABSOLUTE = float(np.sqrt(2 / np.pi))
# Keeps the equations solvable if an unknown is not measured; its variance is then very large.
RIDGE = 1e-9


def expected_iou_loss(
    directions: Float64[np.ndarray, "m 3"],
    weights: Float64[np.ndarray, "m 2"],
    rotation: Float64[np.ndarray, "3 3"],
    size_m: Float64[np.ndarray, "3"],
    held: bool,
    scale: float = 1.0,
) -> float:
    """The expected 1 - IoU of a box with the true one, if its edges' errors are independent.

    The inverse of the weighted normal equations is the covariance of centre, sides and rotation. From it follows by how
    much each face moves, and from that the volume between the two boxes.

    Args:
        directions: unit vectors along which intervals were measured.
        weights: of the low and high end of each; one over the variance, square metres; 0 for an unknown end.
        rotation: columns = box axes.
        size_m: full side lengths.
        held: the box turns about its z axis only.
        scale: factor on all standard deviations.

    Returns:
        0 (certain) to 1.
    """
    along = directions @ rotation
    lever = np.sign(along) * size_m / 2
    turns = np.cross(lever, along)
    reach = np.concatenate([np.abs(along) / 2, turns[:, 2:] if held else turns], axis=1)
    # rows of the low and the high end; the centre in box axes
    rows = np.concatenate([np.concatenate([along, -reach], axis=1), np.concatenate([along, reach], axis=1)])
    normal = rows.T @ (rows * weights.T.reshape(-1, 1))
    units = np.sqrt(np.maximum(np.diag(normal), RIDGE))
    products = np.outer(units, units)
    covariance = np.linalg.inv(normal / products + RIDGE * np.eye(len(normal))) / products
    variance = np.diag(covariance)
    center, side, both = variance[:3], variance[3:6], covariance[[0, 1, 2], [3, 4, 5]]
    turn = np.zeros(3)
    turn[2 if held else 0 :] = variance[6:]
    # a turn about one axis tilts the faces across the second by an amount that grows along the third
    squares = size_m**2 / 12
    tilt = np.array([turn[[2, 1]] @ squares[[1, 2]], turn[[2, 0]] @ squares[[0, 2]], turn[[1, 0]] @ squares[[0, 1]]])
    faces = np.sqrt(np.maximum(center + side / 4 + np.array([[1.0], [-1.0]]) * both, 0.0) + tilt)
    between = MEAN_ABSOLUTE * scale * float((faces / size_m).sum())
    # half of the volume between the boxes is inside each of them
    return min(between / (1 + between / 2), 1.0)
