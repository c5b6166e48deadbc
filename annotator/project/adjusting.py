"""The adjustment of a recording: its up direction, and the correction of its calibration.

Boxes and pseudo-views are stored in the frame of the recorded cloud, so they stay where they are in the clouds when the
correction changes. They are moved to the frame of the camera when they are read.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from pydantic import TypeAdapter
from scipy.spatial.transform import RigidTransform

from annotator.project.database.schema import AnyRow
from annotator.project.records import BoxRecord, ViewGeometry, parsed
from annotator.types import NO_CORRECTION, Correction
from annotator.types.errors import ProjectError

Up = tuple[float, float, float]


@dataclass(frozen=True)
class Adjustment:
    """What the project sets for a recording.

    Attributes:
        up: unit vector against gravity in the (corrected) camera frame; None = as the files give it.
    """

    up: Up | None
    correction: Correction = NO_CORRECTION

    def corrected(self, correction: Correction) -> Adjustment:
        """With another correction; a set up direction turns with the cloud."""
        if self.up is None:
            return Adjustment(None, correction)
        turned = correction.T_camera_recorded * self.correction.T_camera_recorded.inv()
        return Adjustment(unit_up(turned.rotation.apply(self.up)), correction)


_CORRECTION: TypeAdapter[Correction] = TypeAdapter(Correction)


def adjustment_row(recording_id: int, adjustment: Adjustment) -> dict[str, int | str | None]:
    """The row of an adjustment, in which the up direction lies in the frame of the cloud."""
    correction, up = _CORRECTION.dump_json(adjustment.correction).decode(), adjustment.up
    if up is not None and (T := moving(correction)) is not None:
        up = unit_up(T.rotation.inv().apply(up))
    return {"recording_id": recording_id, "up": None if up is None else json.dumps(up), "correction": correction}


def adjustment_in(row: AnyRow) -> tuple[Adjustment, int]:
    """The adjustment in a row of recordings joined with adjustments, and the id of its event (0 = none)."""
    if row.adjusted is None:
        return Adjustment(_up(row.up)), 0
    up, T = _up(row.adjusted_up), moving(row.correction)
    if up is not None and T is not None:
        up = unit_up(T.rotation.apply(up))
    return Adjustment(up, parsed(_CORRECTION.validate_json, row.correction)), row.adjusted


def _up(content: str | None) -> Up | None:
    return None if content is None else tuple(parsed(json.loads, content))


def unit_up(up: Sequence[float | int] | np.ndarray) -> Up:
    """The unit vector of a direction, (3,), any length."""
    vector = np.asarray(up, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.linalg.norm(vector) > 0:
        raise ProjectError(f"the up direction must be three finite numbers, not all zero, not {up}")
    x, y, z = (vector / np.linalg.norm(vector)).tolist()
    return x, y, z


@lru_cache(maxsize=1024)
def moving(correction: str) -> RigidTransform | None:
    """From the frame of the recorded cloud to that of the camera; None if they are the same."""
    stored = parsed(_CORRECTION.validate_json, correction)
    if (stored.turn_rad, stored.shift_m) == (NO_CORRECTION.turn_rad, NO_CORRECTION.shift_m):
        return None
    return stored.T_camera_recorded


def moved_box(box: BoxRecord, T: RigidTransform) -> BoxRecord:
    """A box in another frame."""
    return BoxRecord.of(box.box().transformed(T))


def moved_geometry(geometry: ViewGeometry, T: RigidTransform) -> ViewGeometry:
    """The geometry of a pseudo-view in another frame; its picture stays the same."""
    axes = np.array(geometry.axes) @ T.rotation.inv().as_matrix()
    origin = np.array(geometry.origin_m) + axes[:2] @ T.translation
    return geometry.model_copy(update={"axes": tuple(map(tuple, axes.tolist())), "origin_m": tuple(origin.tolist())})
