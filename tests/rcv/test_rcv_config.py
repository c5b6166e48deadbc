"""The settings of the recursion: each has a description and a bound, and takes effect."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from scenes import frame_with, some_box

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.oriented_box import box_corners
from annotator.rcv.config import AxesConfig, ConsensusConfig, FitConfig, Orientation, RcvConfig, Strategy
from annotator.rcv.propose import propose
from annotator.types import BoxKind, Proposal


def leaves(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    for name, info in model.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            yield from leaves(info.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, info


NUMBERS = [(name, info) for name, info in leaves(RcvConfig) if info.annotation in (int, float)]


@pytest.mark.parametrize(("name", "info"), NUMBERS, ids=[name for name, _ in NUMBERS])
def test_each_number_has_a_description_and_a_bound(name: str, info: FieldInfo) -> None:
    assert info.description
    assert info.metadata, "no bound"
    nested: object = -1
    for part in reversed(name.split(".")):
        nested = {part: nested}
    with pytest.raises(ValidationError, match=name.rpartition(".")[2]):
        RcvConfig.model_validate(nested)


BOX = some_box([-0.3, 0.1, 2.2], [0, 0.5, 0], [0.6, 0.8, 0.3])


def proposed(config: RcvConfig, jitter: float = 0.02, kind: BoxKind = BoxKind.BOX) -> Proposal:
    frame, truths = frame_with([BOX], up=np.array([0.0, -1.0, 0.0]))
    detector = PerfectDetector.for_frame(frame, truths, kind=kind, jitter=jitter)
    (found,) = propose([frame], detector, detector, config)[0].proposals
    return found


@pytest.mark.parametrize(
    ("strategy", "kind", "change"),
    [
        (Strategy.NORMALS, BoxKind.BOX, {"axes": AxesConfig(steep_normal_rad=1.57)}),
        (Strategy.NORMALS, BoxKind.BOX, {"axes": AxesConfig(max_normals=16)}),
        (Strategy.NORMALS, BoxKind.BOX, {"axes": AxesConfig(normal_neighbours=200)}),
        (Strategy.CONSENSUS, BoxKind.BOX, {"fit": FitConfig(huber_sigmas=0.01)}),
        (Strategy.CONSENSUS, BoxKind.BOX, {"fit": FitConfig(min_determinacy=0.99)}),
        (Strategy.CONSENSUS, BoxKind.BOX, {"fit": FitConfig(min_size_m=0.5)}),
        (Strategy.CONSENSUS, BoxKind.BOX, {"fit": FitConfig(cut_doubt=1000.0), "border_px": 12.0}),
        (Strategy.CONSENSUS, BoxKind.BOX, {"border_px": 40.0, "cut_room": 2.0}),
        (Strategy.CONSENSUS, BoxKind.SILHOUETTE, {"consensus": ConsensusConfig(whole_share=0.2)}),
    ],
)
def test_a_setting_takes_effect(strategy: Strategy, kind: BoxKind, change: dict[str, object]) -> None:
    plain = RcvConfig(strategy=strategy, orientation=Orientation.UPRIGHT, box_kind=kind)
    changed = RcvConfig(**{**dict(plain), **change})
    before, after = (box_corners(proposed(config, kind=kind).box) for config in (plain, changed))
    assert not np.array_equal(before, after)
