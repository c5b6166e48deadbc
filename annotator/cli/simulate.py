"""`annotator simulate`"""

from __future__ import annotations

from annotator.cli.options import BoxKindOption, ProjectName, Projects, RecordingName
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import open_named
from annotator.types import BoxKind
from annotator.types.messages import amount
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import simulate_recording


def run(
    project: ProjectName,
    recording: RecordingName,
    /,
    *,
    box_kind: BoxKindOption[BoxKind] = BoxKind.SILHOUETTE,
    every: int = 1,
    projects: Projects = None,
) -> None:
    """Draw 2D boxes from a recording's ground truth, five per object, as an operator would.

    For silhouettes in a project with one class, masks (mask/) are enough; boxes.json is not needed.

    Args:
        every: label every Nth frame, starting with the first.
    """
    with open_named(project, projects) as opened, counted("drawing") as progress:
        stored = opened.recordings.find(recording)
        drawn = simulate_recording(opened, stored.id, box_kind, rcv_config(opened), every, progress)
    print_line(
        f"{amount(drawn.frames, 'frame')}, {amount(drawn.objects, 'object')}, {amount(drawn.boxes, '2D box')} drawn"
    )
    print_line(f"next: annotator train {project}")
