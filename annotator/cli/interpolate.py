"""`annotator interpolate`"""

from __future__ import annotations

from typing import Annotated

from tyro.conf import arg

from annotator.cli.options import ProjectName, Projects, RecordingName
from annotator.cli.output import print_line
from annotator.cli.projects import open_named
from annotator.project import Project
from annotator.types.messages import amount
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.fit_boxes import FitBox, box_fitter
from annotator.workflows.tracks.interpolate import interpolate
from annotator.workflows.workbench.loaded_detectors import ready_view
from annotator.workflows.workbench.open_frame import OpenFrame

AUTHOR = "annotator interpolate"


def run(
    project: ProjectName,
    recording: RecordingName,
    /,
    *,
    track: int,
    first: Annotated[str | None, arg(name="from")] = None,
    last: Annotated[str | None, arg(name="to")] = None,
    refit: bool = False,
    projects: Projects = None,
) -> None:
    """Propose the boxes of a track between its key frames, the frames with a reviewed box.

    Centre, size and rotation are interpolated from one key frame to the next. Reviewed boxes do not change; open
    proposals of the same object are replaced.

    Args:
        track: id of the track.
        first: name of the first key frame; default: the track's first one.
        last: name of the last key frame; default: the track's last one.
        refit: fit every new box to the points of its frame, with the pseudo-view detector if it is trained.
    """
    with open_named(project, projects) as opened:
        chosen = opened.recordings.find(recording).id
        fit = _box_fitter(opened) if refit else None
        done = interpolate(opened, chosen, track, AUTHOR, first=first, last=last, fit=fit)
    print_line(f"track {done.track_id}: {amount(len(done.filled), 'frame')} filled with proposals")
    if done.finalised or done.covered:
        finalised, covered = amount(done.finalised, "finalised frame"), amount(done.covered, "frame")
        print_line(f"unchanged: {finalised}, {covered} where the object is already labelled")


def _box_fitter(project: Project) -> FitBox:
    source = FrameSource(project)
    return box_fitter(project, lambda frame: OpenFrame(source.read(frame)), ready_view(project))
