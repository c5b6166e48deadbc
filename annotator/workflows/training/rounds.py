"""What a training of the view detector starts from, how long its parts are, and which detector is used afterwards.

The reviewed objects on held-out frames decide (`training.held_out`). With too few such objects, what was in use stays
in use; if there is no base detector, the newest detector is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

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
from annotator.workflows.training.held_out import FOUND_NONE, MIN_OBJECTS, Decision, HeldOut, Rival, held_out_groups
from annotator.workflows.training.model_report import write_found_boxes

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
    if has_learned(project, last) or not _fits(last, config, any_size=False):
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
    """Decides what a training starts from, and after each part which detector the project uses.

    It starts from the best known detector: the project's active one, its newest one, or the base detector. Too few
    held-out objects leave it to the order: active detector, base detector, newest detector. Weights or a network that
    the configuration names come first. A detector that has learned held-out frames is no candidate, since what starts
    from it would know them, too.

    Attributes:
        origin: what the next part starts from: the best detector of this training; None = published or random weights.
        ious: mean IoU on the held-out objects of each measured detector, whether a training with these settings can
            start from it or not; empty with too few objects.
        compared: those that were measured at the start, for people.
        left_out: messages on detectors that could not be measured.
        view_px: longer side of the views to train on: that of the detector at the start, or the configured one.
    """

    def __init__(self, project: Project, held_out: HeldOut, config: TrainingConfig) -> None:
        self.project, self.held_out = project, held_out
        known = [model for model in _candidates(project) if not has_learned(project, model)]
        self.ious: dict[UsedModel, float] = {}
        self.left_out: list[str] = []
        for model in known if held_out.decides else ():
            try:
                self.ious[model] = held_out.mean_iou(model)
            except TrainingStoppedError:
                raise
            except (DetectionError, FormatError) as error:
                self.left_out.append(f"the {model.described}, which cannot be measured: {error}")
        able = self.ious if held_out.decides else known
        fitting = [model for model in able if config.pretrained == "auto" and _fits(model, config, any_size=True)]
        # without measurements, the first one
        self.origin = max(fitting, key=lambda model: self.ious.get(model, 0.0), default=None)
        self.compared = tuple(Rival(name=model.described, mean_iou=iou) for model, iou in self.ious.items())
        trained = None if self.origin is None else read_trained(self.origin.path.parent)
        self.view_px = config.image_size_px if trained is None else trained.image_size_px
        self._reviewed = project.labels.count(REVIEWED)
        # what the project used at the start, or since the last decision
        self._in_use = used_model(project, DetectorKind.VIEW)

    def part_anew(self, lengths: Sequence[float]) -> int | None:
        """The part that starts from published or random weights, with the project's classes; None if there is none.

        Such a detector is better than one that continues the base detector for some projects, and much worse for others
        (docs/detector_training.md). So it is tried only where held-out objects decide.
        """
        if self.origin is None or not self.held_out.decides:
            return None
        return next((part for part, length in enumerate(lengths) if length >= ANEW_S), None)

    def add(self, model: StoredModel, note: str) -> Decision:
        """Measures a new detector, activates it or another one, and stores the reasons beside its weights.

        A detector that was chosen by hand during the training stays in use.
        """
        new = own_model(self.project, model)
        iou = self.held_out.mean_iou(new) if self.held_out.decides else None
        if iou is not None:
            write_found_boxes(self.held_out.found, model.path.parent)
        best = max(self.ious, key=self.ious.__getitem__, default=None)
        few = f"fewer than {MIN_OBJECTS} reviewed objects on held-out frames"
        used: UsedModel | None = None  # what is in use stays
        if used_model(self.project, DetectorKind.VIEW) != self._in_use:
            outcome = "another detector was chosen during the training: it stayed in use"
        elif iou is None and has_base():
            outcome = f"{few}: what was in use stayed in use"
        elif iou is None:
            used, outcome = new, f"{few}: put into use as the newest"
        elif iou == 0:
            outcome = f"{FOUND_NONE}: not put into use"
        elif best is None:
            used, outcome = new, "put into use: there was no detector to compare it with on held-out frames"
        elif iou > self.ious[best]:
            used, outcome = new, "the best one on held-out frames: put into use"
        else:
            used, outcome = best, f"no better on held-out frames: the {best.described} stayed in use"
        if iou is None or self.origin is None or iou > self.ious.get(self.origin, -1.0):
            self.origin = new
        if iou is not None:
            self.ious[new] = iou
        self._use(used)
        decision = Decision(
            objects=self.held_out.objects,
            frames=self.held_out.frames,
            mean_iou=iou,
            compared=self.compared,
            started_from=note,
            outcome=outcome,
            reviewed=self._reviewed,
        )
        decision.write(model.path.parent)
        return decision

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


def has_learned(project: Project, model: UsedModel) -> bool:
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
