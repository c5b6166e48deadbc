"""Stores a recorded live session in its project: the recording, and the proposals of every frame."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from annotator.project import Project
from annotator.project.config import BoxRotation
from annotator.project.log.writing import WriteContext
from annotator.project.proposals import RunShare
from annotator.rcv.config import REVISION, RcvConfig
from annotator.recordings import open_recording
from annotator.types import Source
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors
from annotator.workflows.live.recorder import Recorder

AUTHOR = "rcv, live"


@dataclass(frozen=True)
class Stored:
    """A stored session: the recording's name in the project, and the numbers of frames and proposals."""

    name: str
    frames: int
    proposals: int


def require_unused_path(project: Project, out: Path) -> None:
    """Checks that the project has no recording at `out`, not even one whose folder was removed.

    All live recordings use the same frame keys, so the labels of an old recording would be assigned to the new frames.

    Raises:
        ConfigError: the project has a recording at `out`.
    """
    path = out.resolve()
    for known in project.recordings.all():
        if known.path == path:
            raise ConfigError(
                f"{out}: the project has a recording there already, {known.name}, whose labels would be assigned to "
                "the new frames; record to another path"
            )


def store(
    project: Project,
    recorder: Recorder,
    detectors: Detectors,
    config: RcvConfig,
    rotation: BoxRotation,
    *,
    warm_start: bool,
) -> Stored:
    """Adds a finished recording and its proposals to the project, ready for review.

    The stored settings differ from those of an `annotate` run, so `annotate` processes these frames again.

    Raises:
        RecordingError: the recording cannot be read.
        ProjectError: the recording or its proposals cannot be stored.
    """
    recording = open_recording(recorder.out)
    stored = register_recording(project, recording)
    settings = {
        **config.record(),
        "rotation": rotation.value,
        "method": REVISION,
        "live": "warm start" if warm_start else "each frame by itself",
        "backends": detectors.backends,
    }
    run = project.jobs.start(
        image_detector=detectors.image.fingerprint,
        view_detector=detectors.view.fingerprint,
        config_json=json.dumps(settings),
    )
    frames = {frame.key: frame for frame in project.frames.of([stored.id])}
    proposals = 0
    for recorded in recorder.recorded():
        frame, result = frames[recorded.key], recorded.result
        context = WriteContext(frame.revision, AUTHOR, Source.AUTO)
        share = RunShare(run.id, recorded.seconds)
        project.proposals.replace(
            frame.id, result.proposals, context, lost=result.lost, run=share, box_kind=detectors.box_kind
        )
        proposals += len(result.proposals)
    project.jobs.finish(run.id)
    return Stored(stored.name, len(frames), proposals)
