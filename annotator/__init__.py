"""Semi-automatic 3D annotation from a few 2D boxes.

The names in `__all__` are the public Python API (docs/python.md); everything else is private. They are
imported on first use, so that `import annotator` is quick.
"""

# ruff: noqa: F403, F405

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.2.0"

if TYPE_CHECKING:
    from annotator.api import *
else:

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module 'annotator' has no attribute {name!r}")
        from annotator import api

        globals()[name] = value = getattr(api, name)
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


__all__ = [
    "AnnotatorError",
    "ArgumentError",
    "Box2D",
    "BoxKind",
    "Camera",
    "Detector",
    "Frame",
    "FrameProposals",
    "Image",
    "Label",
    "NearestCluster",
    "OrientedBox",
    "PointCloud",
    "Project",
    "Proposal",
    "PseudoView",
    "Recording",
    "ReviewState",
    "Truth",
    "__version__",
    "create_project",
    "draw_boxes",
    "evaluate",
    "evaluate_files",
    "frame_from_points",
    "frame_from_rgbd",
    "generate_recording",
    "iou_3d",
    "nms_3d",
    "open_project",
    "open_recording",
    "perfect_detector",
    "propose",
    "read_labels",
    "read_truth",
    "watch",
    "write_labels",
]
