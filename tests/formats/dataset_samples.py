"""Small frames, labels and boxes for tests of dataset formats."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import DatasetInfo, DatasetItem, DatasetWriter, Losses, write_dataset
from annotator.formats.table import FORMATS
from annotator.types import Camera, Frame, Label, OrientedBox, PointCloud, ReviewState, Source

CAMERA = Camera(6, 4, 5.0, 5.5, 2.5, 1.5)


def make_box(
    center: tuple[float, ...] = (0.1, -0.2, 1.5),
    rotation: tuple[float, ...] = (0.3, -0.4, 0.5),
    size: tuple[float, ...] = (0.5, 0.25, 1.75),
) -> OrientedBox:
    """A box from its centre, rotation vector and size."""
    return OrientedBox.at(
        RigidTransform.from_components(np.array(center), Rotation.from_rotvec(np.array(rotation))),
        np.array(size, np.float64),
    )


def make_label(box: OrientedBox | None = None, **changes: Any) -> Label:
    known: dict[str, Any] = {
        "uid": "u1", "label": "hand", "box": box or make_box(), "score": None, "source": Source.MANUAL,
        "state": ReviewState.ACCEPTED, "author": "ann", "time_ns": 1, "track_id": None,
    }  # fmt: skip
    return Label(**{**known, **changes})


def make_item(
    labels: Sequence[Label] = (),
    *,
    key: str = "000003",
    index: int = 3,
    recording: str = "rec",
    split: str | None = None,
    up: tuple[float, float, float] | None = (0.0, -1.0, 0.0),
    camera: Camera = CAMERA,
    timestamp_ns: int | None = 1_700_000_000_123_456_789,
    T_world_camera: RigidTransform | None = None,
    attributes: dict[str, Any] | None = None,
) -> DatasetItem:
    """A frame of five coloured points, by default of 6 x 4 pixels."""
    rng = np.random.default_rng(index)
    cloud = PointCloud(rng.normal(size=(5, 3)).astype(np.float32), rng.integers(0, 256, (5, 3), np.uint8))
    rgb = rng.integers(0, 256, (camera.height_px, camera.width_px, 3), np.uint8)
    against = None if up is None else np.array(up)
    frame = Frame(
        key, index, camera, rgb, cloud, up=against, timestamp_ns=timestamp_ns, T_world_camera=T_world_camera
    )  # fmt: skip
    return DatasetItem(recording, frame, labels, split, attributes or {})


def write(
    name: str,
    out: Path,
    items: Iterable[DatasetItem],
    losses: Losses | None = None,
    *,
    overwrite: bool = False,
    classes: Sequence[str] = ("hand", "night stand"),
    **info: Any,
) -> DatasetWriter:
    """Writes a dataset in the format of that name."""
    if isinstance(items, Sequence):
        info["places"] = [(item.recording, item.frame.key, item.frame.index) for item in items]
        info["free_tracks"] = {item.recording: 100 for item in items}
    given = DatasetInfo(tuple(classes), "annotator 0.1.0", **info)
    return write_dataset(FORMATS[name], out, items, given, losses, overwrite=overwrite)


def assert_same_box(have: OrientedBox, want: OrientedBox, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(have.center_m, want.center_m, rtol=1e-9, atol=atol)
    np.testing.assert_allclose(have.size_m, want.size_m, rtol=1e-9, atol=atol)
    np.testing.assert_allclose(have.rotation, want.rotation, rtol=0, atol=atol)


_numbers = st.floats(-100, 100)
BOXES = st.builds(
    make_box,
    st.tuples(_numbers, _numbers, _numbers),
    st.tuples(*[st.floats(-4, 4)] * 3),
    st.tuples(*[st.floats(1e-3, 50)] * 3),
)
