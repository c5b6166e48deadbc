"""`annotator stats`"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from annotator.cli.output import AsJson, print_facts, print_json
from annotator.cli.projects import Root, open_named
from annotator.project import Statistics


def run(project: str, /, *, as_json: AsJson = False, root: Root = None) -> None:
    """Say how far a project is: frames, labels, 2D boxes, what a box costs, runs, models.

    Args:
        project: the project's name.
        as_json: print one JSON object.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened:
        statistics = opened.statistics()
    if as_json:
        print_json(statistics)
    else:
        print_facts(_rows(statistics))


def _rows(counts: Statistics) -> Iterator[tuple[str, object]]:
    yield "recordings", counts.recordings
    yield "frames", counts.frames
    yield "  with labels", counts.frames_with_labels
    yield "  with open proposals", counts.frames_with_proposals
    yield "  finalised", counts.frames_finalised
    yield "  failed", counts.frames_failed
    yield "labels", counts.labels.total
    yield "  by state", _listed(counts.labels.by_state)
    yield "  by class", _listed(counts.labels.by_class)
    yield "  by source", _listed(counts.labels.by_source)
    yield "2D boxes on images", f"{counts.image_boxes.boxes} on {counts.image_boxes.pictures} pictures"
    yield "2D boxes on views", f"{counts.view_boxes.boxes} on {counts.view_boxes.pictures} pictures"
    yield "boxes with counted effort", counts.effort.boxes
    if counts.effort.boxes:
        yield "  seconds a box", f"{counts.effort.seconds_a_box:.1f}"
        yield "  actions a box", f"{counts.effort.actions_a_box:.1f}"
    if counts.accepted_untouched is not None:
        yield "proposals accepted untouched", f"{counts.accepted_untouched:.0%} of those reviewed"
    if counts.iou_proposal_to_final is not None:
        yield "IoU from proposal to final", f"{counts.iou_proposal_to_final:.3f}"
    yield "runs", counts.runs
    yield "models", counts.models


def _listed(counts: Mapping[Any, int]) -> str:
    return ", ".join(f"{number} {name}" for name, number in counts.items()) or "none"
