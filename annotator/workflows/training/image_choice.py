"""Whether a new image detector is put into use: held-out images decide, as for a view detector (`training.rounds`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from annotator.detection.dataset import DatasetManifest, ManifestEntry, read_picture
from annotator.detection.edge_errors import read_boxes
from annotator.geometry.iou import box_iou
from annotator.project import REVIEWED, Project, StoredModel
from annotator.types import Box2D, DetectorKind
from annotator.workflows.detectors import UsedModel, load_detector, own_model
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.held_out import FOUND_NONE, MIN_OBJECTS, Decision, Rival
from annotator.workflows.training.rounds import has_learned

# Images that are read and run at once.
AT_ONCE = 64


def decide(project: Project, dataset: Path, manifest: DatasetManifest, model: StoredModel, note: str) -> Decision:
    """Measures a new image detector and the one in use, puts it into use if it is no worse, and stores the reasons.

    With too few held-out objects, the newest detector is used: it has learned from more boxes.

    Args:
        dataset: the new detector's training set; images of its split `val` were never trained on.
        note: what the training started from.
    """
    entries = [each for each in manifest.entries if each.split == "val"]
    objects = sum(len(each.boxes) for each in entries)
    used = project.models.active(DetectorKind.IMAGE)
    iou, rivals, is_used = None, list[Rival](), True
    if objects < MIN_OBJECTS:
        outcome = f"fewer than {MIN_OBJECTS} objects on held-out images: put into use as the newest"
    else:
        iou = _mean_iou(project, own_model(project, model), dataset, entries, manifest.classes)
        if used is not None and used.id != model.id and not has_learned(project, own_model(project, used)):
            other = _mean_iou(project, own_model(project, used), dataset, entries, manifest.classes)
            rivals.append(Rival(name="detector in use", mean_iou=other))
        is_used = iou > 0 and all(iou >= rival.mean_iou for rival in rivals)
        kept = "" if used is None else ", and the one in use stayed in use"
        if is_used:
            outcome = "the best one on held-out images: put into use" if rivals else "put into use"
        else:
            outcome = f"{FOUND_NONE if iou == 0 else 'worse on held-out images'}: not put into use{kept}"
    if is_used:
        project.models.activate(model.id)
    decision = Decision(
        objects=objects,
        frames=len(entries),
        mean_iou=iou,
        compared=tuple(rivals),
        started_from=note,
        outcome=outcome,
        reviewed=project.labels.count(REVIEWED),
    )
    decision.write(model.path.parent)
    return decision


def _mean_iou(
    project: Project, model: UsedModel, dataset: Path, entries: Sequence[ManifestEntry], classes: Sequence[str]
) -> float:
    """Mean 2D IoU over all objects and false detections: 0 for an object that is not found, and for what is none."""
    detector, least = load_detector(model.path, names=model.names), rcv_config(project).min_image_score
    found, number = 0.0, 0
    for begin in range(0, len(entries), AT_ONCE):
        part = entries[begin : begin + AT_ONCE]
        pictures = [read_picture(dataset / entry.image) for entry in part]
        for entry, picture, boxes in zip(part, pictures, detector.detect(pictures), strict=True):
            height, width = picture.rgb.shape[:2]
            truths = read_boxes(dataset, dataset / entry.image, classes, width, height)
            ious = matched_ious(truths, [box for box in boxes if box.score >= least])
            found, number = found + sum(ious), number + len(ious)
    return found / max(number, 1)


def matched_ious(truths: Sequence[Box2D], boxes: Sequence[Box2D]) -> list[float]:
    """The IoU of each pair of a true box and a found one, the best pairs first, and 0 for each box without another."""
    pairs = [(iou, i, j) for i, a in enumerate(truths) for j, b in enumerate(boxes)
             if a.label == b.label and (iou := box_iou(a, b)) > 0]  # fmt: skip
    left, other, ious = set(range(len(truths))), set(range(len(boxes))), list[float]()
    for iou, i, j in sorted(pairs, reverse=True):
        if i in left and j in other:
            left.remove(i)
            other.remove(j)
            ious.append(iou)
    return ious + [0.0] * (len(left) + len(other))
