"""The doubt of a proposal: one number that the review queue is sorted by.

    doubt = 1 - (1 - d1) (1 - d2) (1 - d3) (1 - d4) (1 - d5) (1 - d6)

Each d comes from one signal and grows linearly from 0 (good) to `MAX_DOUBT`, reached at the signal's bad value:

    the disagreement of the views                                `BAD_DISAGREEMENT`
    the share of the last step's points that the box lost        `BAD_LOST_SHARE`
    the change of the box in the last step                       `BAD_CHANGE`
    the disagreement with the box on the image                   `BAD_IMAGE`
    1 - score                                                    `BAD_SCORE`
    the IoU that the fit expects to lose                         `BAD_IOU_LOSS`

So one bad signal is enough to bring a proposal forward, and several add up. Signals without a value are left out.

docs/base_detector.md says how well the doubt sorts wrong boxes to the front. Rank correlation (Spearman) of the doubt
without the last signal with 1 - IoU to truth over 27 proposals on a generated recording, detectors 1 and 8 % off: 0.66
(boxes 0.79, silhouettes 0.50). Of the single signals, the last change (0.69) and the image (0.39) correlate most; the
lost share hardly correlates, so its bad value is high.
"""

from __future__ import annotations

import math

from annotator.project.review import Formula, Signal
from annotator.types import Quality

MAX_DOUBT = 0.7
# The bad values. In order, they are: share of the box's size, share of points, 1 - IoU (twice), 1 - score, 1 - IoU.
BAD_DISAGREEMENT = 0.25
BAD_LOST_SHARE = 0.9
BAD_CHANGE = 0.3
BAD_IMAGE = 0.6
BAD_SCORE = 1.0
BAD_IOU_LOSS = 0.5

FORMULA = Formula(
    (
        Signal("view_disagreement", 0.0, BAD_DISAGREEMENT),
        Signal("kept_share", 1.0, 1.0 - BAD_LOST_SHARE),
        Signal("last_change", 0.0, BAD_CHANGE),
        Signal("image_agreement", 1.0, 1.0 - BAD_IMAGE),
        Signal("score", 1.0, 1.0 - BAD_SCORE),
        Signal("expected_iou_loss", 0.0, BAD_IOU_LOSS),
    ),
    MAX_DOUBT,
)


def doubt(quality: Quality | None, score: float | None) -> float | None:
    """Returns the doubt in 0..1, or None for a box without signals: copied, or of other software without scores."""
    if quality is None and score is None:
        return None
    trust = 1.0
    for signal in FORMULA.signals:
        value = score if signal.name == "score" else getattr(quality, signal.name, None)
        if value is not None and not math.isnan(value):
            trust *= 1.0 - MAX_DOUBT * min(max((value - signal.good) / (signal.bad - signal.good), 0.0), 1.0)
    return 1.0 - trust
