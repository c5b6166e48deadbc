"""KITTI's object benchmark: average precision on the image, in bird's-eye view and in 3D, and orientation similarity.

It follows the devkit's program (devkit_object, `cpp/evaluate_object.cpp`) exactly, including the order in which boxes
are matched, and gives the same numbers.
"""

from annotator.evaluation.kitti.protocol import (
    OFFICIAL,
    RELAXED,
    KittiCurve,
    KittiResult,
    Metric,
    MinOverlap,
    evaluate_kitti,
)
from annotator.evaluation.kitti.rows import KittiRows

__all__ = [
    "OFFICIAL",
    "RELAXED",
    "KittiCurve",
    "KittiResult",
    "KittiRows",
    "Metric",
    "MinOverlap",
    "evaluate_kitti",
]
