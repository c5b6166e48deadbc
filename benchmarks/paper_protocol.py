"""The stages of the paper's protocol, run in an ordinary project."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from annotator.detection.training import TrainingProgress
from annotator.project import Project, ProjectSettings, Status, create_project, open_project
from annotator.recordings import Recording, open_recording
from annotator.types import DetectorKind
from annotator.types.errors import ConfigError
from annotator.types.messages import amount
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import active_detectors
from annotator.workflows.evaluating.evaluate_files import Protocol
from annotator.workflows.evaluating.evaluate_project import Choice, Measured, evaluate_project
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.recorded.boxes_from_3d import boxes_from_3d
from annotator.workflows.recorded.labelled_frames import labels_beside
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.train import TrainPlan, train
from benchmarks.paper_frames import FrameSplit, labelled_classes, link_frames
from benchmarks.paper_settings import Dataset
from benchmarks.paper_stages import Facts, Stages
from benchmarks.paper_tables import kitti_ap, sunrgbd_ap

# The names of the project's two recordings.
TRAIN, VAL = "train", "val"


@dataclass(frozen=True)
class Place:
    """The folders of one run.

    Attributes:
        work: the folder of all runs.
        name: name of this run's project, frames and records.
    """

    work: Path
    name: str

    @property
    def project(self) -> Path:
        return self.work / "projects" / self.name

    @property
    def frames(self) -> Path:
        return self.work / "frames" / self.name

    @property
    def records(self) -> Path:
        return self.work / "stages" / self.name


def import_frames(
    recording: Recording, split: FrameSplit, place: Place, classes: tuple[str, ...], view_px: int
) -> Facts:
    """The stage `import`: creates two recordings of links to the frames, and a project with both.

    Args:
        view_px: longer side of the project's pseudo-views, pixels.
    """
    for side, keys in ((TRAIN, split.train), (VAL, split.val)):
        link_frames(recording, keys, place.frames / side)
    if not place.project.is_dir():
        settings = ProjectSettings(rcv={"view": {"size_px": view_px}})
        create_project(place.project.parent, place.name, classes, settings=settings).close()
    with open_project(place.project) as project:
        for side in (TRAIN, VAL):
            register_recording(project, open_recording(place.frames / side), name=side)
    return {"train": len(split.train), "val": len(split.val), "divided": split.source, "lists": split.coverage()}


@dataclass(frozen=True, eq=False)
class ProjectStages:
    """The stages after the import, in the project.

    Attributes:
        log: called with a line of text for each epoch.
    """

    project: Project
    dataset: Dataset
    fraction: float
    seed: int
    plan: TrainPlan
    options: Facts
    stages: Stages
    log: Callable[[str], None]

    def run(self) -> Facts:
        """Runs all stages; returns the result of the last, `kitti_ap` or `sunrgbd_ap`."""
        self.stages.run("boxes", {"fraction": self.fraction, "seed": self.seed}, self.boxes)
        for role in (DetectorKind.IMAGE, DetectorKind.VIEW):
            config = self.plan.image if role is DetectorKind.IMAGE else self.plan.view
            settings: Facts = {"config": config.model_dump(mode="json")}
            self.stages.run(f"train-{role.value}", settings, partial(self.train, role), self.is_trained)
        # a run with other settings may have activated its models
        for role in (DetectorKind.IMAGE, DetectorKind.VIEW):
            number = self.stages.done[f"train-{role.value}"].result["model"]
            assert isinstance(number, int)  # written by `train`
            self.project.models.activate(number)
        self.stages.run("propose", self.options, self.propose, self.is_latest)
        return self.stages.run("evaluate", {}, self.evaluate)

    def _recording(self, side: str) -> int:
        return self.project.recordings.find(side).id

    def boxes(self) -> Facts:
        """Creates 2D boxes from the 3D boxes on the training frames."""
        labels = labels_beside(self.project, [self._recording(TRAIN)])
        done = boxes_from_3d(self.project, labels, fraction=self.fraction, seed=self.seed)
        return {
            "frames": done.frames,
            "image_boxes": dict(done.image_boxes),
            "objects": dict(done.objects),
            "views": self._views(),
            "view_boxes": done.view_boxes,
            "without_views": dict(done.without_views),
            "outside": dict(done.outside),
            "hidden": dict(done.hidden),
            "other_classes": dict(done.other_classes),
            "drawn": done.drawn,
            "unreadable": list(done.unreadable),
        }

    def _views(self) -> int:
        """Number of pseudo-views with boxes; two objects with the same image box share the views of the first step."""
        frames = {frame.id for frame in self.project.frames.of([self._recording(TRAIN)])}
        return sum(view.frame_id in frames for view in self.project.boxes.on_views())

    def train(self, role: DetectorKind) -> Facts:
        """Trains one detector; resumes an interrupted training."""
        (trained,) = train(self.project, self.plan, roles=(role,), progress=self._report)
        return {
            "model": trained.model.id,
            "pictures": {"train": trained.manifest.images["train"], "val": trained.manifest.images["val"]},
            "epochs": trained.result.epochs,
            "seconds_in_all_tries": trained.result.seconds,
            "metrics": trained.result.metrics.model_dump(),
            "start": trained.result.note,
            "left_out": list(trained.left_out),
        }

    def is_trained(self, result: Facts) -> bool:
        """Whether the weights of a stored result still exist."""
        return any(m.id == result["model"] and m.path.is_file() for m in self.project.models.all())

    def propose(self) -> Facts:
        """Runs RCV on the test frames.

        Raises:
            ConfigError: a frame failed or was skipped.
        """
        config = rcv_config(self.project, options=self.options)
        done = annotate(self.project, active_detectors(self.project), config, recordings=[self._recording(VAL)])
        if done.failed:
            key, reason = done.failed[0]
            raise ConfigError(
                f"{amount(len(done.failed), 'test frame')} failed, such as {key}: {reason}; without all frames the "
                "scores would be too high, so repair what failed and run the same command again: completed work is kept"
            )
        run = self.project.jobs.all()[-1]
        # includes the frames of an interrupted run
        results = {r.frame_id: r for r in self.project.jobs.results(key=run.key, status=Status.DONE)}
        missing = [f for f in self.project.frames.of([self._recording(VAL)]) if f.id not in results]
        if missing:
            raise ConfigError(
                f"{amount(len(missing), 'test frame was', 'test frames were')} skipped, such as {missing[0].key}, "
                "as finalised or missing; without all frames the scores would be too high, so reopen what is "
                "finalised, or use another --work folder"
            )
        return {
            "run": run.id,
            "frames": len(results),
            "proposals": sum(result.proposals for result in results.values()),
            "seconds_a_frame": sum(result.seconds for result in results.values()) / len(results),
        }

    def is_latest(self, result: Facts) -> bool:
        """Whether the stored result belongs to the latest run. A later run may have had other settings."""
        return result["run"] == self.project.jobs.all()[-1].id

    def evaluate(self) -> Facts:
        """Scores the proposals against the ground truth."""
        choice, protocol = Choice(Measured.PROPOSALS, recordings=(self._recording(VAL),)), Protocol(self.dataset.value)
        if self.dataset is Dataset.SUNRGBD:
            content = evaluate_project(self.project, protocol, choice).content.model_dump(mode="json")
            return sunrgbd_ap(content, self.project.config.classes)
        # KITTI's evaluation omits classes without a detection, and raises an error if there is no detection at all
        proposals = self.stages.done["propose"].result["proposals"]
        content = evaluate_project(self.project, protocol, choice).content.model_dump(mode="json") if proposals else {}
        true_classes = labelled_classes(open_recording(self.project.recordings.find(VAL).path))
        return kitti_ap(content, self.project.config.classes, true_classes)

    def _report(self, role: DetectorKind, step: TrainingProgress) -> None:
        if step.batch == step.batches:
            self.log(f"  {role} epoch {step.epoch}/{step.epochs}: {step.seconds:.0f} s")
