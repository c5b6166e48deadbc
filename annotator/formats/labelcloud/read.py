"""Reads the boxes of a labelCloud project, ours or one that was begun in labelCloud."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from annotator.formats.faults import Tell, give_up
from annotator.formats.frames_csv import read_frames
from annotator.formats.json_file import read_model
from annotator.formats.labelcloud.boxes import box_of, in_degrees
from annotator.formats.labelcloud.calibration import read_calibration_pose
from annotator.formats.labelcloud.model import CENTROID_ABS, CENTROID_REL, CLASSES_FILE, ClassesFile, LabelFile
from annotator.formats.labelcloud.write import CALIBRATIONS, LABELS
from annotator.types import OrientedBox
from annotator.types.errors import FormatError


@dataclass(frozen=True, eq=False)
class LabelCloudFrame:
    """The boxes of one cloud.

    Attributes:
        boxes: class and box, in the cloud's frame.
        T_camera_cloud: from the cloud's frame to the camera; None where the project has no calibration.
    """

    boxes: tuple[tuple[str, OrientedBox], ...]
    T_camera_cloud: RigidTransform | None


def read_labelcloud(path: Path, tell: Tell = give_up) -> dict[str, LabelCloudFrame]:
    """The labels of a project folder (all of its parts, if it is divided), or of a folder of label files, by name.

    Names are "RECORDING/KEY" where the dataset's frames.csv says so, else the stem of the label file.

    Args:
        tell: what becomes of a fault in a label file or a calibration.

    Raises:
        FormatError: no labels, files that are no labels of labelCloud, or angles whose unit nothing tells.
    """
    found: dict[str, LabelCloudFrame] = {}
    for folder in _label_folders(path):
        origins = read_frames(folder.parent) or read_frames(folder.parent.parent)
        for stem, frame in _read_folder(folder, tell):
            name = origins[stem].name if stem in origins else stem
            if name in found:
                raise FormatError(folder / f"{stem}.json", f"the frame {name} has labels in two folders; import one")
            found[name] = frame
    return found


def _label_folders(path: Path) -> list[Path]:
    folders = [folder for folder in (path / LABELS, *sorted(path.glob(f"*/{LABELS}"))) if folder.is_dir()]
    found = [folder for folder in folders or [path] if any(_label_files(folder))]
    if not found:
        raise FormatError(path, "has no label file of labelCloud (*.json, here or in labels/)")
    return found


def _label_files(folder: Path) -> Iterator[Path]:
    return (file for file in sorted(folder.glob("*.json")) if file.name != CLASSES_FILE)


def _read_folder(folder: Path, tell: Tell) -> Iterator[tuple[str, LabelCloudFrame]]:
    files: dict[Path, LabelFile] = {}
    for file in _label_files(folder):
        try:
            files[file] = read_model(file, LabelFile)
        except FormatError as fault:
            tell(fault)
    degrees = _degrees(folder, files)
    for file, content in files.items():
        boxes = []
        for number, entry in enumerate(content.objects):
            try:
                boxes.append((entry.name, box_of(entry, degrees)))
            except ValueError as error:
                tell(FormatError(file, f"objects.{number}: {error}"))
        pose = folder.parent / CALIBRATIONS / f"{file.stem}.txt"
        try:
            T_camera_cloud = _pose_for(boxes, pose) if pose.is_file() else None
        except FormatError as fault:
            tell(fault)
            continue
        yield file.stem, LabelCloudFrame(tuple(boxes), T_camera_cloud)


def _pose_for(boxes: Sequence[tuple[str, OrientedBox]], file: Path) -> RigidTransform:
    """T_camera_cloud of a calibration, which must leave boxes of its cloud within reach."""
    T = read_calibration_pose(file)
    for number, (_, box) in enumerate(boxes):
        try:
            box.transformed(T)
        except ValueError as error:
            raise FormatError(file, f"takes objects.{number} of its cloud too far off: {error}") from error
    return T


def _degrees(folder: Path, files: Mapping[Path, LabelFile]) -> bool:
    """What the angles of a folder are: as its `_classes.json` says, else as they are themselves, all together."""
    classes = folder / CLASSES_FILE
    said = read_model(classes, ClassesFile).format if classes.is_file() else None
    if said in (CENTROID_ABS, CENTROID_REL):
        return said == CENTROID_ABS
    angles = (
        angle
        for content in files.values()
        for entry in content.objects
        if entry.vertices is None and entry.rotations is not None
        for angle in (entry.rotations.x, entry.rotations.y, entry.rotations.z)
    )
    try:
        found = in_degrees(angles)
    except ValueError as error:
        raise FormatError(folder, str(error)) from error
    if found is None:
        raise FormatError(
            folder,
            "angles may be radians or degrees here; put labelCloud's _classes.json beside the labels, whose "
            f'"format" says so ("{CENTROID_REL}" or "{CENTROID_ABS}")',
        )
    return found
