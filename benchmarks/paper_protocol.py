"""The stages of the paper's protocol, run in an ordinary project."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from pydantic import BaseModel, ConfigDict, JsonValue, ValidationError

from annotator.fenced_files import read_mat
from annotator.files import new_folder
from annotator.formats.kitti_rows import read_rows
from annotator.formats.reading import write_text
from annotator.project import Project, ProjectSettings, Status, create_project, open_project
from annotator.recordings import Recording, open_recording
from annotator.recordings.sunrgbd import SunRgbdScenes
from annotator.types import DetectorKind
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import amount
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import active_detectors
from annotator.workflows.evaluate import Measured, Options, Protocol, evaluate_project, read_frame_names
from annotator.workflows.importing import Note
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.recorded.boxes_from_3d import boxes_from_3d, share_of
from annotator.workflows.recorded.own_labels import RecordedLabels
from annotator.workflows.recorded.reading import TRACKING, frame_number, label_file
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.train import TrainPlan, train
from benchmarks.paper_tables import Dataset, kitti_ap, sunrgbd_ap
from benchmarks.report import print_epoch

# By format: the folders with one file per frame, and the files that all frames share.
LAYOUTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "kitti_object": (("image_2", "velodyne", "calib", "label_2"), ()),
    "kitti_tracking": (("image_02", "velodyne"), ("calib.txt", "label_02.txt")),
    "sunrgbd_extracted": (("image", "calib", "depth", "points", "label"), ()),
    "sunrgbd_scenes": ((), ()),
}
TRAIN_SHARE = 0.5
# VoteNet pads frame numbers to this width in file names, but not in its lists.
VOTENET_DIGITS = 6
# The toolbox's list of all scenes takes about a megabyte.
MOST_LIST_BYTES = 2**26


@dataclass(frozen=True)
class FrameSplit:
    """Sorted frame keys for training and for testing, which overlap only if the recording has a single frame.

    `source` says where the split comes from; `listed` is the number of frames in the lists, None without lists, and
    `present` the number of those that the recording has.
    """

    train: tuple[str, ...]
    val: tuple[str, ...]
    source: str
    listed: int | None = None
    present: int = 0

    def coverage(self) -> str:
        """How many of the listed frames the recording has, in words; "" without lists."""
        return "" if self.listed is None else f"{self.present} of {self.listed} listed frames are present"

    def limited(self, limit: int | None, seed: int) -> FrameSplit:
        """The split with at most `limit` frames on each side, drawn at random."""
        if limit is None:
            return self
        return replace(self, train=_drawn(self.train, limit, seed), val=_drawn(self.val, limit, seed))


def split_of(recording: Recording, seed: int) -> FrameSplit:
    """The split by the data set's own lists if they lie beside it, else a random one.

    KITTI: `ImageSets/train.txt` and `val.txt`. SUN RGB-D: VoteNet's `train_data_idx.txt` and `val_data_idx.txt`, or the
    toolbox's `allsplit.mat`.
    """
    if recording.format not in LAYOUTS:
        raise ConfigError(
            f"{recording.path}: has the format {recording.format}; give the root of KITTI's or SUN RGB-D's frames"
        )
    lists = _own_lists(recording)
    if lists is not None:
        source, train, val = lists
        both = sorted(set(train).intersection(val))
        if both:
            raise ConfigError(
                f"{source}: {amount(len(both), 'frame is', 'frames are')} in the training list and in the test list, "
                f"such as {both[0]}; each frame must be in one list only"
            )
        present = set(recording.keys)
        sides = tuple(sorted(present.intersection(train))), tuple(sorted(present.intersection(val)))
        if not all(sides):
            raise ConfigError(f"{source}: lists no {'test' if sides[0] else 'training'} frame of {recording.path}")
        return FrameSplit(*sides, str(source), len({*train, *val}), sum(map(len, sides)))
    if len(recording) == 1:
        return FrameSplit(recording.keys, recording.keys, "a single frame, for training and testing")
    drawn = _drawn(recording.keys, max(round(TRAIN_SHARE * len(recording)), 1), seed)
    others = tuple(sorted(set(recording.keys).difference(drawn)))
    return FrameSplit(drawn, others, f"random split (no lists found), seed {seed}")


def labelled_classes(recording: Recording) -> frozenset[str]:
    """The classes of a KITTI recording's labels, including small and occluded objects."""
    classes: set[str] = set()
    for key in recording.keys:
        file = label_file(recording, key)
        if file is None or not file.is_file():
            continue
        # the numbers of the frames in a file of all frames
        numbers = {None, *(frame_number(file, each) for each in recording.keys if recording.format == TRACKING)}
        rows = read_rows(file, tracking=recording.format == TRACKING)
        classes.update(row.label for row in rows if row.frame in numbers)
        if recording.format == TRACKING:
            break
    return frozenset(classes)


def link_frames(recording: Recording, keys: Sequence[str], folder: Path) -> None:
    """Creates a folder of links to the frames' files, in the recording's layout; on failure, the folder is removed."""
    folders, files = LAYOUTS[recording.format]
    with new_folder(folder, lambda _: True) as out:
        if isinstance(recording, SunRgbdScenes):
            _link(folder, ((recording.scene(key), out / key) for key in keys))
            return
        stems = set(keys)
        for name in folders:
            source = recording.root / name
            if source.is_dir():
                (out / name).mkdir()
                paths = (path for path in sorted(source.iterdir()) if path.stem in stems)
                _link(folder, ((path, out / name / path.name) for path in paths))
        _link(folder, ((recording.root / name, out / name) for name in files if (recording.root / name).is_file()))


def _link(folder: Path, pairs: Iterable[tuple[Path, Path]]) -> None:
    try:
        for source, link in pairs:
            link.symlink_to(source.resolve())
    except OSError as error:
        raise FormatError(folder, f"cannot create links to the frames ({error.strerror})") from error


def _drawn(keys: Sequence[str], number: int, seed: int) -> tuple[str, ...]:
    if number >= len(keys):
        return tuple(keys)
    return tuple(sorted(key for _, key in share_of([("", key) for key in keys], number / len(keys), seed)))


def _own_lists(recording: Recording) -> tuple[Path, list[str], list[str]] | None:
    """Path of the training list, the training keys and the test keys; None without lists."""
    root = recording.root
    for folder in (root, root.parent):
        train, val = (folder / "ImageSets" / f"{side}.txt" for side in ("train", "val"))
        if train.is_file() and val.is_file():
            return train, read_frame_names(train), read_frame_names(val)
        train, val = (folder / f"{side}_data_idx.txt" for side in ("train", "val"))
        if train.is_file() and val.is_file():
            keys = [[number.zfill(VOTENET_DIGITS) for number in read_frame_names(path)] for path in (train, val)]
            return train, keys[0], keys[1]
        for path in (folder / "allsplit.mat", folder / "SUNRGBDtoolbox" / "traintestSUNRGBD" / "allsplit.mat"):
            if isinstance(recording, SunRgbdScenes) and path.is_file():
                return (path, *_toolbox_lists(path))
    return None


def _toolbox_lists(path: Path) -> tuple[list[str], list[str]]:
    """Training and test keys from the toolbox's cell arrays `alltrain` and `alltest`, which list paths of scenes."""
    try:
        train, test = (read_mat(path, name, MOST_LIST_BYTES) for name in ("alltrain", "alltest"))
    except (OSError, ValueError) as error:
        raise FormatError(path, f"the list of scenes cannot be read ({error})") from error
    if not isinstance(train, list) or not isinstance(test, list):
        raise FormatError(path, "alltrain and alltest are not lists of scenes")
    return [_scene_key(str(scene)) for scene in train], [_scene_key(str(scene)) for scene in test]


def _scene_key(path: str) -> str:
    return path.replace("\\", "/").partition("SUNRGBD/")[2].strip("/").replace("/", "__")


Facts = Mapping[str, JsonValue]


class StageRecord(BaseModel):
    """A completed stage; its settings are all on which the result depends, `after` is the key of the previous stage."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: str
    settings: dict[str, JsonValue]
    seconds: float
    result: dict[str, JsonValue]


@dataclass
class Stages:
    """Runs stages one after the other; each depends on its settings and on all previous stages.

    If a stage runs, all later stages run as well, even if they have a record.

    `folder` has a record for each stage and settings, `done` those so far, `skipped` the stages that an earlier run
    completed. `log` gets a line of text when a stage starts, ends or is skipped.
    """

    folder: Path
    log: Callable[[str], None]
    done: dict[str, StageRecord] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    _last: str = ""

    def run(
        self, stage: str, settings: Facts, work: Callable[[], Facts], is_kept: Callable[[Facts], bool] | None = None
    ) -> Facts:
        """Runs a stage, or returns its result from an earlier run.

        `settings` is all on which the result depends besides the previous stages. `work` must resume or restart after
        an interrupted run. `is_kept` tells whether the files or rows that an earlier result refers to still exist.
        """
        all_settings = {**settings, "after": self._last}
        key = hashlib.sha256(json.dumps([stage, all_settings], sort_keys=True).encode()).hexdigest()[:12]
        path = self.folder / f"{stage}-{key}.json"
        record = _read(path)
        all_before = len(self.skipped) == len(self.done)
        if record is not None and all_before and (is_kept is None or is_kept(record.result)):
            self.skipped.append(stage)
            self.log(f"{stage}: already done (took {record.seconds:.1f} s)")
        else:
            self.log(f"{stage} ...")
            begin = time.perf_counter()
            result = dict(work())
            seconds = time.perf_counter() - begin
            record = StageRecord(stage=stage, settings=all_settings, seconds=seconds, result=result)
            self.folder.mkdir(parents=True, exist_ok=True)
            write_text(path, record.model_dump_json(indent=1))
            self.log(f"{stage}: {seconds:.1f} s")
        self.done[stage], self._last = record, key
        return record.result


def _read(path: Path) -> StageRecord | None:
    if not path.is_file():
        return None
    try:
        return StageRecord.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"not a record of a stage ({error}); delete it to run the stage again") from error


# The names of the project's two recordings.
TRAIN, VAL = "train", "val"


def import_frames(
    recording: Recording, split: FrameSplit, project_path: Path, frames: Path, classes: tuple[str, ...], view_px: int
) -> Facts:
    """The stage `import`: creates two recordings of links to the frames, and a project with both.

    `view_px` is the longer side of the project's pseudo-views, pixels.
    """
    for side, keys in ((TRAIN, split.train), (VAL, split.val)):
        link_frames(recording, keys, frames / side)
    if not project_path.is_dir():
        settings = ProjectSettings(rcv={"view_px": view_px})
        create_project(project_path.parent, project_path.name, classes, settings=settings).close()
    with open_project(project_path) as project:
        for side in (TRAIN, VAL):
            register_recording(project, open_recording(frames / side), name=side)
    return {"train": len(split.train), "val": len(split.val), "divided": split.source, "lists": split.coverage()}


@dataclass(frozen=True, eq=False)
class ProjectStages:
    """The stages after the import, in the project."""

    project: Project
    dataset: Dataset
    fraction: float
    seed: int
    plan: TrainPlan
    options: Facts
    stages: Stages

    def run(self) -> Facts:
        """Runs all stages; returns the result of the last, `kitti_ap` or `sunrgbd_ap`."""
        self.stages.run("boxes", {"fraction": self.fraction, "seed": self.seed}, self.boxes)
        for role in (DetectorKind.IMAGE, DetectorKind.VIEW):
            config = self.plan.image if role is DetectorKind.IMAGE else self.plan.view
            settings: Facts = {"config": config.model_dump(mode="json")}
            self.stages.run(f"train-{role.value}", settings, partial(self.train, role), self._has_weights)
        # a run with other settings may have activated its models
        for role in (DetectorKind.IMAGE, DetectorKind.VIEW):
            number = self.stages.done[f"train-{role.value}"].result["model"]
            assert isinstance(number, int)  # written by `train`
            self.project.models.activate(number)
        # a later run may have had other settings
        self.stages.run(
            "propose", self.options, self.propose, lambda result: result["run"] == self.project.jobs.all()[-1].id
        )
        return self.stages.run("evaluate", {}, self.evaluate)

    def _recording(self, side: str) -> int:
        return self.project.recordings.find(side).id

    def boxes(self) -> Facts:
        """Creates 2D boxes from the 3D boxes on the training frames."""
        labels = RecordedLabels(self.project, [self._recording(TRAIN)], with_files=True)
        done = boxes_from_3d(self.project, labels, fraction=self.fraction, seed=self.seed)
        # two objects with the same image box share the views of the first step
        frames = {frame.id for frame in self.project.frames.of([self._recording(TRAIN)])}
        return {
            "frames": done.frames,
            "image_boxes": dict(done.boxes),
            "objects": dict(done.objects),
            "views": sum(view.frame_id in frames for view in self.project.boxes.on_views()),
            "view_boxes": done.view_boxes,
            "without_views": dict(done.of(Note.WITHOUT_VIEWS)),
            "outside": dict(done.of(Note.OUTSIDE)),
            "hidden": dict(done.of(Note.HIDDEN)),
            "other_classes": dict(done.of(Note.OTHER_CLASS)),
            "drawn": done[Note.DRAWN],
            "unreadable": list(done.of(Note.UNREADABLE)),
        }

    def train(self, role: DetectorKind) -> Facts:
        """Trains one detector; resumes an interrupted training."""
        (trained,) = train(self.project, self.plan, roles=(role,), progress=print_epoch)
        return {
            "model": trained.model.id,
            "pictures": {"train": trained.manifest.images["train"], "val": trained.manifest.images["val"]},
            "epochs": trained.result.epochs,
            "seconds_in_all_tries": trained.result.seconds,
            "metrics": trained.result.metrics.model_dump(),
            "start": trained.result.note,
            "left_out": list(trained.left_out),
        }

    def _has_weights(self, result: Facts) -> bool:
        return any(m.id == result["model"] and m.path.is_file() for m in self.project.models.all())

    def propose(self) -> Facts:
        """Runs RCV on the test frames."""
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
        results = {r.frame_id: r for r in self.project.jobs.results(Status.DONE) if r.key == run.key}
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

    def evaluate(self) -> Facts:
        """Scores the proposals against the ground truth."""
        protocol = Protocol(self.dataset.value)
        options = Options(measured=Measured.PROPOSALS, recordings=(self._recording(VAL),))
        if self.dataset is Dataset.SUNRGBD:
            content = evaluate_project(self.project, protocol, options).content.model_dump(mode="json")
            return sunrgbd_ap(content, self.project.config.classes)
        # KITTI's evaluation omits classes without a detection, and raises an error if there is no detection at all
        proposals = self.stages.done["propose"].result["proposals"]
        content = evaluate_project(self.project, protocol, options).content.model_dump(mode="json") if proposals else {}
        true_classes = labelled_classes(open_recording(self.project.recordings.find(VAL).path))
        return kitti_ap(content, self.project.config.classes, true_classes)
