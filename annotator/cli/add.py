"""`annotator add`"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from annotator.cli.import_boxes import print_report
from annotator.cli.options import AS_FILES_SAY, Reading
from annotator.cli.output import counted, print_line, print_lines
from annotator.project import REVIEWED, Project
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import amount
from annotator.workflows.add_recordings import Added, add_recordings
from annotator.workflows.recorded.own_labels import has_own_labels, import_own_labels

ONLY_ADDED = (
    "{0}\n{1} is in the project, without the labels beside it; correct them and give this command again, or import "
    "them: annotator import {2} LABELS"
)


def run(
    project: Project,
    paths: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH ...", help_behavior_hint="(required)")],
    /,
    *,
    name: str | None = None,
    up: tuple[float, float, float] | None = None,
    no_labels: bool = False,
    as_new: bool = False,
    leave_out_broken: bool = False,
    reading: Reading = AS_FILES_SAY,
) -> None:
    """Add recordings to a project. Their files stay where they are.

    If a recording comes with 3D boxes (label_2, label_02.txt, boxes.json), they become labels to train the detectors
    on. If the project already has a recording, only new frames are added. One that was removed comes back with its
    labels.

    Args:
        paths: files or folders of the recordings.
        name: name of the recording in the project; default: the name of its folder.
        up: direction against gravity in the camera frame (x right, y down, z forward), for a recording that does
            not contain it; 0 -1 0 for a level camera.
        no_labels: do not import the 3D boxes that come with the recordings.
        as_new: add a recording even if it seems to be one of the project whose path is gone.
        leave_out_broken: leave out the frames that cannot be read. Each comes back when the recording is added again
            and it can be read.
    """
    if not paths:
        raise ConfigError(f"no recording given; write annotator add {project.path.name} PATH ...")
    one = replace(reading, scene=(), camera=()).options()
    every = add_recordings(
        project,
        paths,
        name=name,
        up=up,
        options=one,
        scenes=reading.scene,
        cameras=reading.camera,
        as_new=as_new,
        leave_out_broken=leave_out_broken,
    )
    for added in every:
        print_line(_summary(added))
        print_lines(f"  {note}" for note in (*added.notes, *added.broken.sentences))
        if len(added.broken.errors) > added.left_out:
            print_line("  to leave them out, give this command again with --leave-out-broken")
        if not no_labels:
            has_labels = has_own_labels(project, added.recording.id)
            with counted("reading labels") if has_labels else nullcontext() as progress:
                try:
                    imported = import_own_labels(project, added.recording.id, progress)
                except FormatError as error:
                    raise ConfigError(ONLY_ADDED.format(error, added.recording.name, project.path.name)) from error
            if imported.frames or imported.notes:
                print_report(imported, "  ")
    draw = "" if project.labels.select(states=REVIEWED) else "draw boxes (annotator simulate, annotator import), then "
    print_line(f"next: {draw}annotator train {project.path.name}")


def _summary(added: Added) -> str:
    recording = added.recording
    left_out = f", {added.left_out} left out" if added.left_out else ""
    if added.is_new:
        return f"added {recording.name}: {amount(recording.frames, 'frame')} ({recording.format}){left_out}"
    if added.came_back:
        return (
            f"{recording.name} is back in the project, with its labels: {amount(recording.frames, 'frame')}{left_out}"
        )
    missing = f", {added.missing_frames} missing (labels are kept)" if added.missing_frames else ""
    return f"{recording.name} is already in the project: {amount(added.new_frames, 'new frame')}{missing}{left_out}"
