"""3D boxes of objects whose class was never seen, or of which a few were taught, from 2D boxes on the image.

    python -m benchmarks.cold_start DIR [--taught 0 1 5 20] [--upright | --free] [--image-box projected|label]
        [--minutes 3 | --epochs N | --untrained] [--no-sizes]
        [--seed N] [--json]

With `--taught 0` alone, the base detector is tried on all frames. Otherwise the first half of the recording teaches and
the second half is tried, the same for every number. For each number of taught objects of each class, a project with
their 3D boxes trains its view detector as `annotator train` does, except that all frames train and the result is used
whatever held-out frames say. Typical sizes are those of well-known classes and of the taught objects. A class without
that many objects has no row.

`projected` takes the true 3D boxes' outlines, clipped to the image; `label` takes the labels' own 2D boxes, or the
extents of the masks. Both get an error of 2 px on every edge. The rows "<class> (clusters)" guess from geometry alone:
the cluster of points in the middle of the image box, and the tightest box around it.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Float, Float64, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.transform import Rotation

from annotator.detection.config import Backend
from annotator.detection.pretrained import base_weights
from annotator.detection.trained import read_trained
from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import aligned_box, contains
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import in_frustum
from annotator.project import NewLabel, Project, ProjectSettings, WriteContext, create_project
from annotator.rcv.axes import camera_axes
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.first_look import in_middle, width_at
from annotator.rcv.rotations import spread_rotations
from annotator.recordings import Recording, open_recording
from annotator.types import Box2D, BoxKind, Detector, DetectorKind, Frame, OrientedBox, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import load_detector, required_model
from annotator.workflows.frame_source import orientation_for
from annotator.workflows.recorded.reading import has_masks, load_mask, load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.training import held_out, samples
from annotator.workflows.training.held_out import JITTER_PX, inaccurate, lifted
from annotator.workflows.training.train import VIEW_DEFAULTS, TrainPlan, train
from benchmarks.report import BoxOptions, Table, guarded, program, seconds_of

# Points closer than this share of the object's width are connected.
GAP = 0.08
MIN_POINTS = 5
YAWS, ROTATIONS = 45, 600


def cluster_box(frame: Frame, image_box: Box2D, up: Float64[np.ndarray, "3"] | None) -> OrientedBox | None:
    """The tightest box around the connected points with the largest part in the middle of an image box.

    `up` is the unit vector against gravity for an upright box, None for a free one.
    """
    camera = frame.camera
    xyz = frame.cloud.xyz_m[in_frustum(camera, frame.cloud.xyz_m, image_box)].astype(np.float64)
    if len(xyz) < MIN_POINTS:
        return None
    middle = in_middle(camera, xyz, image_box)
    gap = GAP * width_at(camera, image_box, float(np.median(xyz[middle, 2])))
    cells, of = np.unique(np.floor(xyz / gap).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(2.0, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    _, group = connected_components(links, directed=False)
    groups = group[of.reshape(-1)]
    cluster = xyz[groups == np.bincount(groups[middle]).argmax()]
    return None if len(cluster) < MIN_POINTS else _tightest(cluster, up)


def _tightest(xyz: Float[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"] | None) -> OrientedBox:
    """The box of least volume among evenly spread rotations."""
    with suppress(QhullError):  # of flat clusters, all points are used
        xyz = xyz[ConvexHull(xyz).vertices]
    base = camera_axes(up)
    if up is None:
        rotations = spread_rotations(ROTATIONS) @ base.T
    else:
        angles = np.arange(YAWS) * (np.pi / 2 / YAWS)
        rotations = Rotation.from_rotvec(angles[:, None] * up).as_matrix() @ base.T
    boxes = [aligned_box(xyz, rotation) for rotation in rotations]
    return min(boxes, key=lambda box: box.volume_m3)


LEVELS = {"recall_25": 0.25, "recall_50": 0.5, "recall_70": 0.7}


@dataclass
class Arguments(BoxOptions):
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A recording with true 3D boxes."""
    taught: tuple[int, ...] = (0,)
    """Numbers of taught objects of each class."""
    image_box: Literal["projected", "label"] = "projected"
    """Where the 2D boxes come from."""
    base: Path | None = None
    """Weights of a base detector for --taught 0; None = the one of the package."""
    no_sizes: bool = False
    """Use no typical sizes, neither of well-known classes nor of taught objects."""
    minutes: float = 3.0
    """Length of each training, minutes."""
    epochs: int | None = None
    """Length of each training in epochs, in place of minutes, for comparisons on a busy machine."""
    generated: float = samples.GENERATED_SHARE
    """Share of generated views in each training."""
    untrained: bool = False
    """Train nothing: taught objects only give the typical sizes of their classes to the base detector."""
    min_points: int = 20
    """Objects with fewer points are skipped."""
    every: int = 1
    """Use every n-th frame."""
    seed: int = 0
    """Seed of the 2D boxes' errors, of the choice of taught objects and of the trainings."""
    backend: Backend = "auto"
    """Backend of the detector."""


@dataclass(frozen=True, eq=False)
class Given:
    """An object, the 2D box from which it is lifted, and its number in the frame."""

    truth: Truth
    image_box: Box2D
    number: int


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame of the recording by its index, with its objects that have enough points."""

    index: int
    frame: Frame
    objects: tuple[Given, ...]


def given_boxes(
    recording: Recording, frame: Frame, truths: Sequence[Truth], args: Arguments, rng: np.random.Generator
) -> Iterator[Given]:
    """Yields the objects with enough points that are on the image, with their inaccurate 2D boxes."""
    mask = load_mask(recording, frame) if _takes_masks(recording, args) else None
    for number, truth in enumerate(truths):
        if args.image_box == "projected":
            box = box_on_image(frame.camera, truth.box, truth.label)
        else:
            box = own_image_box(truth, number, mask)
            if box is None and mask is None:
                raise ConfigError(f"{recording.path}: its labels have no 2D boxes; use --image-box projected")
        errors_px = rng.normal(0, JITTER_PX, 4)
        drawn = None if box is None else inaccurate(frame.camera, replace(box, label=truth.label), errors_px)
        if drawn is not None and contains(truth.box, frame.cloud.xyz_m).sum() >= args.min_points:
            yield Given(truth, drawn, number)


def own_image_box(truth: Truth, number: int, mask: UInt8[np.ndarray, "h w"] | None) -> Box2D | None:
    """Returns a label's own 2D box: the one in its file, or the extent of its mask; None without both.

    Args:
        number: position of the label in `load_truth`.
    """
    if truth.image_box is not None or mask is None:
        return truth.image_box
    rows, columns = np.nonzero(mask == number + 1)
    if len(rows) == 0:
        return None
    return Box2D(truth.label, columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5)


def _takes_masks(recording: Recording, args: Arguments) -> bool:
    """Whether the 2D boxes are the extents of masks, which enclose what is seen."""
    return args.image_box == "label" and has_masks(recording)


def base_detector(args: Arguments) -> tuple[Detector, int]:
    """The base detector, and the longer side of the views that it was trained on, pixels."""
    path = args.base or base_weights()
    return load_detector(path, args.backend), read_trained(path.parent).image_size_px


def with_up(frame: Frame, truths: Sequence[Truth], upright: bool) -> Frame:
    """With `--upright`, a frame without a known gravity direction gets that of its first true box's third axis."""
    if not upright or frame.up is not None or not truths:
        return frame
    up = truths[0].box.rotation[:, 2]
    return replace(frame, up=up if up[1] < 0 else -up)


def shots(recording: Recording, indices: Sequence[int], args: Arguments) -> Iterator[Shot]:
    """Yields the frames with objects, one in memory at a time."""
    for index in indices:
        frame = recording.frame(index)
        truths = load_truth(recording, index, frame)
        frame = with_up(frame, truths, args.upright)
        objects = tuple(given_boxes(recording, frame, truths, args, np.random.default_rng([args.seed, index])))
        if objects:
            yield Shot(index, frame, objects)


def tried(
    recording: Recording, indices: Sequence[int], detector: Detector, config: RcvConfig, args: Arguments
) -> dict[str, list[float]]:
    """The IoU of each object, by class; `config` has the settings of the detector."""
    ious: dict[str, list[float]] = defaultdict(list)
    kind = BoxKind.SILHOUETTE if _takes_masks(recording, args) else BoxKind.BOX
    config = config.for_detector(config.box_kind, config.class_agnostic, kind, config.trained)
    if args.no_sizes:
        config = config.model_copy(update={"use_typical_sizes": False})
    for shot in shots(recording, indices, args):
        boxes = lifted(shot.frame, [item.image_box for item in shot.objects], detector, config, args.rotation)
        for item, box in zip(shot.objects, boxes, strict=True):
            ious[item.truth.label].append(0.0 if box is None else iou_3d(box, item.truth.box))
    return ious


def guessed(recording: Recording, indices: Sequence[int], args: Arguments) -> dict[str, list[float]]:
    """The IoU of each object's guess from geometry alone, by class."""
    ious: dict[str, list[float]] = defaultdict(list)
    for shot in shots(recording, indices, args):
        is_upright = orientation_for(args.rotation, shot.frame) is Orientation.UPRIGHT
        for item in shot.objects:
            guess = cluster_box(shot.frame, item.image_box, shot.frame.up if is_upright else None)
            label = f"{item.truth.label} (clusters)"
            ious[label].append(0.0 if guess is None else iou_3d(guess, item.truth.box))
    return ious


def taught_objects(recording: Recording, indices: Sequence[int], args: Arguments) -> dict[str, list[tuple[int, int]]]:
    """All objects that can be taught, as (frame, number), by class; a smaller number is the begin of a larger one."""
    found: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for shot in shots(recording, indices, args):
        for item in shot.objects:
            found[item.truth.label].append((shot.index, item.number))
    return {
        label: sorted(places, key=lambda place: hashlib.sha256(f"{args.seed} {place}".encode()).digest())
        for label, places in found.items()
    }


@contextmanager
def taught_project(
    recording: Recording, chosen: Mapping[str, Sequence[tuple[int, int]]], args: Arguments
) -> Iterator[Project]:
    """A project with the true boxes of the chosen objects as reviewed labels."""
    settings = ProjectSettings(rotation=args.rotation)
    places = {place for each in chosen.values() for place in each}
    up = None
    with TemporaryDirectory() as folder, create_project(Path(folder), "taught", sorted(chosen), settings=settings) as p:
        labels: dict[int, list[Truth]] = defaultdict(list)
        for index in sorted({index for index, _ in places}):
            frame = recording.frame(index)
            truths = load_truth(recording, index, frame)
            labels[index] = [truth for number, truth in enumerate(truths) if (index, number) in places]
            if up is None and frame.up is None and args.upright:
                up = tuple(with_up(frame, truths, True).up.tolist())  # type: ignore[union-attr]
        stored = register_recording(p, recording, up=up)
        frames = {frame.index: frame for frame in p.frames.of([stored.id])}
        for index, truths in labels.items():
            new = [NewLabel(truth.label, truth.box) for truth in truths]
            p.labels.create(frames[index].id, new, WriteContext(frames[index].revision, "benchmark"))
        yield p


def after(
    recording: Recording, chosen: Mapping[str, Sequence[tuple[int, int]]], indices: Sequence[int], args: Arguments
) -> tuple[dict[str, list[float]], float]:
    """The IoU of each object of the taught classes by class, and the seconds of training."""
    with taught_project(recording, chosen, args) as project:
        seconds = 0.0
        if args.untrained:
            detector, size_px = base_detector(args)
            config = rcv_config(project, view_px=size_px).for_detector(BoxKind.BOX, True)
        else:
            view = VIEW_DEFAULTS.model_copy(update={"epochs": args.epochs})
            plan = TrainPlan(view=view, samples=samples.SampleConfig(seed=args.seed), minutes=args.minutes)
            samples.GENERATED_SHARE = args.generated
            held_out.is_held_out = lambda *_: False  # type: ignore[attr-defined]  # all taught objects train
            seconds = seconds_of(lambda: train(project, plan, roles=(DetectorKind.VIEW,)))
            project.models.activate(project.models.all(DetectorKind.VIEW)[-1].id)
            model = required_model(project, DetectorKind.VIEW)
            config = rcv_config(project, view_px=read_trained(model.path.parent).image_size_px)
            config = config.for_detector(model.box_kind, model.class_agnostic, trained=model.trained)
            detector = load_detector(model.path, args.backend)
        ious = tried(recording, indices, detector, config, args)
        return {label: ious[label] for label in chosen}, seconds


def rows(ious: Mapping[str, Sequence[float]], taught: int, seconds: float) -> list[dict[str, object]]:
    """The results as JSON objects."""
    return [
        {
            "label": label,
            "taught": taught,
            "objects": len(values),
            "mean_iou": float(np.mean(values)),
            **{name: float(np.mean(np.array(values) >= level)) for name, level in LEVELS.items()},
            "seconds_training": seconds,
        }
        for label, values in sorted(ious.items())
        if values
    ]


def run(args: Arguments) -> dict[str, Any]:
    if not args.taught or min(args.taught) < 0:
        raise ConfigError(f"--taught takes numbers of objects from 0 on, not {args.taught}")
    recording: Recording = open_recording(args.folder)
    indices = list(range(0, len(recording), args.every))
    half = 0 if max(args.taught) == 0 else len(indices) // 2
    results: list[dict[str, object]] = []
    if 0 in args.taught:
        detector, size_px = base_detector(args)
        config = RcvConfig(view_px=size_px).for_detector(BoxKind.BOX, True)
        results += rows(tried(recording, indices[half:], detector, config, args), 0, 0.0)
        results += rows(guessed(recording, indices[half:], args), 0, 0.0)
    known = taught_objects(recording, indices[:half], args)
    for number in sorted(set(args.taught) - {0}):
        chosen = {label: places[:number] for label, places in known.items() if len(places) >= number}
        if chosen:
            ious, seconds = after(recording, chosen, indices[half:], args)
            results += rows(ious, number, seconds)
    return {"results": sorted(results, key=lambda row: str(row["label"]))}


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    heads = ("class", "taught", "objects", "mean IoU", ">= 0.25", ">= 0.5", ">= 0.7", "training s")
    return [Table(*heads, rows=(row.values() for row in result["results"]))]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
