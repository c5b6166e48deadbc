"""Reads the boxes of a labelCloud project, exported by annotator or created in labelCloud."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from annotator.formats.frames_csv import read_frames
from annotator.formats.json_file import read_model
from annotator.formats.labelcloud.boxes import box_of, contradiction, in_degrees
from annotator.formats.labelcloud.calibration import read_calibration_pose
from annotator.formats.labelcloud.model import CENTROID_ABS, CENTROID_REL, CLASSES_FILE, ClassesFile, LabelFile
from annotator.formats.labelcloud.write import CALIBRATIONS, LABELS
from annotator.formats.reading import OnFault, raise_fault
from annotator.formats.units import AngleUnit
from annotator.text import normal, spelled
from annotator.types import OrientedBox
from annotator.types.errors import FormatError, UnitError, UnitKind


@dataclass(frozen=True, eq=False)
class LabelCloudFrame:
    """The boxes of one cloud.

    Attributes:
        boxes: class and box, in the cloud's frame.
        T_camera_cloud: from the cloud's frame to the camera; None without a calibration.
    """

    boxes: tuple[tuple[str, OrientedBox], ...]
    T_camera_cloud: RigidTransform | None


def read_labelcloud(
    path: Path, on_fault: OnFault = raise_fault, angles: AngleUnit | None = None
) -> dict[str, LabelCloudFrame]:
    """Returns the labels of a project folder with all its parts, or of a folder of label files, by frame name.

    Names are "RECORDING/KEY" if the dataset has a frames.csv, else the stem of the label file.

    Args:
        on_fault: called with the fault of a label file or a calibration; see `OnFault`.
        angles: their unit; None: as `_classes.json` says, else as their range shows.

    Raises:
        FormatError: no labels, files that are not labelCloud labels, or angles whose unit cannot be determined.
        UnitError: the angles cannot be in the unit that `_classes.json` names.
    """
    frames: dict[str, LabelCloudFrame] = {}
    for folder in _label_folders(path):
        origins = read_frames(folder.parent) or read_frames(folder.parent.parent)
        for stem, frame in _read_folder(folder, angles, on_fault):
            name = origins[stem].name if stem in origins else stem
            if name in frames:
                raise FormatError(folder / f"{stem}.json", f"the frame {name} has labels in two folders; import one")
            frames[name] = frame
    return frames


def read_labelcloud_file(file: Path) -> LabelCloudFrame:
    """Returns the labels of one cloud, in the cloud's frame; `_classes.json` is beside the file.

    Raises:
        FormatError: as `read_labelcloud`.
    """
    content = read_model(file, LabelFile)
    degrees = _degrees(file.parent, {file: content})
    try:
        return LabelCloudFrame(tuple((entry.name, box_of(entry, degrees)) for entry in content.objects), None)
    except ValueError as error:
        raise FormatError(file, str(error)) from error


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


def _read_folder(folder: Path, angles: AngleUnit | None, on_fault: OnFault) -> Iterator[tuple[str, LabelCloudFrame]]:
    files: dict[Path, LabelFile] = {}
    for file in _label_files(folder):
        try:
            files[file] = read_model(file, LabelFile)
        except FormatError as fault:
            on_fault(fault)
    degrees = _degrees(folder, files) if angles is None else angles is AngleUnit.DEGREES
    for file, content in files.items():
        boxes = []
        for number, entry in enumerate(content.objects):
            try:
                boxes.append((entry.name, box_of(entry, degrees)))
            except ValueError as error:
                on_fault(FormatError(file, f"objects.{number}: {error}"))
        pose = spelled(folder.parent / CALIBRATIONS, f"{file.stem}.txt")
        try:
            T_camera_cloud = _pose_for(boxes, pose) if pose.is_file() else None
        except FormatError as fault:
            on_fault(fault)
            continue
        yield normal(file.stem), LabelCloudFrame(tuple(boxes), T_camera_cloud)


def _pose_for(boxes: Sequence[tuple[str, OrientedBox]], file: Path) -> RigidTransform:
    """Returns T_camera_cloud of a calibration; raises FormatError if it moves a box of the cloud out of range."""
    T = read_calibration_pose(file)
    for number, (_, box) in enumerate(boxes):
        try:
            box.transformed(T)
        except ValueError as error:
            raise FormatError(file, f"moves objects.{number} of its cloud out of range: {error}") from error
    return T


def _degrees(folder: Path, files: Mapping[Path, LabelFile]) -> bool:
    """True for angles in degrees: from the folder's `_classes.json`, else from the range of all its angles."""
    classes = folder / CLASSES_FILE
    form = read_model(classes, ClassesFile).format if classes.is_file() else None
    angles = [
        angle
        for content in files.values()
        for entry in content.objects
        if entry.vertices is None and entry.rotations is not None
        for angle in (entry.rotations.x, entry.rotations.y, entry.rotations.z)
    ]
    if form in (CENTROID_ABS, CENTROID_REL):
        is_abs = form == CENTROID_ABS
        if (problem := contradiction(angles, degrees=is_abs)) is not None:
            units = ("degrees", CENTROID_REL) if is_abs else ("radians", CENTROID_ABS)
            raise UnitError(
                UnitKind.ANGLE,
                folder,
                f'{problem}, and "format": "{form}" in {CLASSES_FILE} means {units[0]}; if that is wrong, write '
                f'"{units[1]}", else `annotator import --angles {units[0]}` reads them',
            )
        return is_abs
    try:
        degrees = in_degrees(angles)
    except ValueError as error:
        problem = f"{error}; import with --angles {AngleUnit.RADIANS} or --angles {AngleUnit.DEGREES}"
        raise UnitError(UnitKind.ANGLE, folder, problem) from error
    if degrees is None:
        raise UnitError(
            UnitKind.ANGLE,
            folder,
            "the angles may be radians or degrees; put labelCloud's _classes.json beside the labels, with "
            f'"format": "{CENTROID_REL}" (radians) or "format": "{CENTROID_ABS}" (degrees), or import with --angles '
            f"{AngleUnit.RADIANS} or --angles {AngleUnit.DEGREES}",
        )
    return degrees
