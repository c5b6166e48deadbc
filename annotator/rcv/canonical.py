"""One way to write a box whose axes can be relabelled in 24 ways."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from annotator.types import OrientedBox


def canonical_box(box: OrientedBox, up: Float64[np.ndarray, "3"] | None) -> OrientedBox:
    """The same box with its axes in a fixed order.

    With `up` (unit vector) z points up and length >= width; otherwise length >= width >= height. Of the labellings
    that are left, the one whose axes point most nearly away from the camera and to its right is taken.
    """
    rotation, size = box.rotation, box.size_m
    if up is not None:
        vertical = int(np.argmax(np.abs(up @ rotation)))
        level = [i for i in range(3) if i != vertical]
        order = [*sorted(level, key=lambda i: -size[i]), vertical]
    else:
        order = list(np.argsort(-size, kind="stable"))
    axes = rotation[:, order].copy()
    if up is not None:
        axes[:, 2] *= np.sign(axes[:, 2] @ up)
    elif axes[:, 2] @ np.array([0.3, 0.1, 1.0]) < 0:
        axes[:, 2] *= -1
    if axes[:, 0] @ np.array([1.0, 0.1, 0.3]) < 0:
        axes[:, 0] *= -1
    # the cross product of z and x, which numpy takes longer for than for all else here
    (a, b, c), (d, e, f) = axes[:, 2].tolist(), axes[:, 0].tolist()
    axes[:, 1] = (b * f - c * e, c * d - a * f, a * e - b * d)
    return OrientedBox.from_parts(box.center_m, axes, size[order])
