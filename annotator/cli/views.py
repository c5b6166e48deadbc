"""`annotator views`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.options import ProjectName, Projects
from annotator.cli.output import print_line
from annotator.cli.projects import open_named
from annotator.types.messages import amount
from annotator.workflows.settings import rcv_config
from annotator.workflows.views.write_pictures import COCO, write_views
from annotator.workflows.workbench.drawing_steps import to_draw_on


def run(project: ProjectName, out: Path, /, *, step: int = 1, projects: Projects = None) -> None:
    """Write pseudo-views as PNG files, to be labelled in any 2D tool that reads and writes COCO.

    Step 1 needs boxes on camera images, step 2 needs boxes on both views of step 1.

    Args:
        out: new folder for the images, `coco.json` (the images without boxes) and `views.json` (their poses).
        step: step of the recursion, 1 or 2.
    """
    with open_named(project, projects) as opened:
        written = write_views(opened, out, step, to_draw_on(opened, rcv_config(opened)))
    print_line(f"{amount(written.pictures, 'pseudo-view')} in {out}")
    for line in written.unreadable:
        print_line(f"skipped: frame {line}")
    print_line(f"next: draw boxes, then annotator import {project} {out / COCO} --pictures {out}")
