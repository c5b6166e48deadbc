"""Point processing in torch, on its CPU device, gives the same pictures, normals, clusters and boxes as numpy."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scenes import CAMERA, frame_with, some_box
from scipy.spatial.transform import Rotation

from annotator.detection.perfect import PerfectDetector
from annotator.detection.yolo import YoloDetector
from annotator.geometry.iou import iou_3d
from annotator.geometry.normals import normals_from_depth
from annotator.geometry.projection import unproject_depth
from annotator.gpu import drawing
from annotator.gpu.compute import TorchCompute
from annotator.gpu.points import DeviceCloud, DevicePoints
from annotator.rcv.axes import axial_kmeans
from annotator.rcv.compute import NUMPY
from annotator.rcv.config import RcvConfig, ViewConfig
from annotator.rcv.propose import propose
from annotator.rcv.pseudo_view import render_pairs
from annotator.types import BoxKind, Camera, Frame, PointCloud
from annotator.types.errors import ComputeError
from annotator.workflows import detectors
from annotator.workflows.detectors import Detectors

TORCH = TorchCompute("cpu")
BOX = some_box([0.2, 0.1, 2.0], [0.5, 0.6, -0.4], [0.5, 0.3, 0.2])


def some_cloud(count: int, rng: np.random.Generator, shade: str) -> PointCloud:
    xyz = (rng.normal(size=(count, 3)) * [0.5, 0.1, 0.3] + [0, 0, 2]).astype(np.float32)
    if shade == "rgb":
        return PointCloud(xyz, rng.integers(0, 256, (count, 3), np.uint8))
    return PointCloud(xyz, reflectance=rng.random(count, np.float32) if shade == "reflectance" else None)


@pytest.mark.parametrize("shade", ["rgb", "reflectance", "depth"])
@pytest.mark.parametrize("count", [1, 40, 3000, 40_000])  # 40_000 points are thinned
def test_pictures_agree_with_those_of_numpy(shade: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(count)
    whole = some_cloud(2 * count, rng, shade)
    frames = [np.eye(3), *Rotation.random(4, rng=rng).as_matrix()]
    keep = np.arange(2 * count) % 2 == 0
    config, show = ViewConfig(size_px=96), np.array([[1.0, 0.2, 2.5]])
    # forces several batches, which must be joined in order
    monkeypatch.setattr(drawing, "MAX_AT_ONCE", 4 * 96 * 96)
    held = DeviceCloud.of(whole, "cpu").select(keep)
    expected = render_pairs(whole.select(keep), frames, config, show)
    views = TORCH.render_pairs(held, frames, config, show)
    assert len(views) == len(expected) == 10
    pixels = different = 0
    for view, other in zip(views, expected, strict=True):
        assert view.rgb.shape == other.rgb.shape
        np.testing.assert_array_equal(view.axes, other.axes)
        np.testing.assert_allclose(view.origin_m, other.origin_m, atol=1e-6)
        assert view.metres_per_px == pytest.approx(other.metres_per_px, rel=1e-6)
        different += int((view.rgb != other.rgb).any(axis=2).sum())
        pixels += view.rgb.shape[0] * view.rgb.shape[1]
    # points between two pixels, or of equal depth, may be rounded differently
    assert different <= 0.002 * pixels


@pytest.mark.parametrize("distortion", [(), (0.1, -0.05, 0.001, -0.002, 0.01)], ids=["ideal", "distorted"])
def test_normals_agree_with_those_of_numpy(distortion: tuple[float, ...]) -> None:
    camera = Camera(120, 90, 100.0, 110.0, 60.0, 44.0, distortion)
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:90, :120]
    depth = (2 + 0.004 * u + 0.3 * np.sin(v / 9) - 0.8 * (u > 70)).astype(np.float32)
    depth += rng.normal(0, 0.002, depth.shape).astype(np.float32)
    depth[rng.random(depth.shape) < 0.05] = 0
    depth[3, 4], depth[30, 40], depth[31, 41] = np.nan, np.inf, -1
    expected = normals_from_depth(camera, depth)
    found = TORCH.normals_from_depth(camera, depth)
    known = (expected != 0).any(axis=2)
    assert known.mean() > 0.8
    assert ((found != 0).any(axis=2) == known).mean() > 0.999
    both = known & (found != 0).any(axis=2)
    # the distance of unit vectors is the angle between them in radians, if small
    assert np.linalg.norm(found[both] - expected[both], axis=1).max() < 1e-3


def test_clusters_agree_with_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    faces = Rotation.random(rng=rng).as_matrix()
    directions = faces[rng.integers(0, 3, 900)] * rng.choice([-1.0, 1.0], (900, 1)) + rng.normal(0, 0.2, (900, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for clusters, seed in ((6, 0), (3, 7), (1, 1)):
        centres, counts = TORCH.axial_kmeans(directions, clusters, seed)
        expected, expected_counts = axial_kmeans(directions, clusters, seed)
        np.testing.assert_array_equal(counts, expected_counts)
        np.testing.assert_allclose(np.abs(np.einsum("ki,ki->k", centres, expected)), 1, atol=1e-12)


def test_more_clusters_than_directions_leave_some_empty() -> None:
    centres, counts = TORCH.axial_kmeans(np.repeat(np.eye(3)[:2], 5, axis=0), 4, 0)
    assert counts.sum() == 10 and np.count_nonzero(counts) == 2
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), 1)


def depth_frame() -> Frame:
    """The scene of `frame_with`, seen by a depth camera: a box in front of a wall."""
    frame, _ = frame_with([BOX])
    v, u = np.mgrid[:480, :640]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    along, origin = rays @ BOX.rotation, BOX.rotation.T @ -BOX.center_m
    with np.errstate(divide="ignore"):
        ends = (np.stack([-BOX.size_m, BOX.size_m]) / 2 - origin)[:, None, None] / along
    near, far = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    depth = np.where(near < far, near, 4.0).astype(np.float32)
    xyz, pixel_index = unproject_depth(CAMERA, depth)
    rgb = np.where((near < far).reshape(-1, 1)[pixel_index], 90, 200).repeat(3, axis=1).astype(np.uint8)
    return replace(frame, cloud=PointCloud(xyz, rgb, pixel_index=pixel_index), depth_m=depth)


class RecordingCompute(TorchCompute):
    """Records the calls."""

    def __init__(self) -> None:
        super().__init__("cpu")
        self.asked: list[str] = []

    def render_pairs(self, *args, **kwargs):
        self.asked.append("pictures")
        return super().render_pairs(*args, **kwargs)

    def normals_from_depth(self, *args):
        self.asked.append("normals")
        return super().normals_from_depth(*args)

    def axial_kmeans(self, *args):
        self.asked.append("clusters")
        return super().axial_kmeans(*args)


def test_a_frame_is_uploaded_once_and_its_boxes_agree_with_those_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, uploads = depth_frame(), []
    _, truths = frame_with([BOX])
    upload = DevicePoints.upload
    monkeypatch.setattr(
        DevicePoints, "upload", lambda cloud, device: uploads.append(len(cloud)) or upload(cloud, device)
    )
    # proposals from silhouettes also use normals and their clusters
    perfect = PerfectDetector.for_frame(frame, truths, kind=BoxKind.SILHOUETTE)
    config = RcvConfig(box_kind=BoxKind.SILHOUETTE)
    recording_compute = RecordingCompute()
    (found,) = propose([frame], perfect, perfect, config, compute=recording_compute)[0].proposals
    assert uploads == [len(frame.cloud)]
    # the steps after the first two use axes from the normals
    assert recording_compute.asked.count("normals") == 1
    assert recording_compute.asked.count("pictures") == len(found.trace)
    assert recording_compute.asked.count("clusters") == len(found.trace) - 2 > 0
    (expected,) = propose([frame], perfect, perfect, config)[0].proposals
    assert len(found.trace) == len(expected.trace) > 1
    assert iou_3d(found.box, expected.box) > 0.98


def test_an_unknown_device_is_named() -> None:
    with pytest.raises(ComputeError, match=r"cannot process points on nonsense .*run the detectors on the CPU"):
        TorchCompute("nonsense")


def test_with_detectors_on_the_cpu_points_are_not_uploaded() -> None:
    perfect = PerfectDetector.for_frame(*frame_with([BOX]))
    frame, _ = frame_with([BOX])
    assert Detectors(perfect, perfect).compute.hold(frame) is frame


@pytest.mark.parametrize(("device", "expected"), [("cuda:1", "cuda:1"), ("mps", None), ("cpu", None)])
def test_points_are_processed_on_the_device_of_the_view_detector(
    device: str, expected: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(detectors, "torch_compute", lambda name: asked.append(name) or TORCH)
    trained = object.__new__(YoloDetector)
    trained._network = SimpleNamespace(device=device, facts=SimpleNamespace(labels=()))
    trained._fingerprint = ""
    compute = Detectors(trained, trained).compute
    assert (compute, asked) == ((TORCH, [expected]) if expected else (NUMPY, []))
