"""`annotator stats`"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from annotator.cli.options import AsJson
from annotator.cli.output import facts, print_result
from annotator.project import Project
from annotator.project.progress.report import Progress
from annotator.types import BoxKind, DetectorKind
from annotator.types.messages import amount, duration
from annotator.workflows.detectors import ReportedStatistics, reported_statistics
from annotator.workflows.training.held_out import measured_ious
from annotator.workflows.training.model_report import decision_of


def run(project: Project, /, *, as_json: AsJson = False) -> None:
    """Show a project's progress: frames, labels, 2D boxes, people, effort per box, hours left, runs, models."""
    statistics = reported_statistics(project)
    newest = project.models.all(DetectorKind.VIEW)[-1:]
    decisions = [decision for decision in map(decision_of, newest) if decision is not None]
    rows = list(_rows(statistics))
    for decision in decisions:
        rows.append(("  newest one", decision.outcome))
        if decision.mean_iou is not None:
            rows.append((f"  mean IoU on {decision.objects} held-out objects", measured_ious(decision)))
    print_result(statistics, facts(rows), as_json)


def _rows(counts: ReportedStatistics) -> Iterator[tuple[str, object]]:
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
    for detector, suggested in counts.suggested.items():
        yield f"  suggested by {detector}", f"{suggested.as_suggested} as suggested, {suggested.corrected} corrected"
    if counts.labels.by_kind[BoxKind.SILHOUETTE]:
        yield "  around what is seen only", counts.labels.by_kind[BoxKind.SILHOUETTE]
    for name, values in counts.attributes.items():
        without = counts.without_value.get(name, 0)
        yield f"  {name}", _listed_values(values) + (f"; {without} without a value" if without else "")
    yield "2D boxes on camera images", f"{counts.image_boxes.boxes} on {amount(counts.image_boxes.pictures, 'image')}"
    yield "2D boxes on pseudo-views", f"{counts.view_boxes.boxes} on {amount(counts.view_boxes.pictures, 'view')}"
    yield "boxes with measured effort", counts.effort.boxes
    if counts.effort.boxes:
        yield "  seconds per box", f"{counts.effort.seconds_a_box:.1f}"
        yield "  actions per box", f"{counts.effort.actions_a_box:.1f}"
    if counts.accepted_untouched is not None:
        yield "proposals accepted unchanged", f"{counts.accepted_untouched:.0%} of the reviewed ones"
    if counts.iou_proposal_to_final is not None:
        yield "IoU of proposal and final box", f"{counts.iou_proposal_to_final:.3f}"
    yield from _progress(counts.progress)
    yield "runs", counts.runs
    yield "models", counts.models
    yield "view detector", counts.view_detector or "none"


def _progress(progress: Progress) -> Iterator[tuple[str, object]]:
    earliest, latest, forecast = progress.pace.earliest, progress.pace.latest, progress.forecast
    if earliest is not None and latest is not None:
        change = (
            f"{earliest.seconds_a_box:.1f} for the first quarter of the boxes, {latest.seconds_a_box:.1f} for the last"
        )
        yield "seconds per box over time", change
    for person in sorted({entry.person for entry in progress.days}):
        days = [entry for entry in progress.days if entry.person == person]
        boxes, hours = sum(entry.boxes for entry in days), sum(entry.hours for entry in days)
        yield f"labelled by {person}", f"{amount(boxes, 'box')} in {duration(hours)} on {amount(len(days), 'day')}"
    yield "frames left", forecast.frames_left
    if forecast.hours_left is not None and forecast.frames_left > 0:
        left = forecast.hours_left
        yield (
            "  work left",
            f"{duration(left.expected)} ({duration(left.low)} to {duration(left.high)} at the latest rates)",
        )


def _listed_values(counts: Mapping[str, int]) -> str:
    # "2 7" would be unclear
    return _listed({f"with {value}" if value.lstrip("-")[:1].isdigit() else value: counts[value] for value in counts})


def _listed(counts: Mapping[Any, int]) -> str:
    return ", ".join(f"{number} {name}" for name, number in counts.items()) or "none"
