"""Training samples of objects put into other frames: from training frames only, into training frames only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.cli.main import main
from annotator.detection import base_detector
from annotator.detection.dataset import TrainingSample
from annotator.detection.manifest import read_manifest
from annotator.detection.progress import TrainingStoppedError
from annotator.geometry.iou import iou_3d
from annotator.project import Project, StoredFrame, WriteContext
from annotator.project.log.event_types import LabelEdited
from annotator.project.log.records import BoxRecord
from annotator.rcv.config import RcvConfig, ViewConfig
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, Proposal, Quality, Source
from annotator.types.errors import FrameError
from annotator.workflows.detectors import AGNOSTIC
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.training import held_out, pasted_samples, run
from annotator.workflows.training.pasted_samples import (
    PASTED,
    pasted_frames,
    pasted_image_samples,
    pasted_view_samples,
)
from annotator.workflows.training.samples import SampleConfig, frame_group, gather

RCV = RcvConfig(view=ViewConfig(size_px=64))
HELD_OUT = ("000001", "000003")


def never(stored: StoredFrame, error: FrameError) -> None:
    raise AssertionError(f"{stored.key} was skipped: {error}")


@pytest.fixture
def labelled(people: Project) -> Project:
    """The project with the true boxes of all 5 frames."""
    import_own_labels(people, people.recordings.all()[0].id)
    return people


def groups(project: Project, keys: tuple[str, ...] = HELD_OUT) -> frozenset[str]:
    return frozenset(frame_group(stored) for stored in project.frames.of() if stored.key in keys)


def views(project: Project, share: float = 0.5, seed: int = 0, agnostic: bool = True) -> list[TrainingSample]:
    config = SampleConfig(views=120, seed=seed, pasted=share)
    return list(pasted_view_samples(project, gather(project), RCV, config, 60, groups(project), agnostic, never))


@pytest.mark.parametrize("agnostic", [True, False])
def test_held_out_frames_neither_give_nor_get_objects(labelled: Project, agnostic: bool) -> None:
    config, material = SampleConfig(views=120, pasted=0.5), gather(labelled)
    held = {stored.id for stored in labelled.frames.of() if stored.key in HELD_OUT}
    uids = {label.uid for frame_id in held for label in material.labels[frame_id]}
    found = list(pasted_frames(labelled, material, RCV, config, 20, groups(labelled), never))
    assert len(found) >= 5
    for pasted in found:
        assert pasted.known.stored.id not in held
        assert pasted.label.uid not in uids
        assert pasted.label.uid not in {label.uid for label in pasted.known.labels}
    samples = views(labelled, agnostic=agnostic)
    assert {sample.group for sample in samples} <= groups(labelled, ("000000", "000002", "000004"))
    assert not {uid for sample in samples for uid in sample.label_uids} & uids


def test_views_of_pasted_objects_are_about_the_share_that_was_asked_for(labelled: Project) -> None:
    half = views(labelled)
    assert 30 <= len(half) <= 60
    assert {sample.origin for sample in half} == {PASTED}
    assert sum(bool(sample.boxes) for sample in half) > 0.8 * len(half)
    assert {box.label for sample in half for box in sample.boxes} == set(AGNOSTIC)
    assert len(views(labelled, 0.2)) <= 24
    assert views(labelled, 0.0) == []
    assert {box.label for sample in views(labelled, agnostic=False) for box in sample.boxes} == {"person"}


def test_the_seed_determines_the_views(labelled: Project) -> None:
    first, again, other = views(labelled), views(labelled), views(labelled, seed=1)
    assert [sample.boxes for sample in first] == [sample.boxes for sample in again]
    assert all((a.load() == b.load()).all() for a, b in zip(first, again, strict=True))
    assert [sample.boxes for sample in first] != [sample.boxes for sample in other]


def test_with_one_frame_that_trains_there_is_nothing_to_paste(labelled: Project) -> None:
    others = groups(labelled, ("000000", "000001", "000002", "000003"))
    config = SampleConfig(views=120, pasted=0.5, pasted_images=0.5)
    assert list(pasted_view_samples(labelled, gather(labelled), RCV, config, 60, others, True, never)) == []
    assert list(pasted_image_samples(labelled, gather(labelled), RCV, config, others, never)) == []


def test_camera_images_get_the_pasted_object_and_its_box(labelled: Project) -> None:
    doubtful = next(stored for stored in labelled.frames.of() if stored.key == "000002")
    known = gather(labelled).labels[doubtful.id][0].box
    box = OrientedBox.from_parts(known.center_m + np.array([0.0, 0.0, 3.0]), known.rotation, known.size_m)
    proposal = Proposal("person", 0.9, box, Box2D("person", 1.0, 1.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0))
    labelled.proposals.replace(doubtful.id, [proposal], WriteContext(doubtful.revision, "rcv", Source.AUTO))
    config = SampleConfig(pasted_images=0.8)
    samples = list(pasted_image_samples(labelled, gather(labelled), RCV, config, groups(labelled), never))
    assert len(samples) >= 4
    # a frame with unreviewed proposals may have unknown objects
    assert {sample.group for sample in samples} <= groups(labelled, ("000000", "000004"))
    frames = {frame_group(stored): FrameSource(labelled).read(stored).rgb for stored in labelled.frames.of()}
    labels = {frame_group(s): len(gather(labelled).labels[s.id]) for s in labelled.frames.of()}
    for sample in samples:
        added = sample.boxes[-1]
        assert len(sample.boxes) == len(sample.label_uids) <= labels[sample.group] + 1
        changed = (sample.load().astype(int) != frames[sample.group]).any(axis=2)
        rows, columns = np.nonzero(changed)
        assert changed.sum() > 20
        assert added.x_min - 4 <= columns.min() < columns.max() <= added.x_max + 4
        assert added.y_min - 4 <= rows.min() < rows.max() <= added.y_max + 4


def with_boxes_around_what_is_seen(labelled: Project, key: str) -> set[str]:
    """Says of a frame's boxes that they enclose only what is seen; returns their uids."""
    stored = next(one for one in labelled.frames.of() if one.key == key)
    known = labelled.labels.of_frame(stored.id)
    edits = [
        LabelEdited(uid=one.uid, label=one.label, box=BoxRecord.of(one.box), box_kind=BoxKind.SILHOUETTE)
        for one in known
    ]
    labelled.log.append(stored.id, edits, WriteContext(stored.revision, "me"))
    return {one.uid for one in known}


@pytest.mark.parametrize("agnostic", [True, False])
def test_objects_whose_boxes_are_of_the_other_kind_are_not_pasted_but_not_background_either(
    labelled: Project, agnostic: bool
) -> None:
    untaught = with_boxes_around_what_is_seen(labelled, "000002")
    material = gather(labelled)
    assert (material.kind, len(material.labels), len(material.labels_of_kind)) == (BoxKind.BOX, 5, 4)
    found = list(
        pasted_frames(
            labelled, material, RCV, SampleConfig(), 20, groups(labelled), never, with_images=True, both_kinds=agnostic
        )
    )
    assert found and not {pasted.label.uid for pasted in found} & untaught
    among = [pasted for pasted in found if pasted.known.stored.key == "000002"]
    assert among and all({label.uid for label in pasted.known.untaught} == untaught for pasted in among)
    boxes = [label.box for label in among[0].known.untaught]
    assert all(iou_3d(box, pasted.frame.objects[-1].box) < 0.2 for pasted in among for box in boxes)
    config = SampleConfig(views=240, pasted=0.5)
    samples = list(pasted_view_samples(labelled, material, RCV, config, 60, groups(labelled), agnostic, never))
    assert samples and not {uid for sample in samples for uid in sample.label_uids} & untaught


def test_images_of_a_project_with_both_kinds_of_boxes_are_pasted_into_only_if_asked_for(labelled: Project) -> None:
    with_boxes_around_what_is_seen(labelled, "000002")
    material = gather(labelled)
    with_images = SampleConfig(pasted_images=0.8)
    assert list(pasted_image_samples(labelled, material, RCV, SampleConfig(), groups(labelled), never)) == []
    samples = list(pasted_image_samples(labelled, material, RCV, with_images, groups(labelled), never))
    assert samples and {sample.origin for sample in samples} == {PASTED}


def test_views_of_pasted_objects_leave_out_those_that_show_an_object_of_the_other_kind(
    labelled: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_boxes_around_what_is_seen(labelled, "000002")
    doubted: dict[str, int] = {}

    def teach(frame: Frame, *args: Any) -> list[Any]:
        doubted[frame.key] = len(args[6])
        return []

    monkeypatch.setattr(pasted_samples, "teach_views", teach)
    views(labelled, agnostic=False)
    assert doubted["000002"] == 3 and not any(count for key, count in doubted.items() if key != "000002")


def test_the_command_line_trains_both_detectors_on_pasted_objects(
    labelled: Project, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(base_detector, "FOLDER", tmp_path / "base")
    monkeypatch.setattr(held_out, "is_held_out", groups(labelled).__contains__)
    sets = {}

    def stop_at_training(dataset: Path, out: Path, config: object, progress, role, stop) -> None:
        sets[role.value] = read_manifest(dataset)
        raise TrainingStoppedError("here")

    monkeypatch.setattr(run, "train_detector", stop_at_training)
    words = [
        "train",
        labelled.config.name,
        "--projects",
        str(labelled.path.parent),
        "--views",
        "60",
        "--weights",
        "never",
    ]
    for role in ("view", "image"):
        assert main([*words, "--only", role, "--pasted", "0.5", "--pasted-images", "0.5"]) != 0
    for manifest in sets.values():
        assert 0.2 < manifest.images_by_origin["train"][PASTED] / manifest.images["train"] < 0.7
        assert PASTED not in manifest.images_by_origin["val"]
    assert set(sets) == {"view", "image"}
