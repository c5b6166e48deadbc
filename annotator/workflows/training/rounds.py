"""What a training of the view detector starts from, how long its parts are, and which detector is used afterwards.

The reviewed objects on held-out frames decide (`training.held_out`). With too few of them the base detector stays; in
an installation without it, the newest detector is used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from annotator.detection.base_detector import has_base
from annotator.detection.config import TrainingConfig
from annotator.detection.manifest import read_manifest
from annotator.detection.trained import read_trained
from annotator.project import Project, StoredModel
from annotator.types import DetectorKind
from annotator.types.errors import FormatError
from annotator.workflows.detectors import UsedModel, base_model, own_model
from annotator.workflows.training.base_detector import BASE_TRAINING
from annotator.workflows.training.held_out import MIN_OBJECTS, Decision, HeldOut, Rival, held_out_groups

# View size of a detector that starts from published or random weights, unless another one is configured, pixels.
DEFAULT_VIEW_PX = 64
# Length of a training that starts from a detector, and of the first part of a longer one, seconds.
FIRST_PART_S = 180.0
# A shorter part is not begun. Drawing the views and measuring count, too.
MIN_PART_S = 45.0
# A detector that knows objects already is changed with care.
LEARNING_RATE, WARMUP_EPOCHS = 0.003, 0.5
# More epochs than any training has.
NEVER = 1_000_000


@dataclass(frozen=True, eq=False)
class Start:
    """What a training starts from.

    Attributes:
        model: None for the published or random weights of the configuration.
        compared: the candidates by their mean IoU on the held-out objects; empty with too few objects.
    """

    model: UsedModel | None
    compared: tuple[Rival, ...] = ()

    def view_px(self, config: TrainingConfig) -> int:
        """Longer side of the views to train on: that of the detector at the start, or the configured one."""
        return config.image_size_px if self.model is None else read_trained(self.model.path.parent).image_size_px


def choose_start(project: Project, held_out: HeldOut, config: TrainingConfig) -> Start:
    """The best known detector: the project's active one, its newest one, or the base detector.

    Too few held-out objects leave it to the order: active detector, base detector, newest detector. Weights or a
    network that the configuration names come first.
    """
    if config.pretrained != "auto":
        return Start(None)
    known = [model for model in _candidates(project) if _fits(model, config)]
    if not known:
        return Start(None)
    if not held_out.decides:
        return Start(known[0])
    ious = {model: held_out.mean_iou(model) for model in known if not _has_learned(project, model)}
    compared = tuple(Rival(name=model.described, mean_iou=iou) for model, iou in ious.items())
    return Start(max(ious, key=ious.__getitem__) if ious else known[0], compared)


def part_seconds(minutes: float) -> Iterator[float]:
    """The lengths of the parts of a training: at most three minutes first, then each twice as long."""
    left, part = minutes * 60, FIRST_PART_S
    while left > 0:
        # what would be left for a last part that is too short belongs to this one
        length = part if left - part >= MIN_PART_S else left
        yield length
        left, part = left - length, 2 * part


def starting_config(config: TrainingConfig, start: UsedModel, seconds: float | None, seed: int) -> TrainingConfig:
    """The settings of a part that continues a detector.

    Args:
        seconds: of training; None: as many epochs as configured.
    """
    changes = {
        "pretrained": start.path,
        "seconds": seconds,
        "learning_rate": LEARNING_RATE,
        "augmentation": config.augmentation or BASE_TRAINING.augmentation,
        "batch": BASE_TRAINING.batch,
        "warmup_epochs": WARMUP_EPOCHS,
        # the held-out objects decide about the result of a part, not the views of its validation
        "measure_every": None if seconds is None else NEVER,
        "seed": seed,
    }
    return config.model_copy(update=changes)


@dataclass(eq=False)
class Choice:
    """Decides after each part of a training which detector the project uses.

    Attributes:
        start: what the training started from.
        decides: False: each new detector is used, whatever the held-out objects say.
        best: the best detector so far; None before the first one of a training from published or random weights.
        best_iou: of the best detector; None with too few objects.
    """

    project: Project
    held_out: HeldOut
    start: Start
    decides: bool = True
    best: UsedModel | None = field(init=False)
    best_iou: float | None = field(init=False)

    def __post_init__(self) -> None:
        self.best = self.start.model
        self.best_iou = max((rival.mean_iou for rival in self.start.compared), default=None)

    def add(self, model: StoredModel, note: str) -> Decision:
        """Measures a new detector, activates it or another one, and stores the reasons beside its weights.

        Args:
            note: what its training started from, for people.

        Raises:
            DetectionError, FormatError: it cannot be measured.
        """
        new = own_model(self.project, model)
        iou = self.held_out.mean_iou(new) if self.held_out.decides else None
        is_better = iou is not None and (self.best_iou is None or iou > self.best_iou)
        if not self.decides:
            used, reason = new, "put into use without a measurement, as asked for"
        elif iou is None and has_base() and self.project.models.active(DetectorKind.VIEW) is None:
            used = base_model()
            reason = f"fewer than {MIN_OBJECTS} reviewed objects on held-out frames: the base detector stayed in use"
        elif iou is None:
            used, reason = (
                new,
                f"fewer than {MIN_OBJECTS} reviewed objects on held-out frames: put into use as the newest",
            )
        elif is_better or self.best is None:
            used, reason = new, "the best one on held-out frames: put into use"
        else:
            used, reason = self.best, f"no better on held-out frames: the {self.best.described} stayed in use"
        if is_better or self.best is None or iou is None:
            self.best, self.best_iou = new, iou
        self._use(used, model)
        decision = Decision(
            objects=self.held_out.objects,
            frames=self.held_out.frames,
            mean_iou=iou,
            compared=self.start.compared,
            started_from=note,
            outcome=reason,
        )
        decision.write(model.path.parent)
        return decision

    def _use(self, used: UsedModel, new: StoredModel) -> None:
        if used.name:
            self.project.models.deactivate(DetectorKind.VIEW)
            return
        known = {model.path: model.id for model in self.project.models.all(DetectorKind.VIEW)}
        self.project.models.activate(known.get(used.path, new.id))


def _candidates(project: Project) -> list[UsedModel]:
    models = project.models.all(DetectorKind.VIEW)
    active = [own_model(project, model) for model in models if model.active]
    newest = [own_model(project, model) for model in models[-1:]]
    base = [base_model()] if has_base() else []
    return list(dict.fromkeys(active + base + newest))


def _fits(model: UsedModel, config: TrainingConfig) -> bool:
    """Whether its network is the configured one; any view size fits the default size. An unreadable one never fits."""
    try:
        trained = read_trained(model.path.parent)
    except FormatError:
        return False
    sizes = (DEFAULT_VIEW_PX, trained.image_size_px)
    return model.path.is_file() and trained.config.model == config.model and config.image_size_px in sizes


def _has_learned(project: Project, model: UsedModel) -> bool:
    """Whether a detector of an earlier version was trained on frames that are held out now."""
    if model.manifest is None:
        return False
    try:
        entries = read_manifest(model.manifest.parent).entries
    except FormatError:
        return False
    held = held_out_groups(project)
    return any(entry.split == "train" and entry.group in held for entry in entries)
