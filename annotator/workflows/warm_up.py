"""Precompiles the numba kernels: `python -m annotator.workflows.warm_up`.

Numba compiles a function on its first call and caches the code on disk (`annotator.compiled`). Compiling all of them
takes half a minute on one core, which otherwise delays the first frame.
"""

from __future__ import annotations

import numpy as np

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.projection import pixel_colors, unproject_depth
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, TypicalSize
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose, propose_from_boxes
from annotator.rcv.starts import WarmStart
from annotator.types import Box2D, BoxKind, Camera, Detector, Frame, OrientedBox, PointCloud, Truth

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
POINTS = 2000


BOX = OrientedBox.from_parts(np.array([0.05, 0.0, 1.5]), np.eye(3), np.array([0.4, 0.3, 0.2]))


def warm_up() -> list[FrameProposals]:
    """Proposes boxes on a synthetic frame with perfect detectors.

    Free and upright, without and with a warm start; then with a class-agnostic detector, as the base detector is.
    """
    frame = warm_frame()
    detector = PerfectDetector.for_frame(frame, [Truth("thing", BOX)])
    agnostic = PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], BOX)])
    configs = [RcvConfig(orientation=orientation) for orientation in (Orientation.FREE, Orientation.UPRIGHT)]
    seeds: tuple[list[WarmStart], ...] = ([], [WarmStart("thing", BOX)])
    of_class = [
        proposals
        for config in configs
        for frame_seeds in seeds
        for proposals in propose([frame], detector, detector, config, [frame_seeds])
    ]
    return of_class + warm_up_with(agnostic, BoxKind.BOX, class_agnostic=True)


def warm_up_with(detector: Detector, kind: BoxKind, class_agnostic: bool) -> list[FrameProposals]:
    """Proposes boxes on the synthetic frame with a view detector, whose first calls are slow.

    A class-agnostic one measures an object without and with a typical size.
    """
    frame = warm_frame()
    on_image = Box2D(detector.labels[0], 52.0, 38.0, 118.0, 82.0)
    typical = TypicalSize(label=on_image.label, size_m=(0.4, 0.3, 0.2), spread=(0.1, 0.1, 0.1))
    configs = [
        RcvConfig(orientation=orientation, typical_sizes=sizes).for_detector(kind, class_agnostic)
        for orientation in (Orientation.FREE, Orientation.UPRIGHT)
        for sizes in ([(), (typical,)] if class_agnostic else [()])
    ]
    return [
        proposals for config in configs for proposals in propose_from_boxes([frame], [[on_image]], detector, config)
    ]


def warm_frame() -> Frame:
    """A small synthetic frame, whose points are those of `BOX`."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-0.5, 0.5, (POINTS, 3)) * BOX.size_m + BOX.center_m
    # as the readers of depth images do
    noise = rng.integers(0, 255, (CAMERA.height_px, CAMERA.width_px, 3)).astype(np.uint8)
    _, pixel = unproject_depth(CAMERA, np.ones(noise.shape[:2], np.float32))
    cloud = PointCloud(xyz.astype(np.float32), pixel_colors(noise, pixel[:POINTS]))
    return Frame("0", 0, CAMERA, np.zeros_like(noise), cloud)


if __name__ == "__main__":
    warm_up()
