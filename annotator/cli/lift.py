"""`annotator lift`"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from annotator.cli.annotate import summary_lines
from annotator.cli.import_boxes import print_left_out, print_renamed
from annotator.cli.options import BackendOption, BoxKindOption, ProjectName, Projects, open_named
from annotator.cli.output import counted, print_line
from annotator.detection.config import Backend
from annotator.project import Project
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import Detectors, active_model, load_detector
from annotator.workflows.importing import FlatFormat
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.proposing.lift import (
    RenamedDetector,
    boxes_of_file,
    drawn_boxes,
    lift,
    require_known,
)
from annotator.workflows.settings import rcv_config
from annotator.workflows.workbench.loaded_detectors import require_view

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
    box_kind: BoxKindOption[BoxKind] = BoxKind.SILHOUETTE,
    backend: BackendOption[Backend] = "auto",
    projects: Projects = None,
) -> int:
    """Propose oriented 3D boxes for 2D boxes on the camera images; nothing has to be trained.

    The 2D boxes are those drawn in the project, those of a file, or those of a 2D detector. The project's own
    pseudo-view detector measures the objects. A project without one uses the base detector, which needs no training, if
    this installation has it. With --detector, --recording selects the frames on which the detector runs. Boxes that
    were drawn in the project, and its own detector, know their --box-kind.

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
        view, config = require_view(opened), rcv_config(opened)
        if detector is not None:
            loaded, origin = _image_detector(opened, detector, names, detector_size, backend)
            kind = active_model(opened, DetectorKind.IMAGE).box_kind if detector == OWN else box_kind
            require_known(view, loaded.labels)
            chosen = None if recording is None else [opened.recordings.find(recording).id]
            pair = Detectors(loaded, view, view.box_kind, view.class_agnostic, kind, view.trained)
            with counted("lift") as progress:
                done = annotate(opened, pair, config, recordings=chosen, progress=progress)
        else:
            if boxes is None:
                given = drawn_boxes(opened)
            else:
                given = boxes_of_file(opened, boxes, format, recording, names, box_kind)
            with counted("lift") as progress:
                done = lift(opened, given, view, config, progress)
            origin = given.origin
            print_renamed(given.renamed)
            print_left_out(given.other_classes, given.unmatched, "image")
            for reason in given.unreadable:
                print_line(f"skipped: frame {reason}")
    print_line(f"3D boxes from {origin}, measured by: {view.title}")
    for line in summary_lines(done):
        print_line(line)
    return 1 if done.failures else 0


def _names(pairs: tuple[str, ...]) -> dict[str, str]:
    names = {}
    for pair in pairs:
        theirs, equals, ours = pair.partition("=")
        if not (theirs and equals and ours):
            raise ConfigError(f"--rename: {pair!r} is not NAME=CLASS, such as car=Car")
        names[theirs] = ours
    return names


def _image_detector(
    project: Project, detector: str, names: dict[str, str], size_px: int, backend: Backend
) -> tuple[RenamedDetector, str]:
    """The 2D detector under the project's class names, and its description."""
    if detector == OWN:
        loaded = load_detector(active_model(project, DetectorKind.IMAGE).path, backend)
        origin = "the project's image detector"
    else:
        loaded, origin = load_detector(Path(detector), backend, size_px), f"the detector {Path(detector).name}"
    return RenamedDetector(loaded, project.config.classes, names), origin
