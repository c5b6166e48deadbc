"""The paper's tables, from the data set to the figures: 2D boxes from 3D boxes, training, RCV, official AP.

    python -m benchmarks.paper kitti --root KITTI --fraction 0.25 [--settings product] [--limit 20] [--json]
    python -m benchmarks.paper sunrgbd --root SUNRGBD [--classes votenet] [--settings product] [--limit 20] [--json]

Each stage stores its result in --work; a stage with a stored result for the same settings is skipped. `annotator
serve --projects WORK/projects` shows the project with its boxes and proposals. docs/paper.md describes the stages and
how long they take.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from pydantic import JsonValue, ValidationError

from annotator.detection.config import TrainingConfig
from annotator.project import open_project
from annotator.rcv.config import RcvConfig, Strategy
from annotator.recordings import open_recording
from annotator.types.errors import ConfigError
from annotator.workflows.training.train import VIEW_DEFAULTS, TrainPlan
from benchmarks.paper_protocol import ProjectStages, Stages, import_frames, split_of
from benchmarks.paper_tables import (
    IMAGE,
    YOLOV5,
    Classes,
    Dataset,
    Preset,
    classes_of,
    kitti_table,
    paper_of_kitti,
    paper_of_sunrgbd,
    rcv_options,
    sunrgbd_table,
)
from benchmarks.report import QUIET, Options, Table, guarded, program


@dataclass
class Arguments(Options):
    dataset: Annotated[Dataset, tyro.conf.Positional]
    """The benchmark."""
    root: Path
    """Folder of the data set's frames and labels: KITTI (or its training/), SUN RGB-D as extracted by VoteNet, or its
    raw scenes."""
    work: Path = Path("out/paper")
    """Folder for the results of the stages."""
    fraction: float = 1.0
    """Share of the training frames to use; the paper uses 0.25, 0.5 and 0.8 of KITTI."""
    settings: Preset = Preset.PRODUCT
    """Training settings: paper = YOLOv5x6 at 640 px for 300 epochs, needs a GPU; product = annotator's defaults."""
    axes: Strategy | None = None
    """How projection axes are found; default: normals with --settings paper, else consensus."""
    classes: Classes = Classes.PAPER
    """SUN RGB-D: the ten classes of the paper or of VoteNet."""
    limit: int | None = None
    """Maximum number of training frames and of test frames."""
    seed: int = 0
    """Seed of the choice of frames and of training."""
    model: str | None = None
    """Name of an ultralytics detection model for both detectors; default: that of --settings."""
    weights: str = "auto"
    """Initial weights: auto = pretrained if found or downloadable, else random; never = random; or a file."""
    epochs: int | None = None
    """Epochs of the pseudo-view detector; default: those of --settings."""
    image_epochs: int | None = None
    """Epochs of the image detector; default: those of --settings."""
    size: int | None = None
    """Side of the pseudo-views in training, pixels."""
    image_size: int | None = None
    """Longer side of the camera images in training, pixels."""

    @property
    def image_training(self) -> TrainingConfig:
        """The image detector's settings."""
        return self._training(IMAGE, self.image_epochs, self.image_size)

    @property
    def view_training(self) -> TrainingConfig:
        """The pseudo-view detector's settings."""
        return self._training(VIEW_DEFAULTS, self.epochs, self.size)

    @property
    def view_px(self) -> int:
        """Longer side of a rendered pseudo-view, pixels; with the paper's settings that of the network's input."""
        return self.view_training.image_size_px if self.settings is Preset.PAPER else RcvConfig().view_px

    def _training(self, product: TrainingConfig, epochs: int | None, size_px: int | None) -> TrainingConfig:
        """The preset's settings, changed by the arguments, and checked."""
        start = YOLOV5 if self.settings is Preset.PAPER else product
        given = {"model": self.model, "epochs": epochs, "image_size_px": size_px, "seed": self.seed}
        changes = {name: value for name, value in given.items() if value is not None}
        pretrained = self.weights if self.weights in ("auto", "never") else Path(self.weights)
        try:
            return TrainingConfig.model_validate({**start.model_dump(), **changes, "pretrained": pretrained})
        except ValidationError as error:
            problem = error.errors()[0]
            raise ConfigError(f"{problem['loc'][0]}: {problem['msg']}, not {problem['input']}") from error


def run(args: Arguments) -> dict[str, Any]:
    """Runs the whole protocol; returns what `--json` prints."""
    if args.limit is not None and args.limit < 1:
        raise ConfigError(f"--limit must be 1 or more, not {args.limit}")
    plan = TrainPlan(image=args.image_training, view=args.view_training)
    classes = classes_of(args.dataset, args.classes)
    recording = open_recording(args.root)
    split = split_of(recording, args.seed).limited(args.limit, args.seed)
    QUIET.print(": ".join(filter(None, (split.source, split.coverage()))))
    start: dict[str, JsonValue] = {
        "dataset": args.dataset.value,
        "root": str(args.root.resolve()),
        "train": _hash(list(split.train)),
        "val": _hash(list(split.val)),
        "classes": list(classes),
        "view_px": args.view_px,
    }
    # in the name, so that each share of the frames has a separate project
    share = {"fraction": args.fraction, "seed": args.seed}
    name = f"{args.dataset.value}-{100 * args.fraction:.0f}-{_hash({**start, **share})}"
    project_path, frames = args.work / "projects" / name, args.work / "frames" / name
    stages = Stages(args.work / "stages" / name, QUIET.print)
    stages.run(
        "import",
        start,
        lambda: import_frames(recording, split, project_path, frames, classes, args.view_px),
        lambda _: project_path.is_dir() and frames.is_dir(),
    )
    options = rcv_options(args.dataset, args.axes, args.settings)
    with open_project(project_path) as project:
        ours = ProjectStages(project, args.dataset, args.fraction, args.seed, plan, options, stages).run()
    return {
        "dataset": args.dataset.value,
        "fraction": args.fraction,
        "settings": args.settings.value,
        "axes": options["strategy"],
        "project": str(project_path),
        "skipped": stages.skipped,
        "seconds": {stage: record.seconds for stage, record in stages.done.items()},
        "stages": {stage: record.result for stage, record in stages.done.items() if stage != "evaluate"},
        "ours": dict(ours),
        "paper": paper_of_kitti(args.fraction) if args.dataset is Dataset.KITTI else paper_of_sunrgbd(),
    }


def _hash(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


def tables(args: Arguments, result: dict[str, Any]) -> list[Table]:
    """A table of the stages, and one of our figures beside the paper's."""
    stages = Table("stage", "seconds", "")
    for stage, took in result["seconds"].items():
        stages.add(stage, took, "by an earlier run" if stage in result["skipped"] else "")
    if args.dataset is Dataset.KITTI:
        return [stages, kitti_table(result["ours"], args.fraction)]
    return [stages, sunrgbd_table(result["ours"], classes_of(args.dataset, args.classes))]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
