"""What the base detector learns from: a class-agnostic view detector, from generated frames only.

Every frame, view and training image follows from seeds. No real recording is used. `scripts/train_base.py` trains it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import GENERATED, TrainingSample
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.recursion import held_direction
from annotator.rcv.teach import TaughtObject, teach_views
from annotator.synthetic.snapshots import snapshot

# An upright view is drawn of objects with an axis within this angle of the vertical, radians.
UPRIGHT_RAD = 0.06
# Random hues, because the colours of generated objects mean nothing.
BASE_TRAINING = TrainingConfig(
    pretrained="never",
    image_size_px=64,
    pictures_seen=400_000,
    batch=32,
    recipe={"warmup_epochs": 0.1, "scale": 0.25, "hsv_h": 0.5, "hsv_s": 0.5, "hsv_v": 0.4},
)


def generated_views(seed: int, draws: int, size_px: int) -> Iterator[TrainingSample]:
    """The labelled views of one generated frame; those of upright objects are level in half of the crops.

    Args:
        draws: crops per object, each with two views.
        size_px: longer side of the views.
    """
    shot = snapshot(seed)
    random = np.random.default_rng([seed, draws])
    objects = [TaughtObject(item.label, item.box, item.points) for item in shot.objects]
    config = RcvConfig(view_px=size_px)
    for index, item in enumerate(objects):
        level = shot.frame.up is not None and np.abs(shot.frame.up @ item.box.rotation).max() > np.cos(UPRIGHT_RAD)
        for _ in range(draws):
            upright = random.random() < 0.5 and level
            orientation = Orientation.UPRIGHT if upright else Orientation.FREE
            up = held_direction(shot.frame.up, config.model_copy(update={"orientation": orientation}))
            for taught in teach_views(shot.frame, objects, None, 1, config, up, random, targets=[index]):
                yield TrainingSample(taught.view.rgb, taught.boxes, f"snapshot/{seed}", GENERATED)


def views_of(seeds: range, draws: int, size_px: int) -> list[TrainingSample]:
    """The views of several generated frames: the task of a worker process."""
    return [sample for seed in seeds for sample in generated_views(seed, draws, size_px)]
