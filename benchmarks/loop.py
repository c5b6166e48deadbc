"""The whole loop with real detectors: a simulated operator labels, both detectors train, RCV proposes elsewhere.

    python -m benchmarks.loop TRAIN_DIR [TEST_DIR] [--operator silhouette|box] [--upright | --free] [--json]

With one folder every second frame trains and the others test. The truth is used twice only: by the simulated operator
on the training frames, and to score the proposals on the test frames.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from annotator.detection.progress import TrainingProgress
from annotator.evaluation.oriented import FrameResult, average_precision, mask_agreement, matched_ious
from annotator.project import BoxRotation, Project, ProjectSettings, Role, create_project, open_project
from annotator.rcv.config import RcvConfig, Strategy
from annotator.rcv.propose import FrameProposals, propose
from annotator.recordings import Recording, open_recording
from annotator.types import BoxKind, Frame, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.annotate import BATCH_FRAMES
from annotator.workflows.detectors import Detectors, active_detectors
from annotator.workflows.frames import orientation_for
from annotator.workflows.recordings import register_recording
from annotator.workflows.samples import SampleConfig
from annotator.workflows.simulate import simulate_recording
from annotator.workflows.train import IMAGE_DEFAULTS, VIEW_DEFAULTS, TrainPlan, train
from annotator.workflows.truth import load_mask, load_truth
from benchmarks.report import Table, finish, guarded

NAME = "loop"
QUIET = Console(stderr=True)


@dataclass
class Arguments:
    """Label, train, propose and score, end to end."""

    train_dir: Annotated[Path, tyro.conf.Positional]
    """A recording with truth (boxes, and masks for the silhouette operator)."""
    test_dir: Annotated[Path | None, tyro.conf.Positional] = None
    """Another one to test on; without it every second frame of the first."""
    operator: BoxKind = BoxKind.BOX
    """What the simulated operator draws: around what is seen, or the projected true box."""
    axes: Strategy = Strategy.CONSENSUS
    """The strategy that proposes."""
    upright: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Hold one axis at gravity (the default where the recording knows gravity)."""
    free: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Let boxes turn freely (the default elsewhere)."""
    epochs: int | None = None
    """Of both trainings; None = as many as show the default number of pictures."""
    views: int = SampleConfig.views
    """About how many pseudo-views are made of what is known in 3D."""
    project: Path | None = None
    """Keep the project here, or use the detectors of one that is here: compares strategies on the same ones."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def run(args: Arguments) -> dict[str, object]:
    """The benchmark; what `--json` prints."""
    recording = open_recording(args.train_dir)
    test = recording if args.test_dir is None else open_recording(args.test_dir)
    step = 2 if args.test_dir is None else 1
    labels = sorted({t.label for i in range(len(recording)) for t in _truths(recording, i)})
    if not labels:
        raise ConfigError(f"{args.train_dir}: brings no true boxes, so there is nothing to learn or score")
    rotation = BoxRotation.UPRIGHT if args.upright else BoxRotation.FREE if args.free else BoxRotation.AUTO
    frames = list(range(step - 1, len(test), step))
    seconds: dict[str, float] = {}
    with TemporaryDirectory() as temporary, _project(args.project or Path(temporary), labels, rotation) as project:
        boxes_2d = _teach(project, recording, step, args, seconds)
        begin = time.perf_counter()
        detectors = active_detectors(project)
        config = RcvConfig(strategy=args.axes, box_kind=detectors.box_kind)
        scored = _propose_all(test, frames, detectors, config, rotation, labels)
        seconds["propose"] = time.perf_counter() - begin
    return {
        **scored,
        "boxes_2d": boxes_2d,
        "operator": args.operator.value,
        "axes": args.axes.value,
        "seconds": seconds,
    }


def _truths(recording: Recording, index: int) -> list[Truth]:
    return load_truth(recording, index, recording.frame(index))


def _project(root: Path, labels: Sequence[str], rotation: BoxRotation) -> Project:
    """A new project, or the one that an earlier run kept here."""
    if (root / NAME).is_dir():
        return open_project(root / NAME)
    return create_project(root, NAME, labels, settings=ProjectSettings(rotation=rotation))


def _teach(
    project: Project,
    recording: Recording,
    step: int,
    args: Arguments,
    seconds: dict[str, float],
) -> int:
    """Labels and trains, unless the project has its detectors already; the number of 2D boxes drawn."""
    if project.models.active(Role.VIEW) is None:
        begin = time.perf_counter()
        stored = register_recording(project, recording)
        simulate_recording(project, stored.id, args.operator, RcvConfig(), step)
        seconds["label"] = time.perf_counter() - begin
        for trained in train(project, plan(args), progress=_report):
            seconds[f"train_{trained.role}"] = trained.seconds
            QUIET.print(f"{trained.role}: {trained.manifest.images['train']} pictures, {trained.result.metrics}")
    counts = project.statistics()
    return counts.image_boxes.boxes + counts.view_boxes.boxes


def plan(args: Arguments) -> TrainPlan:
    """The trainings that the arguments ask for."""
    samples, chosen = SampleConfig(views=args.views), {"epochs": args.epochs}
    return TrainPlan(
        image=IMAGE_DEFAULTS.model_copy(update=chosen), view=VIEW_DEFAULTS.model_copy(update=chosen), samples=samples
    )


def _report(role: Role, step: TrainingProgress) -> None:
    if step.batch == step.batches and step.epoch % 5 == 0:
        QUIET.print(f"{role} epoch {step.epoch}/{step.epochs}: {step.seconds:.0f} s", highlight=False)


@dataclass(eq=False)
class _Scores:
    """What the test frames gave."""

    frames: int = 0
    with_proposal: int = 0
    ious: list[float] = field(default_factory=list)
    recalls: list[float] = field(default_factory=list)
    precisions: list[float] = field(default_factory=list)
    results: dict[str, list[FrameResult]] = field(default_factory=lambda: defaultdict(list))

    def add(self, recording: Recording, index: int, frame: Frame, found: FrameProposals, labels: Sequence[str]) -> None:
        truths = [t for t in load_truth(recording, index, frame) if t.label in labels]
        if not truths:
            return
        self.frames += 1
        self.with_proposal += bool(found.proposals)
        for label in labels:
            own = [p for p in found.proposals if p.label == label]
            result = FrameResult(
                [p.box for p in own], [p.score for p in own], [t.box for t in truths if t.label == label]
            )
            self.results[label].append(result)
            self.ious.extend(matched_ious(result))
        mask = load_mask(recording, frame)
        if mask is not None and frame.cloud.pixel_index is not None:
            of_object = mask.ravel()[frame.cloud.pixel_index] > 0
            agreement = mask_agreement([p.box for p in found.proposals], frame.cloud, of_object)
            self.recalls.append(agreement.recall)
            self.precisions.append(agreement.precision)

    def summary(self) -> dict[str, object]:
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


def _propose_all(
    test: Recording,
    frames: Sequence[int],
    detectors: Detectors,
    config: RcvConfig,
    rotation: BoxRotation,
    labels: Sequence[str],
) -> dict[str, object]:
    scores = _Scores()
    for first in range(0, len(frames), BATCH_FRAMES):
        indices = frames[first : first + BATCH_FRAMES]
        read = [test.frame(i) for i in indices]
        settings = config.model_copy(update={"orientation": orientation_for(rotation, read[0])})
        results = propose(read, detectors.image, detectors.view, settings)
        for index, frame, found in zip(indices, read, results, strict=True):
            scores.add(test, index, frame, found, labels)
    return scores.summary()


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__, config=(tyro.conf.EnumChoicesFromValues,))
    result = run(args)
    table = Table("measure", "value")
    for name, value in result.items():
        table.add(name, value)
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
