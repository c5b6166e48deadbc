"""Exact intersection volume of two oriented boxes, for many pairs at once (compiled: `kernels.slab_volumes`).

Two boxes are six slabs: pairs of parallel planes. Each edge of the intersection lies on the line where planes of
two different slabs meet, between the points where the line enters and leaves the four other slabs. With 15 pairs
of slabs and 4 pairs of planes each, there are 60 such lines, and the divergence theorem, applied twice, makes the
volume a sum over them:

    V = 1/3 sum_faces d_i A_i,   A_i = 1/2 sum_edges e_ij L_ij,   e_ij = (d_j - c_ij d_i) / s_ij

with d a plane's distance from the origin along its outward normal, c and s the cosine and sine of the angle
between two normals, and L_ij what the slabs leave of the line. No face polygon is ever built, and every pair of
boxes costs the same steps.

Faces that lie in one plane, or nearly: where three planes meet is computed once, and used for all three lines, so
a line that ends at a nearly parallel plane ends exactly where the other plane's line begins, wherever rounding
puts that point. Edges that coincide would still be counted twice or not at all, so axes that are parallel but
for rounding are made parallel, and then one of the boxes is made larger by a share (`TIE`) far below the accuracy
claimed and far above rounding.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from annotator.types.errors import GeometryError

Centers = Float[np.ndarray, "n 3"]
Rotations = Float[np.ndarray, "n 3 3"]
Volumes = Float64[np.ndarray, "n"]


def intersection_volume_pairs(
    centers_a: Centers,
    rotations_a: Rotations,
    sizes_a: Centers,
    centers_b: Centers,
    rotations_b: Rotations,
    sizes_b: Centers,
) -> Volumes:
    """Volume of the intersection of box a and box b of each of n pairs.

    Args:
        centers_a, centers_b: box centres, metres, in one frame.
        rotations_a, rotations_b: columns = box axes in that frame.
        sizes_a, sizes_b: full lengths along the box axes, metres, positive.

    Returns:
        (n,) cubic metres, between 0 and the volume of the smaller box.

    Raises:
        GeometryError: a size that is not positive, or a value that is not finite.
    """
    from annotator.geometry.kernels.slab_volumes import intersection_volumes

    boxes_a = _checked(centers_a, rotations_a, sizes_a)
    boxes_b = _checked(centers_b, rotations_b, sizes_b)
    return intersection_volumes(*boxes_a, *boxes_b)


def _checked(centers: Centers, rotations: Rotations, sizes: Centers) -> list[np.ndarray]:
    boxes = [np.array(values, np.float64, order="C") for values in (centers, rotations, sizes)]
    if not all(np.isfinite(values).all() for values in boxes) or (boxes[2] <= 0).any():
        raise GeometryError("boxes must have finite poses and finite, positive sizes to be intersected")
    return boxes
