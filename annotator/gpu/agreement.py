"""Compares views, normals and clusters that a device computes with those of the CPU.

The device computes in the same precision, but sums in another order. So nearly all results are equal except for
rounding errors. In a few places, a rounding error reverses a comparison; the bounds limit the share of these places.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from annotator.rcv.compute import NUMPY, Compute
from annotator.rcv.config import ViewConfig
from annotator.types import Frame, PointCloud, PseudoView
from annotator.types.errors import GeometryError

VIEWS, CLUSTERS, SEED = 6, 6, 0
# Every seventh normal of the frame is clustered, about as many as a large object has.
EACH = 7
# A point midway between two pixels may be drawn at either; of two points at equal depth, either may be visible.
PIXELS_BOUND = 2e-3
# A neighbour at the edge of a surface may be included on one device only, which changes the fitted plane.
NORMALS_BOUND = 1e-3
SAME_RAD = 1e-3
# A direction midway between two centres may belong to either cluster. A centre is the mean of hundreds of directions,
# so one more hardly changes it.
MEMBERS_BOUND = 1e-3
CENTRES_BOUND_RAD = 1e-3

Result = TypeVar("Result")


@dataclass(frozen=True)
class Difference:
    """How much a device's results differ from the CPU's in one kind of work.

    Attributes:
        work: what was computed, such as "normals".
        measure: what `value` measures, such as "share of pixels".
        value, bound: the difference, and its upper limit.
        device_s, processor_s: time of one call, after a warm-up call.
    """

    work: str
    measure: str
    value: float
    bound: float
    device_s: float
    processor_s: float

    @property
    def holds(self) -> bool:
        """True if the difference is within its bound; False for NaN and infinity."""
        return self.value <= self.bound


def drawing(device: Compute, frame: Frame) -> Iterator[Difference]:
    """Compares views of coloured points, of points shaded by depth (large images), and of a subset of the points."""
    axes = list(Rotation.random(VIEWS, rng=np.random.default_rng(SEED)).as_matrix())
    bare = replace(frame, cloud=PointCloud(frame.cloud.xyz_m))
    part = np.arange(0, len(frame.cloud), 5)
    for kind, shown, keep, config in (
        ("all points", frame, None, ViewConfig()),
        ("shaded by depth", bare, None, ViewConfig(size_px=224)),
        ("a part of the points", frame, part, ViewConfig()),
    ):
        computed, device_s = _timed(partial(_draw, device, device.hold(shown), keep, axes, config))
        expected, processor_s = _timed(partial(_draw, NUMPY, shown, keep, axes, config))
        share = _pixels_apart(computed, expected)
        yield Difference(f"drawing, {kind}", "share of pixels", share, PIXELS_BOUND, device_s, processor_s)


def _draw(
    compute: Compute,
    frame: Frame,
    keep: np.ndarray | None,
    axes: Sequence[Float64[np.ndarray, "3 3"]],
    config: ViewConfig,
) -> list[PseudoView]:
    cloud = frame.cloud if keep is None else frame.cloud.select(keep)
    return compute.render_pairs(cloud, axes, config)


def _pixels_apart(computed: list[PseudoView], expected: list[PseudoView]) -> float:
    """The share of pixels that differ; 1 if the views show different parts of space."""
    different = pixels = 0
    if len(computed) != len(expected):
        return 1.0
    for view, other in zip(computed, expected, strict=True):
        same_window = view.rgb.shape == other.rgb.shape and np.allclose(
            [*view.origin_m, view.metres_per_px], [*other.origin_m, other.metres_per_px], rtol=1e-5, atol=1e-5
        )
        if not same_window:
            return 1.0
        different += int((view.rgb != other.rgb).any(axis=2).sum())
        pixels += view.rgb.shape[0] * view.rgb.shape[1]
    return different / pixels


def normals(device: Compute, frame: Frame) -> Iterator[Difference]:
    """Compares the normals of the frame's depth image."""
    depth_m = _depth(frame)
    computed, device_s = _timed(lambda: device.normals_from_depth(frame.camera, depth_m))
    expected, processor_s = _timed(lambda: NUMPY.normals_from_depth(frame.camera, depth_m))
    # the distance between two unit vectors is about their angle, radians; the distance to an unknown normal (0) is 1
    apart = ~(np.linalg.norm(computed - expected, axis=2) <= SAME_RAD)
    yield Difference("normals", "share of pixels", float(apart.mean()), NORMALS_BOUND, device_s, processor_s)


def clusters(device: Compute, frame: Frame) -> Iterator[Difference]:
    """Compares the clusters of the frame's normals."""
    known = NUMPY.normals_from_depth(frame.camera, _depth(frame)).reshape(-1, 3).astype(np.float64)
    directions = known[(known != 0).any(axis=1)][::EACH]
    (centres, counts), device_s = _timed(lambda: device.axial_kmeans(directions, CLUSTERS, SEED))
    (expected, expected_counts), processor_s = _timed(lambda: NUMPY.axial_kmeans(directions, CLUSTERS, SEED))
    moved = float(np.abs(counts - expected_counts).sum() / 2 / len(directions))
    yield Difference("clusters, members", "share of directions", moved, MEMBERS_BOUND, device_s, processor_s)
    # the sign of a centre is arbitrary
    chords = np.minimum(np.linalg.norm(centres - expected, axis=1), np.linalg.norm(centres + expected, axis=1))
    most = float(chords.max())
    yield Difference("clusters, centres", "radians", most, CENTRES_BOUND_RAD, device_s, processor_s)


# Each takes a device and a frame with depth and colours, and raises ComputeError if the device fails.
WORKS: Mapping[str, Callable[[Compute, Frame], Iterator[Difference]]] = {
    "drawing": drawing,
    "normals": normals,
    "clusters": clusters,
}


def _depth(frame: Frame) -> Float32[np.ndarray, "h w"]:
    if frame.depth_m is None:
        raise GeometryError("the comparison needs a frame with depth")
    return frame.depth_m


def _timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """The result and the seconds of a second run; the first one compiles kernels and allocates memory."""
    work()
    begin = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begin
