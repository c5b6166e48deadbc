"""The whole loop with real detectors: a simulated operator labels, both detectors train, RCV proposes elsewhere.

    python -m benchmarks.loop TRAIN_DIR [TEST_DIR] [--operator silhouette|box] [--upright | --free]
        [--model yolov5nu] [--json]

With one folder every second frame trains and the others test. The truth is used twice only: by the simulated operator
on the training frames, and to score the proposals on the test frames. Masks alone will do for the operator
`silhouette`; what needs true boxes to be scored is then null.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro
from rich.console import Console

from annotator.detection.config import Backend
from annotator.detection.progress import TrainingProgress
from annotator.project import BoxRotation, Project, ProjectSettings, Role, create_project, open_project
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose
from annotator.recordings import Recording, open_recording
from annotator.types import BoxKind, Frame
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.annotate import BATCH_FRAMES
from annotator.workflows.detectors import Detectors, active_detectors
from annotator.workflows.frames import orientation_for
from annotator.workflows.rcv_settings import rcv_config
from annotator.workflows.recordings import register_recording
from annotator.workflows.samples import SampleConfig
from annotator.workflows.simulate import require_boxes_for, simulate_recording
from annotator.workflows.train import IMAGE_DEFAULTS, VIEW_DEFAULTS, TrainPlan, train
from annotator.workflows.truth import has_masks, has_truth, load_truth
from benchmarks.loop_scores import Scores
from benchmarks.report import Table, finish, guarded

NAME = "loop"
# What objects are called where a folder has masks only.
UNNAMED = "object"
QUIET = Console(stderr=True)


@dataclass
class Arguments:
    """Label, train, propose and score, end to end."""

    train_dir: Annotated[Path, tyro.conf.Positional]
    """A recording with truth (boxes, or masks for the silhouette operator)."""
    test_dir: Annotated[Path | None, tyro.conf.Positional] = None
    """Another one to test on; without it every second frame of the first."""
    operator: BoxKind | None = None
    """What the simulated operator draws: around what is seen (the default with masks alone), or the projected true box
    (the default elsewhere)."""
    axes: Strategy = Strategy.CONSENSUS
    """The strategy that proposes."""
    upright: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Hold one axis at gravity (the default where the recording knows gravity)."""
    free: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Let boxes turn freely (the default elsewhere)."""
    label: str | None = None
    """The class of the objects in a folder with masks but no boxes; None = "object"."""
    epochs: int | None = None
    """Of both trainings; None = as many as show the default number of pictures."""
    model: str | None = None
    """An ultralytics detection model for both; None = the default of each."""
    size: int | None = None
    """Longer side of the pseudo-views, drawn and trained at, pixels; None = the default."""
    refine_steps: int | None = None
    """Steps of the recursion after the wide one; None = the default. `annotator live` takes none."""
    backend: Backend = "auto"
    """What runs the detectors."""
    views: int = SampleConfig().views
    """About how many pseudo-views are made of what is known in 3D."""
    project: Path | None = None
    """Keep the project here, or use the detectors of one that is here: compares strategies on the same ones."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""

    def settings(self, config: RcvConfig) -> RcvConfig:
        """The project's settings with what was asked for."""
        consensus = config.consensus
        if self.refine_steps is not None:
            consensus = consensus.model_copy(update={"refine_steps": self.refine_steps})
        return config.model_copy(update={"strategy": self.axes, "consensus": consensus})

    @property
    def rotation(self) -> BoxRotation | None:
        """What was asked for; None for whatever suits.

        Raises:
            ConfigError: both at once.
        """
        if self.upright and self.free:
            raise ConfigError("--upright and --free exclude each other; give one of them, or none")
        return BoxRotation.UPRIGHT if self.upright else BoxRotation.FREE if self.free else None


def run(args: Arguments) -> dict[str, object]:
    """The benchmark; what `--json` prints.

    Raises:
        ConfigError: arguments that contradict each other, the folders or the project that is kept.
        AnnotatorError: of its stages.
    """
    recording = open_recording(args.train_dir)
    test = recording if args.test_dir is None else open_recording(args.test_dir)
    if not (has_truth(test) or has_masks(test)):
        raise ConfigError(f"{test.path}: brings neither true boxes nor masks, so there is nothing to score")
    step = 2 if args.test_dir is None else 1
    frames = list(range(step - 1, len(test), step))
    seconds: dict[str, float] = {}
    with taught(args, recording, step, seconds) as (project, boxes_2d):
        begin = time.perf_counter()
        detectors = active_detectors(project, backend=args.backend)
        config = args.settings(rcv_config(project)).model_copy(update={"box_kind": detectors.box_kind})
        scores = Scores(test, project.config.classes)
        _propose_all(frames, detectors, config, project.config.settings.rotation, scores)
        seconds["propose"] = time.perf_counter() - begin
    return {
        **scores.summary(),
        "boxes_2d": boxes_2d,
        "operator": detectors.box_kind.value,
        "axes": args.axes.value,
        "backend": args.backend,
        "seconds": seconds,
    }


@contextmanager
def taught(
    args: Arguments, recording: Recording, step: int, seconds: dict[str, float]
) -> Iterator[tuple[Project, int]]:
    """A project whose detectors have learnt from every so many frames of a recording, and how many 2D boxes it has.

    Args:
        step: 2 = every second frame.
        seconds: gets what labelling and training took, as far as they were to be done.

    Raises:
        ConfigError, AnnotatorError: as `run`.
    """
    with TemporaryDirectory() as temporary, _project(args, recording, args.rotation, Path(temporary)) as project:
        yield project, _teach(project, recording, step, args, seconds)


def _labels(args: Arguments, recording: Recording) -> list[str]:
    """The classes of a new project: those of the true boxes, or what the objects of the masks shall be called."""
    if _masks_alone(recording):
        return [args.label or UNNAMED]
    if args.label is not None:
        raise ConfigError(f"{recording.path}: --label is for masks alone; the classes are those of its true boxes")
    labels: set[str] = set()
    for index in range(len(recording)):
        try:
            frame = recording.frame(index)
        except FrameError:
            continue  # labelling tells of it if it is to be labelled, proposing if it is to be tested
        labels.update(truth.label for truth in load_truth(recording, index, frame))
    if not labels:
        raise ConfigError(f"{recording.path}: brings no true boxes, so there is nothing to learn or score")
    return sorted(labels)


def _masks_alone(recording: Recording) -> bool:
    return has_masks(recording) and not has_truth(recording)


def _project(args: Arguments, recording: Recording, rotation: BoxRotation | None, temporary: Path) -> Project:
    """A new project, or the one that an earlier run kept, where that is what the arguments ask for."""
    root = args.project or temporary
    if not (root / NAME).is_dir():
        if args.operator is not None:
            require_boxes_for(args.operator, recording)
        settings = ProjectSettings(rotation=rotation or BoxRotation.AUTO)
        return create_project(root, NAME, _labels(args, recording), settings=settings)
    project = open_project(root / NAME)
    try:
        _require_same(args, rotation, project)
    except BaseException:
        project.close()
        raise
    return project


def _require_same(args: Arguments, rotation: BoxRotation | None, project: Project) -> None:
    """A kept project stays what it is: its detectors would be measured as what they are not."""
    stored, kind = project.config.settings.rotation, _taught_kind(project)
    where = f"the project {project.path}"
    if rotation not in (None, stored):
        raise ConfigError(f"{where} keeps the rotation {stored.value}, not {rotation}; leave --{rotation} away")
    if args.operator is not None and kind not in (None, args.operator):
        raise ConfigError(f"{where} was labelled by the operator {kind}, not {args.operator}; leave --operator away")
    if args.label is not None and args.label not in project.config.classes:
        raise ConfigError(f"{where} has the classes {', '.join(project.config.classes)}, not {args.label!r}")


def _taught_kind(project: Project) -> BoxKind | None:
    """What the view detector learnt from, or will learn from; None where nothing is labelled yet."""
    model = project.models.active(Role.VIEW)
    if model is not None:
        return model.box_kind
    return next((boxes.box_kind for boxes in project.boxes.on_images()), None)


def _teach(
    project: Project,
    recording: Recording,
    step: int,
    args: Arguments,
    seconds: dict[str, float],
) -> int:
    """Labels and trains, as far as the project has not done so already; the number of 2D boxes drawn."""
    if project.models.active(Role.VIEW) is None:
        default = BoxKind.SILHOUETTE if _masks_alone(recording) else BoxKind.BOX
        _label(
            project,
            recording,
            step,
            args.operator or _taught_kind(project) or default,
            plan(args).view.image_size_px,
            seconds,
        )
        for trained in train(project, plan(args), progress=_report):
            seconds[f"train_{trained.role}"] = trained.seconds
            QUIET.print(f"{trained.role}: {trained.manifest.images['train']} pictures, {trained.result.metrics}")
    counts = project.statistics()
    return counts.image_boxes.boxes + counts.view_boxes.boxes


def _label(
    project: Project, recording: Recording, step: int, operator: BoxKind, size_px: int, seconds: dict[str, float]
) -> None:
    """Labels every so many frames, unless an earlier run came as far as that and was ended in training."""
    begin = time.perf_counter()
    stored = register_recording(project, recording)
    wanted = {frame.id for frame in [f for f in project.frames.of([stored.id]) if f.index is not None][::step]}
    if wanted <= {boxes.frame_id for boxes in project.boxes.on_images([stored.id])}:
        return
    simulate_recording(project, stored.id, operator, rcv_config(project, view_px=size_px), step)
    seconds["label"] = time.perf_counter() - begin


def plan(args: Arguments) -> TrainPlan:
    """The trainings that the arguments ask for."""
    samples, chosen = SampleConfig(views=args.views), dict[str, object](epochs=args.epochs)
    if args.model is not None:
        chosen["model"] = args.model
    of_views = chosen if args.size is None else chosen | {"image_size_px": args.size}
    return TrainPlan(
        image=IMAGE_DEFAULTS.model_copy(update=chosen), view=VIEW_DEFAULTS.model_copy(update=of_views), samples=samples
    )


def _report(role: Role, step: TrainingProgress) -> None:
    if step.batch == step.batches and step.epoch % 5 == 0:
        QUIET.print(f"{role} epoch {step.epoch}/{step.epochs}: {step.seconds:.0f} s", highlight=False)


def _propose_all(
    frames: Sequence[int], detectors: Detectors, config: RcvConfig, rotation: BoxRotation, scores: Scores
) -> None:
    for first in range(0, len(frames), BATCH_FRAMES):
        read: dict[int, Frame] = {}
        for index in frames[first : first + BATCH_FRAMES]:
            try:
                read[index] = scores.recording.frame(index)
            except FrameError as error:
                QUIET.print(f"counted as a frame without a proposal: {error}", highlight=False, markup=False)
                scores.add_unreadable()
        for index, found in propose_batch(read, detectors, config, rotation).items():
            scores.add(index, read[index], found)


def propose_batch(
    frames: dict[int, Frame], detectors: Detectors, config: RcvConfig, rotation: BoxRotation
) -> dict[int, FrameProposals]:
    """The proposals of frames by their numbers; those that know gravity and those that do not go apart."""
    alike: dict[Orientation, list[int]] = defaultdict(list)
    for index, frame in frames.items():
        alike[orientation_for(rotation, frame)].append(index)
    found: dict[int, FrameProposals] = {}
    for orientation, indices in alike.items():
        settings = config.model_copy(update={"orientation": orientation})
        chosen = [frames[i] for i in indices]
        results = propose(chosen, detectors.image, detectors.view, settings, compute=detectors.compute)
        found.update(zip(indices, results, strict=True))
    return found


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__, config=(tyro.conf.EnumChoicesFromValues,))
    result = run(args)
    table = Table("measure", "value")
    for name, value in result.items():
        table.add(name, value)
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
