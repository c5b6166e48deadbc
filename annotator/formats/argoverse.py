"""The boxes of Argoverse 2's sensor data set: `annotations.feather` of a log.

Source: av2-api, `structures/cuboid.py`: one row per box and sweep; centre, quaternion w x y z and full sizes in metres,
in the ego frame of the sweep's time; `track_uuid` names the object. Tracks are numbered in the order of the file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.fenced_files import Kind, read_feather
from annotator.formats.reading import faults
from annotator.geometry.transforms import Quaternions
from annotator.types import OrientedBox, Truth
from annotator.types.errors import FormatError

ANNOTATIONS = "annotations.feather"
NUMBERS = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz", "length_m", "width_m", "height_m")
COLUMNS: dict[str, Kind] = {
    "timestamp_ns": "int",
    "track_uuid": "text",
    "category": "text",
    **dict.fromkeys(NUMBERS, "float"),
}


def read_argoverse(path: Path) -> dict[int, list[Truth]]:
    """Returns the boxes of each sweep, by its time in nanoseconds, in the ego frame of this time.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    with faults(path):
        table = read_feather(path, COLUMNS)
    rows = np.stack([table[name] for name in NUMBERS], axis=1)
    quaternions = Quaternions()
    quaternions.add(rows[:, 3:7].ravel().tolist())
    quaternions.require(path)
    norms = np.linalg.norm(rows[:, 3:7], axis=1)
    if len(wrong := np.flatnonzero(~((norms > 0.5) & (norms < 2.0)))):
        raise FormatError(path, f"row {wrong[0]}: {rows[wrong[0], 3:7].tolist()} is not a unit quaternion")
    turns = Rotation.from_quat(rows[:, 3:7], scalar_first=True)
    poses = RigidTransform.from_components(rows[:, :3], turns).as_matrix()
    tracks: dict[str, int] = {}
    boxes: dict[int, list[Truth]] = {}
    texts = zip(*(table[name].tolist() for name in ("timestamp_ns", "category", "track_uuid")), strict=True)
    for index, (time_ns, label, uuid) in enumerate(texts):
        track = tracks.setdefault(uuid, len(tracks))
        with faults(path, f"row {index}: "):
            box = OrientedBox(poses[index].copy(), rows[index, 7:].copy())
        boxes.setdefault(time_ns, []).append(Truth(label, box, track))
    return boxes
