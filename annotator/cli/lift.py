"""`annotator lift`"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from annotator.cli.annotate import summary_lines
from annotator.cli.options import BackendOption, ProjectName, Projects
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import open_named
from annotator.detection.config import Backend
from annotator.project import Project
from annotator.types import DetectorKind
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import active_model, load_detector
from annotator.workflows.importing import FlatFormat
from annotator.workflows.proposing.lift import GivenBoxes, boxes_of_detector, boxes_of_file, drawn_boxes, lift
from annotator.workflows.settings import rcv_config
from annotator.workflows.workbench.loaded_detectors import view_or_base

OWN = "project"
WEIGHTS_SIZE_PX = 640


def run(
    project: ProjectName,
    /,
    *,
    boxes: Path | None = None,
    format: FlatFormat = FlatFormat.COCO,
    recording: str | None = None,
    detector: str | None = None,
    rename: Annotated[tuple[str, ...], arg(metavar="NAME=CLASS ...")] = (),
    detector_size: int = WEIGHTS_SIZE_PX,
    backend: BackendOption[Backend] = "auto",
    projects: Projects = None,
) -> int:
    """Propose oriented 3D boxes for 2D boxes on the camera images; nothing has to be trained.

    The 2D boxes are those drawn in the project, those of a file, or those of a 2D detector. The project's own
    pseudo-view detector measures the objects. A project without one uses the base detector, which needs no training, if
    this installation has it.

    Args:
        boxes: COCO file or YOLO folder with boxes on camera images named like the project's frames.
        format: format of --boxes.
        recording: name of the recording that the boxes belong to, if several have frames of the same name.
        detector: weights of a 2D detector (a published ultralytics model, or the file of a training), or "project" for
            the project's own image detector.
        rename: the project's class for a class of the file or detector, such as car=Car; other classes keep their
            names.
        detector_size: input size of --detector, longer side, pixels.
    """
    if boxes is not None and detector is not None:
        raise ConfigError("--boxes and --detector exclude each other; give one")
    names = _names(rename)
    with open_named(project, projects) as opened:
        view = view_or_base(opened)
        if boxes is not None:
            given = boxes_of_file(opened, boxes, format, recording, names)
        elif detector is not None:
            given = _detected(opened, detector, recording, names, detector_size, backend)
        else:
            given = drawn_boxes(opened)
        with counted("lift") as progress:
            done = lift(opened, given, view, rcv_config(opened), progress)
    print_line(f"3D boxes of the {view.name or 'pseudo-view detector of the project'}, from {given.origin}")
    for line in summary_lines(done):
        print_line(line)
    for label, count in sorted(given.other_classes.items()):
        print_line(f"  left out: {count} boxes of {label}, which is not a class of the project")
    if given.unmatched:
        print_line(f"  left out: {len(given.unmatched)} images without a frame, such as {given.unmatched[0]}")
    return 1 if done.failures else 0


def _names(pairs: tuple[str, ...]) -> dict[str, str]:
    names = {}
    for pair in pairs:
        theirs, equals, ours = pair.partition("=")
        if not (theirs and equals and ours):
            raise ConfigError(f"--rename: {pair!r} is not NAME=CLASS, such as car=Car")
        names[theirs] = ours
    return names


def _detected(
    project: Project,
    detector: str,
    recording: str | None,
    names: dict[str, str],
    size_px: int,
    backend: Backend,
) -> GivenBoxes:
    if detector == OWN:
        model = active_model(project, DetectorKind.IMAGE)
        loaded, origin = load_detector(model.path, backend), "the project's image detector"
    else:
        loaded, origin = load_detector(Path(detector), backend, size_px), f"the detector {Path(detector).name}"
    chosen = None if recording is None else [project.recordings.find(recording).id]
    with counted("detect") as progress:
        return boxes_of_detector(project, loaded, origin, chosen, names, progress)
