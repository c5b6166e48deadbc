"""`annotator simulate`"""

from __future__ import annotations

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.types import BoxKind
from annotator.workflows.rcv_settings import rcv_config
from annotator.workflows.simulate import simulate_recording


def run(
    project: str,
    recording: str,
    /,
    *,
    operator: BoxKind = BoxKind.SILHOUETTE,
    every: int = 1,
    root: Root = None,
) -> None:
    """Let a simulated operator draw 2D boxes from a recording's truth, five an object, as a person would.

    Masks alone (mask/, no boxes.json) are truth enough for silhouettes, in a project with one class.

    Args:
        project: the project's name.
        recording: its name in the project.
        operator: silhouette = around what is seen, as a person draws; box = the projected true 3D box.
        every: label every so many frames, from the first.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened, counted("drawing") as progress:
        stored = opened.recordings.find(recording)
        drawn = simulate_recording(opened, stored.id, operator, rcv_config(opened), every, progress)
    print_line(f"{drawn.frames} frames, {drawn.objects} objects, {drawn.boxes} 2D boxes drawn")
    print_line(f"next: annotator train {project}")
