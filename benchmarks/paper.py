"""The paper's tables, from a data set to the figures: 2D boxes from 3D ones, both trainings, RCV, official AP.

    python -m benchmarks.paper kitti --root KITTI --fraction 0.25 [--settings product] [--limit 20] [--json]
    python -m benchmarks.paper sunrgbd --root SUNRGBD [--classes votenet] [--settings product] [--limit 20] [--json]

Each stage leaves its result in --work; what is complete there, with the same settings, is not done again. The project
in `--work/projects` is one like any other: `annotator serve --root WORK/projects` shows its boxes and proposals.
docs/paper.md says what each stage does and how long it takes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, cast

import tyro
from pydantic import JsonValue, ValidationError
from rich.console import Console

from annotator.project import open_project
from annotator.rcv.config import Strategy
from annotator.recordings import open_recording
from annotator.types.errors import ConfigError
from annotator.workflows.train import TrainPlan
from benchmarks.paper_frames import split_of
from benchmarks.paper_protocol import InProject, Place, bring_in
from benchmarks.paper_settings import Classes, Dataset, Preset, Trainings, classes_of, rcv_options
from benchmarks.paper_stages import Stages
from benchmarks.paper_tables import Ap, kitti_table, paper_of_kitti, paper_of_sunrgbd, sunrgbd_table
from benchmarks.report import Table, finish, guarded

QUIET = Console(stderr=True, highlight=False, markup=False)


@dataclass
class Arguments:
    """One row of the paper's Tab. III (KITTI) or Tab. II (SUN RGB-D)."""

    dataset: Annotated[Dataset, tyro.conf.Positional]
    """Which benchmark."""
    root: Path
    """The data set's frames with their labels: KITTI (or its training/), SUN RGB-D as VoteNet extracts it, or its raw
    scenes."""
    work: Path = Path("out/paper")
    """Where the stages leave their results."""
    fraction: float = 1.0
    """Share of the frames to learn from; the paper has 0.25, 0.5 and 0.8 of KITTI."""
    settings: Preset = Preset.PRODUCT
    """What is trained: paper = YOLOv5x6 at 640 px for 300 epochs, needs a GPU; product = annotator's defaults."""
    axes: Strategy | None = None
    """How projection axes are found; default: normals with --settings paper, else consensus."""
    classes: Classes = Classes.PAPER
    """SUN RGB-D: which ten classes."""
    limit: int | None = None
    """At most so many frames to learn from, and so many to try."""
    seed: int = 0
    """Of the choice of frames and of the trainings."""
    model: str | None = None
    """Another detection model for both."""
    weights: str = "auto"
    """To start from: auto = published ones where they can be had; never; or a file."""
    epochs: int | None = None
    """Of the pseudo-view detector, in place of the settings'."""
    image_epochs: int | None = None
    """Of the image detector."""
    size: int | None = None
    """Side of the pseudo-views in training, pixels."""
    image_size: int | None = None
    """Longer side of the camera images in training, pixels."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""

    @property
    def trainings(self) -> Trainings:
        """The settings of both trainings."""
        return Trainings(self.settings, self.model, self.epochs, self.image_epochs, self.size, self.image_size)

    def plan(self) -> TrainPlan:
        """The trainings.

        Raises:
            ConfigError: a setting out of its range.
        """
        chosen = {
            "pretrained": self.weights if self.weights in ("auto", "never") else Path(self.weights),
            "seed": self.seed,
        }
        try:
            image, view = (
                type(config).model_validate({**config.model_dump(), **chosen})
                for config in (self.trainings.image, self.trainings.view)
            )
        except ValidationError as error:
            problem = error.errors()[0]
            raise ConfigError(f"{problem['loc'][0]}: {problem['msg']}, not {problem['input']}") from error
        return TrainPlan(image=image, view=view, seed=self.seed)


def run(args: Arguments) -> dict[str, object]:
    """The whole protocol; what `--json` prints.

    Raises:
        ConfigError: arguments that contradict each other or the data set; frames to try that could not be.
        AnnotatorError: of the stages.
    """
    if args.limit is not None and args.limit < 1:
        raise ConfigError(f"a limit of {args.limit} frames leaves nothing to do; give 1 or more")
    plan, classes = args.plan(), classes_of(args.dataset, args.classes)
    recording = open_recording(args.root)
    split = split_of(recording, args.seed).limited(args.limit, args.seed)
    QUIET.print(": ".join(filter(None, (split.source, split.found()))))
    start: dict[str, JsonValue] = {
        "dataset": args.dataset.value,
        "root": str(args.root.resolve()),
        "train": _hash(list(split.train)),
        "val": _hash(list(split.val)),
        "classes": list(classes),
        "view_px": args.trainings.view_px,
    }
    # other boxes than those of this share shall not be in the project
    share = {"fraction": args.fraction, "seed": args.seed}
    place = Place(args.work, f"{args.dataset.value}-{100 * args.fraction:.0f}-{_hash({**start, **share})}")
    stages = Stages(place.records, QUIET.print)
    stages.run(
        "import",
        start,
        lambda: bring_in(recording, split, place, classes, args.trainings.view_px),
        lambda _: place.project.is_dir() and place.frames.is_dir(),
    )
    options = rcv_options(args.dataset, args.axes, args.settings)
    with open_project(place.project) as project:
        rest = InProject(project, args.dataset, args.fraction, args.seed, plan, options, stages, QUIET.print)
        ours = rest.run()
    return {
        "dataset": args.dataset.value,
        "fraction": args.fraction,
        "settings": args.settings.value,
        "axes": options["strategy"],
        "project": str(place.project),
        "skipped": stages.skipped,
        "seconds": {stage: record.seconds for stage, record in stages.done.items()},
        "stages": {stage: record.result for stage, record in stages.done.items() if stage != "evaluate"},
        "ours": dict(ours),
        "paper": paper_of_kitti(args.fraction) if args.dataset is Dataset.KITTI else paper_of_sunrgbd(),
    }


def _hash(content: JsonValue | Mapping[str, JsonValue] | list[str]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


def tables(args: Arguments, result: Mapping[str, object]) -> list[Table]:
    """The stages, and our figures with the paper's beside them."""
    seconds, skipped = cast("dict[str, float]", result["seconds"]), cast("list[str]", result["skipped"])
    stages = Table("stage", "seconds", "")
    for stage, took in seconds.items():
        stages.add(stage, took, "by an earlier run" if stage in skipped else "")
    if args.dataset is Dataset.KITTI:
        return [stages, kitti_table(cast(Ap, result["ours"]), args.fraction)]
    ours = cast("dict[str, dict[str, JsonValue]]", result["ours"])
    return [stages, sunrgbd_table(ours, classes_of(args.dataset, args.classes))]


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__, config=(tyro.conf.EnumChoicesFromValues,))
    result = run(args)
    finish(result, args.json, *tables(args, result))


if __name__ == "__main__":
    guarded(main)
