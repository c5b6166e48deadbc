"""A recorded live session into its project: the recording, and for every frame the boxes that were seen on it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from annotator.project import Project
from annotator.project.config import BoxRotation
from annotator.project.proposals import RunShare
from annotator.project.writing import Change
from annotator.rcv.config import REVISION, RcvConfig
from annotator.recordings import open_recording
from annotator.types import Source
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import Detectors
from annotator.workflows.live.recorder import Recorder
from annotator.workflows.recordings import register_recording

AUTHOR = "rcv, live"


@dataclass(frozen=True)
class Stored:
    """What a project got: the name of the recording there, its frames and proposals."""

    name: str
    frames: int
    proposals: int


def require_unknown(project: Project, out: Path) -> None:
    """Refuses the place of a recording that the project knows, if only from before its folder was removed: frames have
    the same keys in every live recording, so those of the new one would be taken for those that were labelled.

    Raises:
        ConfigError: the project has a recording at `out`.
    """
    place = out.resolve()
    for known in project.recordings.all():
        if known.path == place:
            raise ConfigError(
                f"{out}: the project has a recording there already, {known.name}, whose labels would come to lie on "
                "what is seen now; record to another path"
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
    """Adds a finished recording and its proposals, ready for review.

    The run is told apart from one of `annotate` by its settings: that goes over every frame again, on its own.

    Raises:
        RecordingError: the recording cannot be read.
        ProjectError: the store refuses.
    """
    recording = open_recording(recorder.out)
    stored = register_recording(project, recording)
    settings = {
        **config.model_dump(mode="json", exclude={"orientation"}),
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
    for kept in recorder.kept():
        frame = frames[kept.key]
        change = Change(frame.revision, AUTHOR, Source.AUTO)
        share = RunShare(run.id, kept.seconds)
        project.proposals.replace(frame.id, kept.found.proposals, change, lost=kept.found.lost, run=share)
        proposals += len(kept.found.proposals)
    project.jobs.finish(run.id)
    return Stored(stored.name, len(frames), proposals)
