"""Self-tests: compares the backends with torch on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.geometry.projection import pixel_colors, unproject_depth
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import AnnotatorError
from annotator.workflows.doctor.report import Line, State

SECTION = "self-test"
REPORT_IT = "report this, with the whole output"
CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
# Height and width of the test images: multiples of the network's stride, and different from those that exports are
# traced with.
PICTURE_PX = (96, 128)


def generated_frame() -> Frame:
    """Returns a frame with a rotated box, a floor and a wall, as from a depth camera with noise and missing pixels."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    rotation = Rotation.from_rotvec([0.5, 0.6, -0.4]).as_matrix()
    along, origin = rays @ rotation, np.array([0.2, 0.1, 2.0]) @ rotation
    half = np.array([0.35, 0.25, 0.2])
    ends = np.stack([origin - half, origin + half])[:, None, None] / along
    near, far = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    # y points down: the floor is a metre below the camera
    floor = np.divide(1.0, rays[..., 1], out=np.full(u.shape, np.inf), where=rays[..., 1] > 0)
    wall = 4.0 / (1 + 0.2 * rays[..., 0])
    depth = np.minimum(np.where(near < far, near, np.inf), np.minimum(floor, wall))
    depth = (depth + rng.normal(0, 0.002, depth.shape)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.03] = 0
    shade = np.where(near < far, 200, np.where(floor < wall, 120, 60))[..., None] + rng.integers(-40, 41, (*u.shape, 3))
    rgb = shade.astype(np.uint8)
    xyz, pixel_index = unproject_depth(CAMERA, depth)
    cloud = PointCloud(xyz, pixel_colors(rgb, pixel_index), pixel_index=pixel_index)
    return Frame("0", 0, CAMERA, rgb, cloud, depth)


def backends(_: Path) -> Iterator[Line]:
    """Compares the raw output of each backend with that of torch on the CPU, for a network with seeded weights."""
    from annotator.detection.backends.agreement import TOLERANCE, Agreements, BackendMissingError, openers
    from annotator.detection.pretrained import write_seeded_network

    rgb, (rows, columns) = generated_frame().rgb, PICTURE_PX
    pictures = np.stack([rgb[:rows, :columns], rgb[-rows:, -columns:]])
    with TemporaryDirectory() as folder:
        weights = Path(folder) / "network.safetensors"
        try:
            write_seeded_network(weights)
            agreements = Agreements(weights, pictures)
        except AnnotatorError as error:
            yield Line(section=SECTION, name="backends", state=State.WARNING, found=f"not tested ({error})")
            return
        for name, opener in openers(_cuda()).items():
            try:
                agreement = agreements.of(opener)
            except BackendMissingError as error:
                yield Line(section=SECTION, name=name, state=State.OK, found=f"{error}; not tested")
            except AnnotatorError as error:
                yield Line(section=SECTION, name=name, state=State.FAILED, found=str(error), remedy=REPORT_IT)
            else:
                figures = {
                    "boxes_px": agreement.boxes_px,
                    "boxes_bound_px": agreement.boxes_bound_px,
                    "scores": agreement.scores,
                    "scores_bound": agreement.scores_bound,
                    "spreads_px": agreement.spreads_px,
                    "spreads_bound_px": agreement.spreads_bound_px,
                }
                result = (
                    f"differs from torch in single precision by {agreement.boxes_px:.2g} px (boxes), "
                    f"{agreement.scores:.2g} (scores) and {agreement.spreads_px:.2g} px (spreads of edges); allowed: "
                    f"{agreement.boxes_bound_px:.2g} px, {agreement.scores_bound:.2g} and "
                    f"{agreement.spreads_bound_px:.2g} px, {TOLERANCE[agreement.reference]:.0f} x the difference of "
                    f"torch in {agreement.reference}"
                )
                state = State.OK if agreement.holds else State.FAILED
                remedy = "" if agreement.holds else f"use another --backend, and {REPORT_IT}"
                yield Line(section=SECTION, name=name, state=state, found=result, remedy=remedy, figures=figures)


def _cuda() -> list[str]:
    """Returns the names of the CUDA devices; empty if torch is missing or broken, which `packages.torch` reports."""
    from annotator.detection.ultralytics_api import cuda_devices

    try:
        return [device.name for device in cuda_devices()]
    except (ImportError, OSError, RuntimeError, AssertionError):
        return []
