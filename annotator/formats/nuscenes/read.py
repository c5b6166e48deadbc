"""Reads the boxes of nuScenes tables, camera by camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import RootModel
from scipy.spatial.transform import RigidTransform

from annotator.file_names import normal, stem_of
from annotator.formats.attributes import VISIBILITY, from_dotted
from annotator.formats.frames_csv import FrameOrigin, read_frames
from annotator.formats.json_file import read_model
from annotator.formats.nuscenes.model import Attribute, Category, Instance, SampleAnnotation, Visibility
from annotator.formats.nuscenes.shapes import box_from
from annotator.formats.reading import OnFault, raise_fault
from annotator.geometry.oriented_box import box_corners
from annotator.geometry.transforms import Quaternions
from annotator.nuscenes_tables import CalibratedSensor, EgoPose, Record, SampleData, Sensor, pose
from annotator.types import OrientedBox
from annotator.types.errors import FormatError
from annotator.types.label import AttributeValue

ANNOTATIONS = "sample_annotation.json"
# A box is in an image if one of its corners is, and all are in front of the camera (devkit: `BoxVisibility.ANY`).
NEAREST_M = 0.1

Row = TypeVar("Row", bound=Record)


@dataclass(frozen=True, eq=False)
class NuScenesBox:
    """One annotation.

    Attributes:
        label: the category's name.
        box: camera frame; from `read_sample_boxes`, global frame.
        track_id: the instance's id in the project it was exported from; in other datasets the instance's row number
            if it has more than one annotation, else None.
        attributes: `vehicle.moving` as vehicle = moving, and the visibility's level as `visibility`.
    """

    label: str
    box: OrientedBox
    track_id: int | None
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)


def read_nuscenes(path: Path, on_fault: OnFault = raise_fault) -> dict[str, tuple[NuScenesBox, ...]]:
    """Returns the boxes of each camera's key frames, by frame name.

    In a dataset with several cameras, each camera gets the boxes that its image shows. Names are "RECORDING/KEY" if the
    dataset has a frames.csv, else the stem of the image file.

    Args:
        path: the dataset's root, or its folder of tables.
        on_fault: called with the fault of a box's row; see `OnFault`.

    Raises:
        FormatError: no tables, rows that do not follow the schema or refer to missing rows, or two images with the
            same name.
        UnitError: the quaternions have w last.
    """
    folder = _table_folder(path)
    origins = read_frames(folder.parent)
    labels = _Labels(folder)
    require_w_first(folder, labels.annotations(), labels.instances)
    frames: dict[str, tuple[NuScenesBox, ...]] = {}
    for index, row in enumerate(labels.data.values()):
        if not row.is_key_frame or labels.sensor(index, row).modality != "camera":
            continue
        stem = normal(stem_of(row.filename))
        name = origins[stem].name if stem in origins else stem
        if name in frames:
            raise FormatError(
                folder / "sample_data.json",
                f"row {index}: a second camera image is called {name}; file names must be unique",
            )
        frames[name] = tuple(labels.boxes(index, row, origins, on_fault))
    if not frames:
        raise FormatError(folder / "sample_data.json", "has no key frame of a camera")
    return frames


def read_world_poses(path: Path) -> dict[str, RigidTransform]:
    """Returns `T_world_camera` of the frames of an export, by name, if their recordings have map coordinates.

    Raises:
        FormatError: as `read_nuscenes`.
    """
    folder = _table_folder(path)
    origins = read_frames(folder.parent)
    if not origins:
        return {}
    labels = _Labels(folder)
    stems = ((normal(stem_of(row.filename)), index, row) for index, row in enumerate(labels.data.values()))
    poses = {
        origins[stem].name: labels.T_global_camera(index, row)
        for stem, index, row in stems
        if stem in origins and labels.sensor(index, row).modality == "camera"
    }
    # without map coordinates, the camera is the origin
    return {name: pose for name, pose in poses.items() if pose.translation.any()}


def _table_folder(path: Path) -> Path:
    folders = [path] if (path / "sample_data.json").is_file() else sorted(path.glob("v1.0-*/"))
    if len(folders) != 1:
        several = f"has several folders of tables ({', '.join(f.name for f in folders)}); give the path of one"
        raise FormatError(path, several if folders else "has no folder of nuScenes tables (v1.0-*)")
    return folders[0]


class _Labels:
    """The tables, and the boxes that follow from their rows."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.data = self._table("sample_data", SampleData)
        self._sensors = self._table("sensor", Sensor)
        self._calibrated = self._table("calibrated_sensor", CalibratedSensor)
        self._poses = self._table("ego_pose", EgoPose)
        self._categories = self._table("category", Category)
        self.instances = self._table("instance", Instance)
        # other tools leave these tables out
        self._names = self._named("attribute", Attribute, "name")
        self._levels = self._named("visibility", Visibility, "level")
        self._numbers = {token: number for number, token in enumerate(self.instances)}
        self._of_sample: dict[str, list[tuple[int, SampleAnnotation]]] = {}
        for index, row in enumerate(self._table("sample_annotation", SampleAnnotation).values()):
            self._of_sample.setdefault(row.sample_token, []).append((index, row))

    def annotations(self) -> Iterator[SampleAnnotation]:
        """Yields the rows of all boxes."""
        return (row for rows in self._of_sample.values() for _, row in rows)

    def sensor(self, index: int, row: SampleData) -> Sensor:
        """Returns the sensor of a row."""
        calibrated = self._row("sample_data", index, self._calibrated, "calibrated_sensor", row.calibrated_sensor_token)
        return self._row("sample_data", index, self._sensors, "sensor", calibrated.sensor_token)

    def T_global_camera(self, index: int, row: SampleData) -> RigidTransform:
        """Returns the pose of the camera of an image; call `sensor` before."""
        ego = self._row("sample_data", index, self._poses, "ego_pose", row.ego_pose_token)
        calibrated = self._calibrated[row.calibrated_sensor_token]
        return self._pose("ego_pose", ego) * self._pose("calibrated_sensor", calibrated)

    def boxes(
        self, index: int, row: SampleData, origins: Mapping[str, FrameOrigin], on_fault: OnFault
    ) -> Iterator[NuScenesBox]:
        """Yields the boxes in a camera's image; with `origins` (an export, one camera) all boxes of the sample."""
        calibrated = self._calibrated[row.calibrated_sensor_token]
        T_camera_global = self.T_global_camera(index, row).inv()
        for number, annotation in self._of_sample.get(row.sample_token, ()):
            try:
                box = box_from(annotation.translation, annotation.rotation, annotation.size).transformed(
                    T_camera_global
                )
            except ValueError as error:
                on_fault(FormatError(self._folder / ANNOTATIONS, f"row {number}: {error}"))
                continue
            K = np.array(calibrated.camera_intrinsic)
            if origins or (len(K) and is_seen(box, K, row.width, row.height)):
                instance = self._row("sample_annotation", number, self.instances, "instance", annotation.instance_token)
                category = self._row(
                    "instance", self._numbers[instance.token], self._categories, "category", instance.category_token
                )
                track_id = track_of(instance, self._numbers[instance.token])
                values = values_of(annotation, instance, self._names, self._levels)
                yield NuScenesBox(category.name, box, track_id, values)

    def _pose(self, table: str, row: EgoPose | CalibratedSensor) -> RigidTransform:
        try:
            return pose(row.translation, row.rotation)
        except ValueError as error:
            raise FormatError(self._folder / f"{table}.json", f"{row.token}: {error}") from error

    def _table(self, name: str, model: type[Row]) -> dict[str, Row]:
        path = self._folder / f"{name}.json"
        rows: tuple[Row, ...] = read_model(path, RootModel[tuple[model, ...]]).root  # type: ignore[valid-type]
        by_token: dict[str, Row] = {}
        for index, row in enumerate(rows):
            if row.token in by_token:
                raise FormatError(path, f"row {index}: the token {row.token} occurs twice; tokens must be unique")
            by_token[row.token] = row
        return by_token

    def _named(self, table: str, model: type[Row], field: str) -> dict[str, str]:
        has_table = (self._folder / f"{table}.json").is_file()
        return {token: getattr(row, field) for token, row in self._table(table, model).items()} if has_table else {}

    def _row(self, table: str, index: int, rows: Mapping[str, Row], other: str, token: str) -> Row:
        if token not in rows:
            raise FormatError(
                self._folder / f"{table}.json",
                f"row {index}: refers to the token {token}, which is not in {other}.json",
            )
        return rows[token]


def require_w_first(tables: Path, annotations: Iterable[SampleAnnotation], instances: Mapping[str, Instance]) -> None:
    """The boxes of nuScenes stand upright in the global frame; those of annotator may be tilted.

    Raises:
        UnitError: the boxes stand upright only if w is the last number of their quaternions.
    """
    quaternions = Quaternions()
    for row in annotations:
        if row.instance_token not in instances or not _is_ours(instances[row.instance_token]):
            quaternions.add(row.rotation)
    quaternions.require(tables / ANNOTATIONS)


def values_of(
    annotation: SampleAnnotation, instance: Instance, names: Mapping[str, str], levels: Mapping[str, str]
) -> dict[str, AttributeValue]:
    """Returns the attributes of a box, with names and levels by their tokens; see `NuScenesBox`.

    Levels of visibility in annotator's own exports are measured, unless they are an attribute as well.
    """
    values = from_dotted(names[token] for token in annotation.attribute_tokens if token in names)
    level = None if _is_ours(instance) else levels.get(annotation.visibility_token)
    return values if level is None else values | {VISIBILITY: level}


def _is_ours(instance: Instance) -> bool:
    return "track_id" in instance.model_fields_set


def track_of(instance: Instance, number: int) -> int | None:
    """Returns the track of an instance, of which `number` is the row; see `NuScenesBox`."""
    if _is_ours(instance):
        return instance.track_id
    return number if instance.nbr_annotations > 1 else None


def is_seen(box: OrientedBox, K: np.ndarray, width_px: int, height_px: int) -> bool:
    """Returns True if a box (camera frame) is in the image of the camera with the matrix `K` (3, 3)."""
    corners = box_corners(box)
    if (corners[:, 2] < NEAREST_M).any():
        return False
    px = corners @ K.T
    px = px[:, :2] / px[:, 2:]
    return bool(((px > -0.5) & (px < np.array([width_px, height_px]) - 0.5)).all(axis=1).any())
