"""Training samples of the detectors, the base detector included: their pictures, boxes and origins."""

from __future__ import annotations

import hashlib
import json
import runpy
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from view_detectors import SEEN, WHOLE, Fixed

from annotator.detection.dataset import TrainingSample
from annotator.detection.trained import read_trained
from annotator.geometry.outline import box_on_image
from annotator.project import NewLabel, Origin, Project, StoredFrame, WriteContext
from annotator.rcv.config import RcvConfig
from annotator.rcv.teach import TaughtObject, TaughtView, teach_views
from annotator.recordings import open_recording
from annotator.synthetic.snapshots import snapshot
from annotator.types import (
    NO_CORRECTION,
    Box2D,
    BoxKind,
    Correction,
    DetectorKind,
    OrientedBox,
    Proposal,
    Quality,
    Source,
)
from annotator.types.errors import DetectionError, FrameError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.simulate import image_box_of, simulate_recording, visible_objects
from annotator.workflows.training.samples import (
    DRAWN,
    PROJECTED,
    TAUGHT,
    Material,
    SampleConfig,
    agnostic_samples,
    drawn_pictures,
    gather,
    image_samples,
    view_samples,
    with_generated,
)

CONFIG = RcvConfig()
SOME = Box2D("person", 1.0, 1.0, 9.0, 9.0)


def never(stored: StoredFrame, error: FrameError) -> None:
    raise AssertionError(f"{stored.key} was skipped: {error}")


def simulate(project: Project, kind: BoxKind, every: int = 2) -> Material:
    (recording,) = project.recordings.all()
    simulate_recording(project, recording.id, kind, CONFIG, every)
    return gather(project)


def views(
    project: Project, material: Material, number: int = 24, seed: int = 0, config: RcvConfig = CONFIG
) -> list[TrainingSample]:
    return list(view_samples(project, material, config, SampleConfig(views=number, seed=seed), never))


def accept(project: Project, index: int, count: int = 3) -> tuple[str, ...]:
    """Creates accepted labels of the first true boxes of a frame; returns their uids."""
    recording = open_recording(project.recordings.all()[0].path)
    truths = load_truth(recording, index, recording.frame(index))[:count]
    stored = project.frames.of()[index]
    new = [NewLabel(truth.label, truth.box) for truth in truths]
    return project.labels.create(stored.id, new, WriteContext(stored.revision, "me")).uids


def test_each_detector_needs_only_its_own_boxes(people: Project) -> None:
    text = r"no boxes on camera images or pseudo-views to learn from; draw some.*import.*simulate"
    with pytest.raises(DetectionError, match=text):
        gather(people)
    stored = people.frames.of()[0]
    for uid in accept(people, 0):
        people.labels.reject(stored.id, uid, WriteContext(people.frames.get(stored.id).revision, "me"))
    with pytest.raises(DetectionError, match=text):
        gather(people)
    revision = people.frames.get(stored.id).revision
    people.boxes.set_on_image(stored.id, [SOME], BoxKind.SILHOUETTE, WriteContext(revision, "me"))
    with pytest.raises(DetectionError, match="no boxes on pseudo-views to learn from"):
        gather(people)
    assert len(gather(people, [DetectorKind.IMAGE]).images) == 1
    view = people.views.store(np.zeros((40, 40, 3), np.uint8))
    people.boxes.set_on_view(view, [SOME], BoxKind.SILHOUETTE, WriteContext(0, "me"))
    assert len(gather(people).views) == 1


@pytest.mark.parametrize("kind", list(BoxKind))
def test_the_majority_kind_of_boxes_is_used_and_others_are_left_out(people: Project, kind: BoxKind) -> None:
    other = BoxKind.SILHOUETTE if kind is BoxKind.BOX else BoxKind.BOX
    rng = np.random.default_rng(0)
    for number, (of, boxes) in enumerate([(kind, 2), (other, 1), (kind, 0), (other, 0)]):
        view = people.views.store(rng.integers(0, 255, (40, 40, 3), np.uint8))
        drawn = [replace(SOME, x_min=10.0 * k, x_max=10.0 * k + 9) for k in range(boxes)]
        people.boxes.set_on_view(view, drawn, of, WriteContext(0, f"author {number}"))
    material = gather(people, [DetectorKind.VIEW])
    assert material.kind is kind
    assert (len(material.views), len(material.views_of_kind)) == (4, 3), "pictures without boxes fit either kind"


def test_a_few_accepted_boxes_do_not_change_the_majority_kind(people: Project) -> None:
    simulate(people, BoxKind.SILHOUETTE, every=3)  # 2 frames of 3 objects: 24 drawn views
    accept(people, 1)
    assert gather(people).kind is BoxKind.SILHOUETTE
    accept(people, 2)
    accept(people, 4)
    assert gather(people).kind is BoxKind.BOX


def stored_pictures(project: Project) -> dict[str, np.ndarray]:
    return {view.view_id: project.views.load(view.view_id) for view in project.boxes.on_views()}


def test_drawn_views_are_drawn_anew_after_a_correction(people: Project) -> None:
    """One that moves nothing gives every picture bit for bit: they depend on nothing else."""
    material, (recording,) = simulate(people, BoxKind.SILHOUETTE, every=3), people.recordings.all()
    before = stored_pictures(people)
    people.adjustments.correct(recording.id, Correction(time_offset_s=0.001), "me")
    again = {view.view_id: rgb for view, rgb in drawn_pictures(people, material.views, never)}
    assert all(np.array_equal(again[view], before[view]) for view in before)
    people.adjustments.correct(recording.id, Correction((0.0, 0.03, 0.0), (0.05, 0.0, 0.0)), "me")
    moved = {view.view_id: rgb for view, rgb in drawn_pictures(people, people.boxes.on_views(), never)}
    assert moved.keys() == before.keys() and len(before) == 24
    assert all(moved[view].shape == before[view].shape for view in before)
    assert not any(np.array_equal(moved[view], before[view]) for view in before), "the colours are others"
    shown = [np.mean((moved[view] != 114).any(axis=2) == (before[view] != 114).any(axis=2)) for view in before]
    assert min(shown) > 0.5 and np.median(shown) > 0.9, "the boxes are on the same shapes"
    trained = [sample.rgb for sample in views(people, gather(people)) if sample.origin == DRAWN]
    assert {rgb.tobytes() for rgb in trained} == {rgb.tobytes() for rgb in moved.values()}
    people.adjustments.correct(recording.id, NO_CORRECTION, "me")
    back = {view.view_id: rgb for view, rgb in drawn_pictures(people, people.boxes.on_views(), never)}
    assert max(np.mean((back[view] != before[view]).any(axis=2)) for view in before) < 0.01, "but for rounding"


def test_drawn_views_whose_box_a_correction_leaves_empty_do_not_train(people: Project) -> None:
    simulate(people, BoxKind.SILHOUETTE, every=5)
    (recording,) = people.recordings.all()
    people.adjustments.correct(recording.id, Correction((0.0, 0.0, 0.0), (40.0, 0.0, 0.0)), "me")
    skipped: list[str] = []
    material = gather(people)
    assert not list(drawn_pictures(people, material.views, lambda _, error: skipped.append(str(error))))
    assert len(skipped) == 12 and all(
        "the corrected calibration leaves no points in its box" in line for line in skipped
    )


def test_drawn_boxes_replace_the_outlines_of_their_objects(people: Project) -> None:
    """One of three accepted boxes has a drawn image box, which is smaller; the others were accepted in Review."""
    uids = accept(people, 1)
    known = accept(people, 0)
    stored = people.frames.of()[0]
    camera = FrameSource(people).read(stored).camera
    own = {u: box_on_image(camera, people.labels.get(u).label.box, "person") for u in known}
    around = own[known[1]]
    assert around is not None
    drawn = replace(around, y_max=around.y_max - 0.3 * around.height_px)
    people.boxes.set_on_image(
        stored.id, [drawn], BoxKind.BOX, WriteContext(people.frames.get(stored.id).revision, "me")
    )
    first, second = image_samples(people, gather(people), never)
    assert (first.origin, first.group) == (DRAWN, "1/000000")
    assert first.boxes == (drawn, own[known[0]], own[known[2]])
    assert first.label_uids[1:] == (known[0], known[2])
    assert (second.origin, len(second.boxes), second.group) == (PROJECTED, 3, "1/000001")
    assert second.label_uids == uids
    frame = FrameSource(people).read(people.frames.of()[1])
    np.testing.assert_array_equal(second.rgb, frame.rgb)


def propose_true(project: Project, index: int, place: int) -> str:
    """Creates an unreviewed proposal of the `place`-th object of a frame; returns its uid."""
    recording = open_recording(project.recordings.all()[0].path)
    truth = load_truth(recording, index, recording.frame(index))[place]
    return propose(project, index, truth.box)


def propose(project: Project, index: int, box: OrientedBox) -> str:
    stored = project.frames.of()[index]
    found = Proposal("person", 0.9, box, SOME, (), Quality(0.0, 1.0, 0.0))
    context = WriteContext(project.frames.get(stored.id).revision, "rcv", Source.AUTO)
    (uid,) = project.proposals.replace(stored.id, [found], context).uids
    assert uid is not None
    return uid


def test_partly_reviewed_frames_are_not_image_samples(people: Project) -> None:
    accept(people, 0, count=2)
    uid = propose_true(people, 0, 2)
    with pytest.raises(DetectionError, match="every frame with reviewed boxes also has unreviewed proposals"):
        gather(people)
    assert gather(people, [DetectorKind.VIEW]).labels, "its pseudo-views can still be used"
    accept(people, 1)
    material = gather(people)
    assert material.unreviewed_images == 1
    assert [sample.group for sample in image_samples(people, material, never)] == ["1/000001"]
    stored = people.frames.of()[0]
    people.labels.reject(stored.id, uid, WriteContext(people.frames.get(stored.id).revision, "me"))
    material = gather(people)
    assert material.unreviewed_images == 0
    assert len(list(image_samples(people, material, never))) == 2


def test_frames_with_drawn_boxes_are_samples_despite_open_proposals(people: Project) -> None:
    stored = people.frames.of()[0]
    people.boxes.set_on_image(stored.id, [SOME], BoxKind.BOX, WriteContext(0, "me"))
    reviewed = accept(people, 0, count=2)
    propose_true(people, 0, 2)
    material = gather(people)
    (sample,) = image_samples(people, material, never)
    assert (sample.origin, sample.label_uids[1:], material.unreviewed_images) == (DRAWN, reviewed, 0)


def test_views_are_rendered_from_3d_labels_and_list_their_uids(people: Project) -> None:
    uids = {*accept(people, 0), *accept(people, 2)}
    samples = views(people, gather(people), 24)
    assert {sample.origin for sample in samples} == {TAUGHT}
    assert 0.8 * 24 <= len(samples) <= 24
    assert {sample.group for sample in samples} == {"1/000000", "1/000002"}
    assert {uid for sample in samples for uid in sample.label_uids} == uids
    for sample in samples:
        assert len(sample.label_uids) == len(sample.boxes)


def test_drawn_views_are_used_unchanged(people: Project) -> None:
    material = simulate(people, BoxKind.BOX)
    samples = views(people, material, 18)
    origins = Counter(sample.origin for sample in samples)
    assert origins[DRAWN] == 36
    assert origins[TAUGHT] == 18, "one pair per object, nine objects"
    for sample, view in zip(samples, material.views, strict=False):
        assert sample.origin == DRAWN
        assert len(sample.label_uids) == len(sample.boxes)
        assert sample.boxes == view.boxes
        np.testing.assert_array_equal(sample.rgb, people.views.load(view.view_id))
        assert view.frame_id is not None
        assert sample.group == f"1/{people.frames.get(view.frame_id).key}"


@pytest.mark.parametrize(("asked", "draws"), [(1, 1), (24, 4), (10**6, 20)])
def test_few_objects_are_drawn_more_often_up_to_a_limit(people: Project, asked: int, draws: int) -> None:
    accept(people, 0)
    samples = views(people, gather(people), asked)
    assert 0.8 * 2 * 3 * draws <= len(samples) <= 2 * 3 * draws


def test_an_object_both_drawn_and_accepted_has_one_box_per_view(people: Project) -> None:
    """If it counted twice, it would have two boxes on each of its pictures."""
    simulate(people, BoxKind.SILHOUETTE, every=3)
    accept(people, 0)
    material = gather(people)
    assert material.kind is BoxKind.SILHOUETTE
    taught = [sample for sample in views(people, material, 60) if sample.origin == TAUGHT]
    assert len(taught) > 20
    for sample in taught:
        edges = np.array([box.xyxy for box in sample.boxes])
        apart = np.abs(edges[:, None] - edges).max(axis=2) + 100 * np.eye(len(edges))
        assert apart.min() > 3, "two boxes around one object"


def whole_boxes_known(project: Project, kind: BoxKind = BoxKind.BOX, count: int = 3) -> list[Box2D | None]:
    """Gives drawn objects of the first frame a label with their true box, as if an operator had confirmed it."""
    stored = project.frames.of()[0]
    frame = FrameSource(project).read(stored)
    recording = open_recording(project.recordings.all()[0].path)
    objects = visible_objects(recording, 0, frame, ["person"])[:count]
    drawn = [image_box_of(frame, one, BoxKind.SILHOUETTE) for one in objects]
    new = [
        NewLabel(one.label, one.box, origin=Origin.DRAWN, image_box=image_box, box_kind=kind)
        for one, image_box in zip(objects, drawn, strict=True)
    ]
    project.labels.create(stored.id, new, WriteContext(stored.revision, "me"))
    return drawn


def agnostic(project: Project, given: Fixed) -> list[TrainingSample]:
    """The samples of a class-agnostic detector that starts from one with given boxes."""
    return list(agnostic_samples(project, gather(project), CONFIG, SampleConfig(views=24), given, never))


def test_an_object_whose_whole_box_is_known_counts_as_whole_although_its_silhouettes_are_drawn(people: Project) -> None:
    simulate(people, BoxKind.SILHOUETTE, every=5)
    whole_boxes_known(people, count=2)
    material = gather(people)
    assert (material.kind, len(material.whole)) == (BoxKind.BOX, 2)
    assert len(material.views) == 12 and not material.views_of_kind


def test_a_3d_box_around_what_is_seen_is_no_whole_box(people: Project) -> None:
    simulate(people, BoxKind.SILHOUETTE, every=5)
    whole_boxes_known(people, BoxKind.SILHOUETTE)
    material = gather(people)
    assert material.kind is BoxKind.SILHOUETTE
    assert not material.whole
    assert {len(labels) for labels in material.labels_of(material.kind).values()} == {3}


def test_only_the_object_of_a_view_is_labelled_and_the_start_gives_what_is_not_known(people: Project) -> None:
    simulate(people, BoxKind.SILHOUETTE)
    given = Fixed((Box2D(WHOLE, 1.0, 1.0, 60.0, 60.0, 0.9), Box2D(WHOLE, 3.0, 3.0, 9.0, 9.0, 0.8)))
    samples = agnostic(people, given)
    assert {sample.origin for sample in samples} == {"drawn", "taught"}
    with_boxes = [sample for sample in samples if sample.boxes]
    assert len(with_boxes) > 0.7 * len(samples)
    for sample in with_boxes:
        assert sorted(box.label for box in sample.boxes) == [SEEN, WHOLE]
        assert next(box for box in sample.boxes if box.label == WHOLE) == given.boxes[0]


def test_the_confirmed_whole_box_is_taught_beside_the_silhouette(people: Project) -> None:
    simulate(people, BoxKind.SILHOUETTE, every=5)
    image_boxes = [view.geometry.image_box for view in people.boxes.on_views() if view.geometry is not None]
    (image_box,) = whole_boxes_known(people, count=1)
    given = Fixed((Box2D(WHOLE, 1.0, 1.0, 60.0, 60.0, 0.9), Box2D(SEEN, 2.0, 2.0, 50.0, 50.0, 0.9)))
    samples = agnostic(people, given)
    of_drawn = [sample for sample in samples if sample.origin == "drawn"]
    assert len(of_drawn) == len(image_boxes) == 12
    guessed = [given.boxes[0] in sample.boxes for sample in of_drawn]
    assert guessed == [known != image_box for known in image_boxes], "the start completes the other two objects only"
    for sample in of_drawn:
        boxes = {box.label: box for box in sample.boxes}
        if given.boxes[0] not in sample.boxes:
            seen, whole = boxes[SEEN], boxes[WHOLE]
            assert whole.width_px * whole.height_px > 0.9 * seen.width_px * seen.height_px
    taught = [sample for sample in samples if sample.origin == "taught" and len(sample.label_uids) == 2]
    assert taught and not any(set(sample.boxes) & set(given.boxes) for sample in taught)


def test_a_fifth_of_the_views_is_generated() -> None:
    own = [TrainingSample(np.zeros((64, 64, 3), np.uint8), (), "1/1", "drawn")] * 120
    samples, others = (list(with_generated(own, 64, seed)) for seed in (0, 1))
    assert samples[:120] == own
    assert 0.1 < 1 - 120 / len(samples) < 0.3
    assert {sample.origin for sample in samples[120:]} == {"generated"}
    assert not {sample.group for sample in samples[120:]} & {sample.group for sample in others[120:]}


ROOT = Path(__file__).resolve().parents[3]


def agnostic_views(seed: int, draws: int = 8) -> list[TaughtView]:
    shot = snapshot(seed)
    objects = [TaughtObject(item.label, item.box, item.points) for item in shot.objects]
    return teach_views(shot.frame, objects, None, draws, RcvConfig(), None, np.random.default_rng(0))


def test_a_view_has_one_object_with_two_boxes_or_none() -> None:
    taught = [view for seed in range(3, 6) for view in agnostic_views(seed)]
    labels = [tuple(box.label for box in view.boxes) for view in taught]
    assert labels.count((WHOLE, SEEN)) > 0.8 * len(labels)
    assert labels.count(()) > 0  # crops that miss their object
    assert set(labels) <= {(WHOLE, SEEN), (WHOLE,), (SEEN,), ()}


@pytest.mark.slow
def test_the_script_trains_and_installs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "train_base.py"))
    monkeypatch.setattr("annotator.detection.pretrained.FOLDER", tmp_path / "package")
    plan = {"frames": 3, "draws": 2, "pictures": 64, "size": 32, "install": True}
    script["run"](tmp_path / "work", **plan)
    files = sorted(path.name for path in (tmp_path / "package").iterdir())
    assert files == ["detector.safetensors", "manifest.json", "model.json"]
    trained, weights = read_trained(tmp_path / "package"), (tmp_path / "package" / "detector.safetensors").read_bytes()
    assert (trained.classes, trained.weights.read_bytes()) == ((WHOLE, SEEN), weights)
    manifest = json.loads((tmp_path / "package" / "manifest.json").read_text())
    assert (manifest["frames"], manifest["weights_sha256"]) == (3, hashlib.sha256(weights).hexdigest())
    # finished work is not repeated
    script["run"](tmp_path / "work", **plan)
    assert json.loads((tmp_path / "package" / "manifest.json").read_text()) == manifest
    assert capsys.readouterr().out.count("detector.safetensors: map50=") == 2


def test_views_that_show_unreviewed_objects_are_left_out(people: Project) -> None:
    (uid,) = accept(people, 0, count=1)
    before = views(people, gather(people), 40)
    box = people.labels.get(uid).label.box
    floor_m = box.center_m - box.rotation[:, 2] * box.size_m[2] / 2
    propose(people, 0, OrientedBox.from_parts(floor_m, box.rotation, np.array([1.2, 1.2, 0.3])))
    after = views(people, gather(people, [DetectorKind.VIEW]), 40)
    assert 0 < len(after) < len(before)
