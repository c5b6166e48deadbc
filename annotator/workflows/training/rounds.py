"""What a training of the view detector starts from, how long its parts are, and which detector is used afterwards.

The reviewed objects on held-out frames decide (`training.held_out`). With too few such objects, what was in use stays
in use; if there is no base detector, the newest detector is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import read_manifest
from annotator.detection.pretrained import has_base
from annotator.detection.trained import read_trained
from annotator.detection.training import TrainingStoppedError
from annotator.project import REVIEWED, Project, StoredModel
from annotator.types import DetectorKind
from annotator.types.errors import DetectionError, FormatError
from annotator.workflows.detectors import UsedModel, base_model, own_model, used_model
from annotator.workflows.training.base_detector import BASE_TRAINING
from annotator.workflows.training.held_out import MIN_OBJECTS, Decision, HeldOut, Rival, held_out_groups

# View size of a detector that starts from published or random weights, unless another one is configured, pixels.
DEFAULT_VIEW_PX = 64
# Length of a training that starts from a detector, and of the first part of a longer one, seconds.
FIRST_PART_S = 180.0
# A shorter part is not begun. This includes the time to draw views and to measure.
MIN_PART_S = 45.0
# The first part of at least this length begins anew. In a shorter one, random weights learn too little. Seconds.
ANEW_S = 600.0
# The rate rises quickly, because a detector that knows objects has no bad beginning.
WARMUP: dict[str, float | str] = {"warmup_epochs": 0.5}
# More epochs than any training has.
NEVER = 1_000_000


@dataclass(frozen=True, eq=False)
class Start:
    """What a training starts from.

    Attributes:
        model: None for the published or random weights of the configuration.
        ious: mean IoU on the held-out objects of each known detector that has not learned them, whether a training
            with these settings can start from it or not; empty with too few objects.
        left_out: messages on detectors that could not be measured.
    """

    model: UsedModel | None
    ious: Mapping[UsedModel, float] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    @property
    def compared(self) -> tuple[Rival, ...]:
        """The measured detectors, for people."""
        return tuple(Rival(name=model.described, mean_iou=iou) for model, iou in self.ious.items())

    def view_px(self, config: TrainingConfig) -> int:
        """Longer side of the views to train on: that of the detector at the start, or the configured one."""
        return config.image_size_px if self.model is None else read_trained(self.model.path.parent).image_size_px


def choose_start(project: Project, held_out: HeldOut, config: TrainingConfig) -> Start:
    """The best known detector: the project's active one, its newest one, or the base detector.

    Too few held-out objects leave it to the order: active detector, base detector, newest detector. Weights or a
    network that the configuration names come first. A detector that has learned held-out frames is no candidate, since
    what starts from it would know them, too.
    """
    known = [model for model in _candidates(project) if not _has_learned(project, model)]
    ious: dict[UsedModel, float] = {}
    left_out = []
    for model in known if held_out.decides else ():
        try:
            ious[model] = held_out.mean_iou(model)
        except TrainingStoppedError:
            raise
        except (DetectionError, FormatError) as error:
            left_out.append(f"the {model.described}, which cannot be measured: {error}")
    able = ious if held_out.decides else known
    fitting = [model for model in able if config.pretrained == "auto" and _fits(model, config, any_size=True)]
    # without measurements, the first one
    best = max(fitting, key=lambda model: ious.get(model, 0.0), default=None)
    return Start(best, ious, tuple(left_out))


def image_config(project: Project, config: TrainingConfig, dataset_sha256: str) -> TrainingConfig:
    """The settings of a training of the image detector, which continues the project's last one if that fits.

    It fits if the settings name no weights, network and image size are the same, and it has not learned held-out
    images. A finished training on the same images with the same settings is not continued, but found again.
    """
    models = project.models.all(DetectorKind.IMAGE)
    newest = [model for model in models if model.active] or models[-1:]
    if config.pretrained != "auto" or not newest:
        return config
    last = own_model(project, newest[0])
    if _has_learned(project, last) or not _fits(last, config, any_size=False):
        return config
    trained = read_trained(last.path.parent)
    continued = config.model_copy(update={"pretrained": last.path, "recipe": config.recipe | WARMUP})
    again = config, continued.model_copy(update={"pretrained": trained.config.pretrained})
    if trained.dataset_sha256 == dataset_sha256 and trained.config in again:
        return trained.config
    return continued


def part_seconds(minutes: float) -> Iterator[float]:
    """The lengths of the parts of a training: at most three minutes first, then each twice as long."""
    left, part = minutes * 60, FIRST_PART_S
    while left > 0:
        # what would be left for a last part that is too short belongs to this one
        length = part if left - part >= MIN_PART_S else left
        yield length
        left, part = left - length, 2 * part


def part_anew(lengths: Sequence[float], start: Start, held_out: HeldOut, config: TrainingConfig) -> int | None:
    """The part that starts from published or random weights, with the project's classes; None if there is none.

    Such a detector is better than one that continues the base detector for some projects, and much worse for others
    (docs/detector_training.md). So it is tried only where held-out objects decide.
    """
    if start.model is None or not held_out.decides or config.pretrained != "auto":
        return None
    return next((part for part, length in enumerate(lengths) if length >= ANEW_S), None)


def starting_config(config: TrainingConfig, start: UsedModel, seconds: float | None, seed: int) -> TrainingConfig:
    """The settings of a part that continues a detector.

    Args:
        seconds: of training; None: as many epochs as configured.
    """
    changes = {
        "pretrained": start.path,
        "seconds": seconds,
        "batch": BASE_TRAINING.batch,
        "recipe": config.recipe | WARMUP,
        # the held-out objects decide about the result of a part, not the views of its validation
        "measure_every": None if seconds is None else NEVER,
        "seed": seed,
    }
    return config.model_copy(update=changes)


class Choice:
    """Decides after each part of a training which detector the project uses.

    Attributes:
        origin: what the next part starts from: the best detector of this training; None before the first one of a
            training from published or random weights.
    """

    def __init__(self, project: Project, held_out: HeldOut, start: Start) -> None:
        self.project, self.held_out, self.start = project, held_out, start
        ious = start.ious
        self.origin = start.model
        # None with too few objects
        self._origin_iou = None if start.model is None else ious.get(start.model)
        # the best detector of all that were measured
        self._best: UsedModel | None = max(ious, key=ious.__getitem__, default=None)
        self._best_iou = max(ious.values(), default=-1.0)
        self._reviewed = project.labels.count(REVIEWED)
        # what the project used at the start, or since the last decision
        self._in_use = used_model(project, DetectorKind.VIEW)

    def add(self, model: StoredModel, note: str) -> Decision:
        """Measures a new detector, activates it or another one, and stores the reasons beside its weights.

        A detector that was chosen by hand during the training stays in use.
        """
        new = own_model(self.project, model)
        iou = self.held_out.mean_iou(new) if self.held_out.decides else None
        used, reason = self._decided(new, iou)
        if self.origin is None or iou is None or self._origin_iou is None or iou > self._origin_iou:
            self.origin, self._origin_iou = new, iou
        if iou is not None and iou > self._best_iou:
            self._best, self._best_iou = new, iou
        self._use(used)
        decision = Decision(
            objects=self.held_out.objects,
            frames=self.held_out.frames,
            mean_iou=iou,
            compared=self.start.compared,
            started_from=note,
            outcome=reason,
            reviewed=self._reviewed,
        )
        decision.write(model.path.parent)
        return decision

    def _decided(self, new: UsedModel, iou: float | None) -> tuple[UsedModel | None, str]:
        """The detector to use, and why; None for the one that is in use.

        Args:
            iou: of the new detector; None with too few objects.
        """
        few = f"fewer than {MIN_OBJECTS} reviewed objects on held-out frames"
        if used_model(self.project, DetectorKind.VIEW) != self._in_use:
            return None, "another detector was chosen during the training: it stayed in use"
        if iou is None and has_base():
            return None, f"{few}: what was in use stayed in use"
        if iou is None:
            return new, f"{few}: put into use as the newest"
        if self._best is None:
            return new, "put into use: there was no detector to compare it with on held-out frames"
        if iou > self._best_iou:
            return new, "the best one on held-out frames: put into use"
        return self._best, f"no better on held-out frames: the {self._best.described} stayed in use"

    def _use(self, used: UsedModel | None) -> None:
        if used is None:
            return
        if used.name:
            self.project.models.deactivate(DetectorKind.VIEW)
        else:
            known = {model.path: model.id for model in self.project.models.all(DetectorKind.VIEW)}
            self.project.models.activate(known[used.path])
        self._in_use = used_model(self.project, DetectorKind.VIEW)


def _candidates(project: Project) -> list[UsedModel]:
    models = project.models.all(DetectorKind.VIEW)
    active = [own_model(project, model) for model in models if model.active]
    newest = [own_model(project, model) for model in models[-1:]]
    base = [base_model()] if has_base() else []
    return list(dict.fromkeys(active + base + newest))


def _fits(model: UsedModel, config: TrainingConfig, any_size: bool) -> bool:
    """Whether its network and image size are the configured ones. An unreadable one never fits.

    Args:
        any_size: whether any view size fits the default one.
    """
    try:
        trained = read_trained(model.path.parent)
    except FormatError:
        return False
    sizes = {trained.image_size_px, *([DEFAULT_VIEW_PX] if any_size else [])}
    return model.path.is_file() and trained.config.model == config.model and config.image_size_px in sizes


def _has_learned(project: Project, model: UsedModel) -> bool:
    """Whether a detector may have been trained on frames that are held out now: unknown training data counts."""
    if model.name:  # the base detector
        return False
    if model.manifest is None:
        return True
    try:
        entries = read_manifest(model.manifest.parent).entries
    except FormatError:
        return True
    held = held_out_groups(project)
    return any(entry.split == "train" and entry.group in held for entry in entries)
