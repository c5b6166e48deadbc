"""Scores of a project's labels against the truth beside its recordings."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from annotator.evaluation.oriented import FrameResult, average_precision, matched_ious
from annotator.geometry.oriented_box import contains
from annotator.project import Project
from annotator.types import ReviewState
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.reading import load_truth

SCORED_STATES = (ReviewState.PROPOSED, ReviewState.ACCEPTED, ReviewState.EDITED)


@dataclass(frozen=True)
class Scores:
    """The scores of one class.

    Attributes:
        frames: number of evaluated frames.
        objects: number of true objects.
        found: share of the objects with an overlapping box (IoU above 0).
        mean_iou: mean 3D IoU over the objects, 0 for those without a box.
        ap25, ap50: average precision at IoU 0.25 and 0.5.
    """

    label: str
    frames: int
    objects: int
    found: float
    mean_iou: float
    ap25: float
    ap50: float


def score_project(
    project: Project, recording_id: int, frame_ids: Collection[int] | None = None, min_points: int = 100
) -> list[Scores]:
    """Compares the labels of a recording with its truth, class by class.

    Args:
        frame_ids: only these frames; None = all.
        min_points: true objects with fewer points in their box are ignored, as are labels that match them.

    Raises:
        RecordingError: the recording has no truth.
    """
    source = FrameSource(project)
    recording = source.recording(recording_id)
    indices = {key: index for index, key in enumerate(recording.keys)}
    results: dict[str, list[FrameResult]] = defaultdict(list)
    for stored in project.frames.of([recording_id]):
        if stored.index is None or (frame_ids is not None and stored.id not in frame_ids):
            continue
        frame = source.read(stored)
        truths = load_truth(recording, indices[stored.key], frame)
        has_points = [bool(contains(t.box, frame.cloud.xyz_m).sum() >= min_points) for t in truths]
        labels = [label for label in project.labels.of_frame(stored.id) if label.state in SCORED_STATES]
        for name in project.config.classes:
            of_class = [label for label in labels if label.label == name]
            scores = [1.0 if label.score is None else label.score for label in of_class]
            true_boxes, ignored = (
                [
                    t.box
                    for t, is_scored in zip(truths, has_points, strict=True)
                    if t.label == name and is_scored is wanted
                ]
                for wanted in (True, False)
            )
            results[name].append(FrameResult([label.box for label in of_class], scores, true_boxes, ignored))
    return [_scores(name, frame_results) for name, frame_results in results.items()]


def _scores(label: str, results: list[FrameResult]) -> Scores:
    ious = np.concatenate([matched_ious(result) for result in results] or [np.zeros(0)])
    return Scores(
        label=label,
        frames=len(results),
        objects=len(ious),
        found=float((ious > 0).mean()) if len(ious) else float("nan"),
        mean_iou=float(ious.mean()) if len(ious) else float("nan"),
        ap25=average_precision(results, 0.25),
        ap50=average_precision(results, 0.5),
    )
