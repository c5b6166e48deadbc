"""Scores of the proposals on the test frames of `benchmarks.loop`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from annotator.evaluation.oriented import FrameResult, average_precision, mask_agreement, matched_ious
from annotator.rcv.finish import FrameProposals
from annotator.recordings import Recording
from annotator.types import Frame
from annotator.workflows.recorded.reading import has_truth, load_mask, load_truth


@dataclass(eq=False)
class Scores:
    """Accumulates the scores of the test frames.

    A frame without an object counts only in average precision, where its proposals are false positives. An unreadable
    frame only counts as a frame without a proposal, since its number of objects is unknown. Without true boxes, masks
    are used instead, and IoU and average precision are NaN.

    Attributes:
        recording: the test recording.
        labels: the classes of the detectors.
        frames: number of frames with an object, plus the unreadable ones.
        with_proposal: number of these with a proposal.
        ious: IoU of each true object with its matched proposal.
        recalls, precisions: share of an object's points inside proposals, and share of the points inside proposals that
            belong to an object; one value per frame with a mask.
        results: boxes of each frame, by class.
    """

    recording: Recording
    labels: Sequence[str]
    frames: int = 0
    with_proposal: int = 0
    ious: list[float] = field(default_factory=list)
    recalls: list[float] = field(default_factory=list)
    precisions: list[float] = field(default_factory=list)
    results: dict[str, list[FrameResult]] = field(default_factory=lambda: defaultdict(list))

    def add_unreadable(self) -> None:
        """Counts a test frame that cannot be read."""
        self.frames += 1

    def add(self, index: int, frame: Frame, proposed: FrameProposals) -> None:
        """Counts the proposals of one test frame.

        Raises:
            RecordingError: the recording has neither boxes nor masks.
            FormatError: the boxes or the mask cannot be read.
        """
        mask = load_mask(self.recording, frame)
        boxed = mask is None or has_truth(self.recording)
        truths = [t for t in load_truth(self.recording, index, frame) if t.label in self.labels] if boxed else []
        results = []
        for label in self.labels:
            of_class = [p for p in proposed.proposals if p.label == label]
            true_boxes = [t.box for t in truths if t.label == label]
            results.append(FrameResult([p.box for p in of_class], [p.score for p in of_class], true_boxes))
            self.results[label].append(results[-1])
        if not (truths or (not boxed and mask is not None and mask.any())):
            return
        self.frames += 1
        self.with_proposal += bool(proposed.proposals)
        self.ious.extend(float(iou) for result in results for iou in matched_ious(result))
        if mask is not None and frame.cloud.pixel_index is not None:
            of_object = mask.ravel()[frame.cloud.pixel_index] > 0
            agreement = mask_agreement([p.box for p in proposed.proposals], frame.cloud, of_object)
            self.recalls.append(agreement.recall)
            self.precisions.append(agreement.precision)

    def summary(self) -> dict[str, object]:
        """The mean scores, by name; NaN without measurements."""
        ap = {t: [average_precision(r, t) for r in self.results.values()] for t in (0.25, 0.5)}
        return {
            "frames": self.frames,
            "share_with_proposal": self.with_proposal / max(self.frames, 1),
            "mask_recall": _mean(self.recalls),
            "mask_precision": _mean(self.precisions),
            "mean_iou": _mean(self.ious),
            "ap25": _mean([a for a in ap[0.25] if np.isfinite(a)]),
            "ap50": _mean([a for a in ap[0.5] if np.isfinite(a)]),
        }


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")
