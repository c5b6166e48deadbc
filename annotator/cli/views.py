"""`annotator views`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.output import print_line
from annotator.cli.projects import Root, open_named
from annotator.workflows.labelling import to_draw_on
from annotator.workflows.rcv_settings import rcv_config
from annotator.workflows.views_out import COCO, write_views


def run(project: str, out: Path, /, *, step: int = 1, root: Root = None) -> None:
    """Write pseudo-views as PNG pictures, to be labelled with any 2D tool that reads and writes COCO.

    Step 1 needs boxes on camera images, step 2 boxes on both views of step 1.

    Args:
        project: the project's name.
        out: a new folder for the pictures, `coco.json` (pictures without boxes) and `views.json` (where they lie).
        step: 1 or 2, the step of the recursion.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened:
        written = write_views(opened, out, step, to_draw_on(opened, rcv_config(opened)))
    print_line(f"{written.pictures} pictures in {out}")
    for line in written.unreadable:
        print_line(f"left out: frame {line}")
    print_line(f"next: draw boxes, then annotator import {project} {out / COCO} --pictures {out}")
