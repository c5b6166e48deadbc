"""`annotator interpolate`"""

from __future__ import annotations

from typing import Annotated

from tyro.conf import arg

from annotator.cli.output import print_line
from annotator.cli.projects import Root, open_named
from annotator.project import Project, Role
from annotator.types import BoxKind, Detector
from annotator.workflows.frames import FrameSource
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.tracks.interpolate import interpolate
from annotator.workflows.tracks.snap import Snap, snapper

AUTHOR = "annotator interpolate"


def run(
    project: str,
    recording: str,
    /,
    *,
    track: int,
    first: Annotated[str | None, arg(name="from")] = None,
    last: Annotated[str | None, arg(name="to")] = None,
    refit: bool = False,
    root: Root = None,
) -> None:
    """Propose boxes of a track in the frames between its key frames, where somebody has reviewed its box.

    Centre, size and rotation change evenly from one key frame to the next. Nothing that somebody has reviewed changes;
    open proposals of the same object give way.

    Args:
        project: the project's name.
        recording: its name in the project.
        track: the track's id.
        first: key of the key frame to begin with; default: the first one.
        last: key of the key frame to end with; default: the last one.
        refit: fit every new box to its frame's points, by the pseudo-view detector where there is one.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened:
        chosen = opened.recordings.find(recording).id
        snap = _snap(opened) if refit else None
        done = interpolate(opened, chosen, track, AUTHOR, first=first, last=last, snap=snap)
    print_line(f"track {done.track_id}: {len(done.filled)} frames filled, as proposals for the review")
    if done.finalised or done.covered:
        print_line(
            f"left alone: {done.finalised} finalised frames, {done.covered} where somebody has said what is there"
        )


def _snap(project: Project) -> Snap:
    source = FrameSource(project)
    model = project.models.active(Role.VIEW)
    detector: Detector | None = None
    kind = BoxKind.BOX
    if model is not None:
        from annotator.workflows.detectors import load_detector

        detector, kind = load_detector(model.path), model.box_kind
    return snapper(project, lambda frame: OpenFrame(source.read(frame)), detector, kind)
