"""Proposals for frames in memory: the settings used for each frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.project import BoxRotation
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.recordings import open_recording
from annotator.types import BoxKind, Frame
from annotator.workflows.detectors import Detectors
from annotator.workflows.proposing import lift as module
from annotator.workflows.proposing.lift import propose_frames

UP = np.array([0.0, -1.0, 0.0])


@pytest.mark.parametrize("kind", list(BoxKind))
def test_each_frame_gets_its_orientation_and_the_detectors_kind_of_boxes(
    kind: BoxKind, generated: Path, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = open_recording(generated / "people")
    asked: dict[Orientation, list[str]] = {}

    def note(frames: Sequence[Frame], boxes: Any, view: Any, config: RcvConfig, **_: Any) -> list[FrameProposals]:
        assert config.box_kind is kind
        asked[config.orientation] = [frame.key for frame in frames]
        return [FrameProposals(frame.key, (), ()) for frame in frames]

    monkeypatch.setattr(module, "propose_from_boxes", note)
    ups = (UP, None, UP)
    frames = [replace(recording.frame(place), up=up) for place, up in enumerate(ups)]
    keys = [frame.key for frame in frames]
    results = propose_frames(frames, knowing("people", kind), RcvConfig(), BoxRotation.AUTO)
    assert asked == {Orientation.UPRIGHT: [keys[0], keys[2]], Orientation.FREE: [keys[1]]}
    assert [result.key for result in results] == keys


def test_without_frames_there_are_no_proposals(knowing: Callable[..., Detectors]) -> None:
    assert propose_frames([], knowing("people"), RcvConfig(), BoxRotation.AUTO) == []
