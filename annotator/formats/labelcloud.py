"""labelCloud: a folder of coloured clouds, each with a JSON file of fully oriented boxes.

    [PART/]pointclouds/ID.ply   coloured clouds, z up; ID.png (or .jpg) is beside them, where labelCloud looks for it
    [PART/]labels/ID.json       the boxes, in the cloud's frame; _classes.json: classes and the form of all labels
    [PART/]calib/ID.txt         transform from the cloud's frame to the camera
    frames.csv                  the origin of each frame

labelCloud rotates its viewport, and by default also boxes, about z. Clouds are therefore written in the level frame at
the camera (x ahead, y left, z against gravity). Start labelCloud in the folder (or in the folder of a part).

Boxes (labelCloud 1.1.1, `model/bbox.py`, `utils/math3d.py` and `io/labels/`): a box is rotated about x, then y, then z
of the cloud's frame: R = Rz Ry Rx; sizes are full, length along x, width along y, height along z. `centroid_rel` has
radians in (-pi, pi], `centroid_abs` degrees in 0..360. `vertices` are the corners (-,-,-), (-,+,-), (+,+,-), (+,-,-) in
signs along the box's x, y, z, then the same four on top. Numbers have eight decimals, as in labelCloud's default
settings.

Calibrations are in KITTI's form: `px = P2 * R0_rect * Tr_velo_to_cam * X`, matrices row by row (KITTI object devkit,
readme.txt). P2 may shift rectified camera 0 to the colour camera: P2 = K [I | t].
"""

from __future__ import annotations

import colorsys
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from pydantic_core import to_json
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats import reading
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, ply
from annotator.formats.frame_names import DatasetNames, LabelledFrame, add_once, of_recording
from annotator.formats.kitti_folders import P2_SHAPE, matrices_text, read_matrices, shift_of
from annotator.formats.reading import BEYOND, MOST_RAD, AngleUnit, angles_xyz, rotation_problem
from annotator.geometry.projection import straightened
from annotator.geometry.transforms import level_pose
from annotator.text import spelled
from annotator.types import OrientedBox, Truth
from annotator.types.bases import FileRecord
from annotator.types.errors import FormatError, UnitError, UnitKind
from annotator.types.messages import amount

CLASSES_FILE = "_classes.json"
CENTROID_REL, CENTROID_ABS, VERTICES = "centroid_rel", "centroid_abs", "vertices"


class Dimensions(FileRecord):
    """Full sizes along the box's own x, y, z; metres."""

    length: reading.BoundedPositive
    width: reading.BoundedPositive
    height: reading.BoundedPositive


class BoxObject(FileRecord):
    """A labelled box: centre, sizes and angles, or its corners."""

    name: Annotated[str, Field(min_length=1)]
    centroid: reading.Axes | None = None
    dimensions: Dimensions | None = None
    rotations: reading.Axes | None = None
    vertices: Annotated[tuple[reading.Bounded3, ...], Field(min_length=8, max_length=8)] | None = None


class LabelFile(FileRecord):
    """The labels of one cloud. Where it is is not read: a label file's own stem is its id."""

    objects: tuple[BoxObject, ...]


DECIMALS = 8
SIDES = ("length", "width", "height")
SIGNS = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
CORNERS = np.array([[x, y, z] for z in (-1, 1) for x, y in SIGNS]) / 2
# So many angles in degrees are not all below half a turn in radians.
LEAST_SMALL = 10
# Tolerance for corners: rounding to millimetres, or this fraction of the box's smallest side.
OFF_BOX_M, OFF_BOX_SHARE = 2e-3, 1e-2


def centroid_object(name: str, box: OrientedBox) -> dict[str, object]:
    """Returns a box of the cloud's frame as `centroid_rel`."""
    # the inverse of Rz Ry Rx turns about x first
    angles = -angles_xyz(box.rotation.T)
    rows = (("centroid", "xyz", box.center_m), ("dimensions", SIDES, box.size_m), ("rotations", "xyz", angles))
    return {"name": name} | {key: dict(zip(names, _rounded(row), strict=True)) for key, names, row in rows}


def vertices_object(name: str, box: OrientedBox) -> dict[str, object]:
    """Returns a box of the cloud's frame as `vertices`."""
    return {"name": name, "vertices": list(map(_rounded, box.T_camera_box.apply(CORNERS * box.size_m)))}


def box_of(entry: BoxObject, degrees: bool) -> OrientedBox:
    """Returns the box of an object, in the cloud's frame.

    Args:
        degrees: True for angles in degrees; not used for vertices.

    Raises:
        ValueError: the vertices are not those of a box, in labelCloud's order.
    """
    if entry.vertices is not None:
        return _of_vertices(np.array(entry.vertices))
    if entry.centroid is None or entry.dimensions is None or entry.rotations is None:
        raise ValueError("a box needs centroid, dimensions and rotations, or vertices")
    center, size, turns = entry.centroid, entry.dimensions, entry.rotations
    rotation = Rotation.from_euler("ZYX", [turns.z, turns.y, turns.x], degrees=degrees)
    return OrientedBox.at(
        RigidTransform.from_components([center.x, center.y, center.z], rotation),
        np.array([size.length, size.width, size.height]),
    )


def _of_vertices(corners: Float64[np.ndarray, "8 3"]) -> OrientedBox:
    """Returns the box through eight corners; each side is the mean of its four parallel edges."""
    center = corners.mean(axis=0)
    edges = 2 * np.sign(CORNERS).T @ (corners - center) / 8
    size = np.linalg.norm(edges, axis=1)
    if not (size > 0).all():
        raise ValueError("the vertices lie in one plane")
    axes = (edges / size[:, None]).T
    if np.linalg.det(axes) <= 0:
        raise ValueError("the vertices are not in labelCloud's order (seen from above, the first four are clockwise)")
    box = OrientedBox.at(RigidTransform.from_components(center, Rotation.from_matrix(axes)), size)
    off = float(np.abs(box.T_camera_box.apply(CORNERS * size) - corners).max())
    if off > max(OFF_BOX_M, OFF_BOX_SHARE * float(size.min())):
        raise ValueError(f"the vertices lie up to {off:.3f} m off the corners of a box")
    return box


def _rounded(values: Float64[np.ndarray, "3"]) -> list[float]:
    # + 0.0: no negative zero
    return [round(value, DECIMALS) + 0.0 for value in values.tolist()]


SHAPES = P2_SHAPE | {"R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}


def read_calibration_pose(path: Path) -> RigidTransform:
    """Returns T_camera_cloud of a file."""
    matrices = read_matrices(path, SHAPES)
    pose = matrices["R0_rect"] @ matrices["Tr_velo_to_cam"]
    R = pose[:, :3]
    if (problem := rotation_problem(R)) is not None:
        raise FormatError(path, f"R0_rect * Tr_velo_to_cam {problem}")
    return RigidTransform.from_components(pose[:, 3] + shift_of(path, matrices["P2"]), Rotation.from_matrix(R))


CLOUDS, LABELS, CALIBRATIONS = "pointclouds", "labels", "calib"
LEVEL_FRAME = "level frame at the camera: x ahead, y left, z up, metres"
# Golden ratio: hues that differ by this fraction of the circle stay distinct for any number of classes.
GOLDEN = 0.618034


class LabelCloudWriter(DatasetWriter):
    def frame(self, item: DatasetItem, frame_id: str) -> None:
        folder, frame = item.split or ".", item.frame
        T_level_camera = level_pose(frame.up)
        camera, rgb = straightened(frame.camera, frame.rgb)
        self.put_image(f"{folder}/{CLOUDS}/{frame_id}", rgb)
        level = replace(frame.cloud, xyz_m=T_level_camera.apply(frame.cloud.xyz_m).astype("float32"))
        self.put(f"{folder}/{CLOUDS}/{frame_id}.ply", ply(level, LEVEL_FRAME))
        # an ideal camera, which is also rectified camera 0
        P = np.hstack([camera.matrix, np.zeros((3, 1))])
        calibration = matrices_text(P, P, T_level_camera.inv().as_matrix()[:3])
        self.put(f"{folder}/{CALIBRATIONS}/{frame_id}.txt", calibration)
        dump = vertices_object if self.info.vertices else centroid_object
        content = {
            "folder": CLOUDS,
            "filename": f"{frame_id}.ply",
            "path": f"{CLOUDS}/{frame_id}.ply",
            "objects": [dump(label.label, label.box.transformed(T_level_camera)) for label in item.labels],
        }
        self.put(f"{folder}/{LABELS}/{frame_id}.json", to_json(content, indent=1) + b"\n")
        self.counts.update(label.label for label in item.labels)

    def finish(self) -> None:
        version = self.info.generator.removeprefix("annotator ")
        content = _classes(self.info.classes, VERTICES if self.info.vertices else CENTROID_REL, version)
        for part in self.parts("."):
            self.put(f"{part}/{LABELS}/{CLASSES_FILE}", content)


def _classes(names: Sequence[str], form: str, version: str) -> str:
    """Returns the text of `_classes.json`; labelCloud needs at least one class."""
    content = {
        "classes": [{"name": name, "id": number, "color": _color(number)} for number, name in enumerate(names)],
        "default": 0,
        "type": "object_detection",
        "format": form,
        "created_with": {"name": "annotator", "version": version},
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def _color(number: int) -> str:
    red, green, blue = colorsys.hsv_to_rgb(number * GOLDEN % 1.0, 0.75, 1.0)
    return f"#{round(red * 255):02x}{round(green * 255):02x}{round(blue * 255):02x}"


def read_labelcloud(
    path: Path, on_fault: reading.OnFault = reading.raise_fault, angles: AngleUnit | None = None
) -> dict[str, LabelledFrame]:
    """Returns the labels of a project folder with all its parts, or of a folder of label files, by frame name.

    Names are "RECORDING/KEY" if the dataset has a frames.csv, else the stem of the label file.

    Args:
        angles: their unit; None: as `_classes.json` says, else as their range shows.
    """
    frames: dict[str, LabelledFrame] = {}
    for folder in _label_folders(path):
        names = DatasetNames.of(folder)
        for file, frame in _read_folder(folder, angles, on_fault):
            add_once(frames, file, names.known(file.stem), frame)
    return frames


def read_labelcloud_file(file: Path) -> list[Truth]:
    """Returns the labels of one cloud, in the cloud's frame; `_classes.json` is beside the file."""
    content = reading.read_model(file, LabelFile)
    return _truths(file, content, _degrees(file.parent, {file: content}), reading.raise_fault)


def _truths(file: Path, content: LabelFile, degrees: bool, on_fault: reading.OnFault) -> list[Truth]:
    truths = []
    for number, entry in enumerate(content.objects):
        with reading.reported(on_fault), reading.faults(file, f"objects.{number}: "):
            truths.append(Truth(entry.name, box_of(entry, degrees)))
    return truths


def _label_folders(path: Path) -> list[Path]:
    folders = [folder for folder in (path / LABELS, *sorted(path.glob(f"*/{LABELS}"))) if folder.is_dir()]
    labelled = [folder for folder in folders or [path] if any(_label_files(folder))]
    if path.is_file():
        raise FormatError(path, f"has the labels of one frame; give the folder of all: {path.parent}")
    if not labelled:
        raise FormatError(path, "has no label file of labelCloud (*.json, here or in labels/)")
    return labelled


def _label_files(folder: Path) -> Iterator[Path]:
    return (file for file in sorted(folder.glob("*.json")) if file.name != CLASSES_FILE)


def _read_folder(
    folder: Path, angles: AngleUnit | None, on_fault: reading.OnFault
) -> Iterator[tuple[Path, LabelledFrame]]:
    files: dict[Path, LabelFile] = {}
    for file in _label_files(folder):
        with reading.reported(on_fault):
            files[file] = reading.read_model(file, LabelFile)
    degrees = _degrees(folder, files) if angles is None else angles is AngleUnit.DEGREES
    for file, content in files.items():
        objects = _truths(file, content, degrees, on_fault)
        pose = spelled(folder.parent / CALIBRATIONS, f"{file.stem}.txt")
        try:
            T_camera_cloud = read_calibration_pose(pose) if pose.is_file() else None
        except FormatError as fault:
            on_fault(fault)
            continue
        yield file, LabelledFrame(objects, of_recording if T_camera_cloud is None else T_camera_cloud)


def _degrees(folder: Path, files: Mapping[Path, LabelFile]) -> bool:
    """True for angles in degrees: from the folder's `_classes.json`, else from the range of all its angles.

    labelCloud writes radians in -pi..pi, or degrees in 0..360. Negative degrees are those of another program; if all
    are within half a turn in radians, they are radians. So are many angles of which none is larger.

    Raises:
        UnitError: the angles contradict the file, or show no unit.
    """
    classes = folder / CLASSES_FILE
    content = reading.read_json(classes) if classes.is_file() else None
    # the classes of the file are not read
    form = content.get("format", CENTROID_REL) if isinstance(content, dict) else None
    turns = [entry.rotations for content in files.values() for entry in content.objects if entry.vertices is None]
    angles = [angle for each in turns if each is not None for angle in (each.x, each.y, each.z) if angle != 0]
    lowest, highest, worst = min([0.0, *angles]), max([0.0, *angles]), max(angles, key=abs, default=0.0)
    half, count = math.pi + 10.0**-DECIMALS, amount(len(angles), "angle")
    is_small, problem = abs(worst) <= half, None
    if form == CENTROID_REL and abs(worst) > MOST_RAD:
        beyond = sum(abs(angle) > MOST_RAD for angle in angles)
        problem = f"{worst:g} is no angle in radians ({beyond} of {count} other than 0 {BEYOND})"
    elif form == CENTROID_ABS and angles and is_small and (lowest < 0 or len(angles) >= LEAST_SMALL):
        problem = f"{count} other than 0, all within -pi..pi, look like radians"
    if problem is not None:
        unit, other = ("degrees", CENTROID_REL) if form == CENTROID_ABS else ("radians", CENTROID_ABS)
        problem += (
            f', and "format": "{form}" in {CLASSES_FILE} means {unit}; if that is wrong, write "{other}", else '
            f"`annotator import --angles {unit}` reads them"
        )
    elif form not in (CENTROID_REL, CENTROID_ABS) and lowest < 0 and not is_small:
        problem = (
            f"angles from {lowest} to {highest} are neither radians in -pi..pi nor degrees in 0..360; import with "
            f"--angles {AngleUnit.RADIANS} or --angles {AngleUnit.DEGREES}"
        )
    elif form not in (CENTROID_REL, CENTROID_ABS) and lowest == 0 and 0 < highest <= half:
        problem = (
            "the angles may be radians or degrees; put labelCloud's _classes.json beside the labels, with "
            f'"format": "{CENTROID_REL}" (radians) or "format": "{CENTROID_ABS}" (degrees), or import with --angles '
            f"{AngleUnit.RADIANS} or --angles {AngleUnit.DEGREES}"
        )
    if problem is not None:
        raise UnitError(UnitKind.ANGLE, folder, problem)
    return form == CENTROID_ABS or (form != CENTROID_REL and highest > half)
