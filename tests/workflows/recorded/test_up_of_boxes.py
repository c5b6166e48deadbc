"""The labels and masks beside a recording, boxes made from them, and the up direction that boxes give."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rgbd_samples
from hypothesis import given
from hypothesis import strategies as st
from rgbd_samples import write_rgbd
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.frame_names import LabelledFrame
from annotator.geometry.oriented_box import contains
from annotator.project import BoxRotation, NewLabel, Project, ProjectSettings, StoredFrame, WriteContext, create_project
from annotator.rcv.config import Orientation, RcvConfig
from annotator.recordings import open_recording
from annotator.recordings.kitti import KittiTracking
from annotator.types import Box2D, BoxKind, DetectorKind, Frame, OrientedBox, ReviewState, Source, Truth
from annotator.types.errors import ConfigError, FormatError, FrameError, RecordingError, UnitError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.importing import Note
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.recorded.adjusting import LEAST_BOX_FRAMES, estimate_recording_up, learn_up
from annotator.workflows.recorded.boxes_from_3d import AUTHOR, boxes_from_3d, share_of
from annotator.workflows.recorded.own_labels import RecordedLabels
from annotator.workflows.recorded.reading import dont_care_rows, has_truth, load_mask, load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.samples import DRAWN, SampleConfig, gather, image_samples, view_samples
from annotator.workflows.training.train import TrainPlan, image_defaults, train

FRAMES = LEAST_BOX_FRAMES + 2
UP = np.array([0.1, -0.95, -0.3]) / np.linalg.norm([0.1, -0.95, -0.3])


@pytest.fixture
def wall(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """A recording whose frames do not tell which way is up: a wall in front of the camera."""

    def fill(made: Path) -> None:
        frames = rgbd_samples.wall(FRAMES, 60, 80, 2000)
        write_rgbd(made / "wall", frames, intrinsic_matrix=[70, 0, 0, 0, 70, 0, 39.5, 29.5, 1])

    return made_once("wall", fill) / "wall"


@pytest.fixture
def project(tmp_path: Path, wall: Path) -> Iterator[Project]:
    with create_project(tmp_path, "p", ("person", "hand")) as created:
        register_recording(created, open_recording(wall))
        yield created


def review(
    project: Project,
    turns: np.ndarray,
    *,
    up: np.ndarray = UP,
    lean_deg: float = 4.0,
    state: ReviewState = ReviewState.EDITED,
    kind: BoxKind = BoxKind.BOX,
    label: str = "person",
) -> None:
    """Reviews a box in each frame that stands along `up`, leaning a little, with these headings (radians)."""
    random = np.random.default_rng(1)
    upright = Rotation.align_vectors(up[None], np.array([[0.0, 0.0, 1.0]]))[0]
    for frame, turn in zip(project.frames.of(), turns, strict=False):
        lean = Rotation.from_rotvec(random.normal(size=3) * np.radians(lean_deg) / np.sqrt(3))
        rotation = (lean * upright * Rotation.from_euler("z", turn)).as_matrix()
        box = OrientedBox.from_parts(np.array([0.0, 0.0, 2.0]), rotation, np.array([0.3, 0.5, 1.7]))
        new = NewLabel(label, box, box_kind=kind, state=state)
        project.labels.create(frame.id, [new], WriteContext(frame.revision, "ann"))


def up_of(project: Project) -> np.ndarray | None:
    return FrameSource(project).read(project.frames.of()[0]).up


TURNING = np.linspace(0, 2.5, FRAMES)


def test_boxes_that_stand_and_turn_make_further_boxes_upright(project: Project) -> None:
    review(project, TURNING)
    (message,) = learn_up(project)
    assert message.startswith("wall: boxes are upright from now on, since 10 reviewed boxes stand along it")
    assert "annotator up p wall --clear" in message
    up = up_of(project)
    assert up is not None
    assert np.degrees(np.arccos(up @ UP)) < 4
    frame = FrameSource(project).read(project.frames.of()[0])
    assert orientation_for(BoxRotation.AUTO, frame) is Orientation.UPRIGHT
    assert learn_up(project) == ()


@pytest.mark.parametrize("taken_back", ["undo", "clear"])
def test_a_direction_that_was_taken_back_is_not_set_again(project: Project, taken_back: str) -> None:
    review(project, TURNING)
    learn_up(project)
    if taken_back == "undo":
        project.history.undo("up direction of reviewed boxes")
    else:
        project.adjustments.set_up(project.recordings.all()[0].id, None, "ann")
    assert up_of(project) is None
    assert learn_up(project) == ()


def test_boxes_that_do_not_tell_are_left_alone(project: Project) -> None:
    review(project, TURNING[: LEAST_BOX_FRAMES - 1])
    assert learn_up(project) == ()  # too few frames
    review(project, TURNING, state=ReviewState.REJECTED)
    review(project, TURNING, kind=BoxKind.SILHOUETTE)
    assert learn_up(project) == ()  # not reviewed, not whole
    assert up_of(project) is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"turns": np.full(FRAMES, 0.4)},  # never turned: each of its axes is shared
        {"turns": TURNING, "up": np.array([0.7, -0.7, 0.1]) / np.linalg.norm([0.7, -0.7, 0.1])},  # lies
        {"turns": TURNING, "lean_deg": 30.0},
    ],
)
def test_boxes_that_do_not_stand_or_do_not_turn_are_left_alone(project: Project, wrong: dict[str, object]) -> None:
    review(project, **wrong)  # type: ignore[arg-type]
    assert learn_up(project) == ()


def test_a_set_rotation_and_a_known_direction_stay(tmp_path: Path, wall: Path) -> None:
    for number, rotation in enumerate((BoxRotation.FREE, BoxRotation.UPRIGHT)):
        settings = ProjectSettings(rotation=rotation)
        with create_project(tmp_path, f"set{number}", ("person",), settings=settings) as project:
            register_recording(project, open_recording(wall))
            review(project, TURNING)
            assert learn_up(project) == ()
    with create_project(tmp_path, "known", ("person",)) as project:
        register_recording(project, open_recording(wall), up=(0.0, -1.0, 0.0))
        review(project, TURNING)
        assert learn_up(project) == ()
        assert up_of(project) == pytest.approx([0, -1, 0])
    folder = shutil.copytree(wall, tmp_path / "wall")
    (folder / "gravity.json").write_text('{"up": [0, -1, 0]}')
    with create_project(tmp_path, "files", ("person",)) as project:
        register_recording(project, open_recording(folder))
        review(project, TURNING)
        assert learn_up(project) == ()


def test_the_batch_says_it_and_proposes_upright_boxes(
    project: Project, knowing: Callable[..., Detectors], generated: Path
) -> None:
    review(project, TURNING)
    done = annotate(project, knowing("people"), RcvConfig(max_steps=1), limit=1)
    assert len(done.learned) == 1
    assert up_of(project) is not None
    assert annotate(project, knowing("people"), RcvConfig(max_steps=1), limit=1).learned == ()


def test_a_training_learns_it_unless_it_is_refused(project: Project) -> None:
    review(project, TURNING)
    with pytest.raises(ConfigError, match="nowhere"):
        train(project, TrainPlan(image=image_defaults().model_copy(update={"pretrained": Path("nowhere.pt")})))
    assert up_of(project) is None
    train(project, TrainPlan(), roles=())
    assert up_of(project) is not None


def test_an_estimate_uses_the_boxes_if_the_frames_do_not_tell(project: Project) -> None:
    recording = project.recordings.all()[0].id
    assert estimate_recording_up(project, recording).up is None
    review(project, TURNING)
    found = estimate_recording_up(project, recording)
    assert found.up is not None
    assert np.degrees(np.arccos(np.dot(found.up, UP))) < 4
    assert found.reason == "10 reviewed boxes stand along it and are turned about it"
    assert up_of(project) is None


def test_boxes_of_another_class_that_lean_keep_the_rotation_free(project: Project) -> None:
    review(project, TURNING)
    review(project, TURNING, up=np.array([0.6, -0.6, 0.5]) / np.linalg.norm([0.6, -0.6, 0.5]), label="hand")
    assert learn_up(project) == ()


WIDTH, HEIGHT = 8, 6
BOX = {"label": "wall", "center": [0, 0, 1], "size": [2, 2, 0.1], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """An RGB-D folder of the frames a and b without labels: a wall at 1 m."""
    return write_rgbd(tmp_path, dict(zip("ab", rgbd_samples.wall(2).values(), strict=True)))


def put(path: Path, content: Any) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(content))


@pytest.mark.shared
@pytest.mark.parametrize("folder", ["kitti", "kitti_drive_0005", "human_turn", "hand_gesture"])
def test_true_boxes_contain_points(shared: Path, folder: str) -> None:
    """A wrong coordinate frame, size order or frame number would give boxes in empty space."""
    recording = open_recording(shared / "data" / folder)
    found = held = 0
    for index in range(0, len(recording), 5):
        frame = recording.frame(index)
        for truth in load_truth(recording, index, frame):
            found += 1
            held += int(contains(truth.box, frame.cloud.xyz_m).sum()) >= 5
    assert found >= 4
    assert held >= 0.8 * found


def test_missing_labels_are_an_error_but_a_frame_without_objects_is_not(room: Path) -> None:
    recording = open_recording(room)
    frame = recording.frame(0)
    assert not has_truth(recording)
    with pytest.raises(RecordingError, match=r"no true boxes; looked for truth/boxes\.json or boxes\.json"):
        load_truth(recording, 0, frame)
    put(room / "boxes.json", {"a": [BOX, {**BOX, "label": "shelf"}]})
    assert has_truth(recording)
    assert [truth.label for truth in load_truth(recording, 0, frame)] == ["wall", "shelf"]
    assert load_truth(recording, 1, recording.frame(1)) == []
    # the folder `truth` has precedence, and a changed file is read again
    for boxes in (BOX, [BOX, BOX]):
        put(room / "truth/boxes.json", {"a": boxes})
        assert [truth.label for truth in load_truth(recording, 0, frame)] == ["wall"] * (1 + (boxes is not BOX))


def test_tracking_labels_have_the_transform_of_each_frame(room: Path) -> None:
    row = "{} {} Car 0 0 0 0 0 9 9 1.5 1.6 4.0 1.0 1.5 10.0 0.3\n"
    (room / "label_02.txt").write_text("".join(row.format(n, n) for n in range(3)))
    frame = open_recording(room).frame(0)
    drive = KittiTracking(room, ("0", "1", "2", "3"), room, "image_02", "velodyne")
    for index in range(3):
        T = RigidTransform.from_translation([index, 0.0, 0.0])
        (truth,) = load_truth(drive, index, replace(frame, T_camera_label=T))
        assert truth.track_id == index
        np.testing.assert_allclose(truth.box.center_m, [1 + index, 0.75, 10])
    assert load_truth(drive, 3, frame) == []
    far = RigidTransform.from_translation([1e9, 0.0, 0.0])
    with pytest.raises(FormatError, match=r"label_02\.txt: frame 1: a box must be within .*; correct its boxes or its"):
        load_truth(drive, 1, replace(frame, T_camera_label=far))
    (room / "label_02.txt").write_text(row.format(0, 7) * 2)
    assert len(load_truth(drive, 0, frame)) == 2
    in_degrees = row.format(0, 7).replace("0.3", "170")
    (room / "label_02.txt").write_text(in_degrees + "0 -1 DontCare -1 -1 -10 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10\n")
    with pytest.raises(UnitError, match="is no angle in radians"):
        load_truth(drive, 0, frame)
    assert [area.right for area in dont_care_rows(drive, "0")] == [9]


@pytest.mark.parametrize("folder", ["mask", "truth/mask"])
def test_masks_are_read_and_their_size_is_checked(room: Path, folder: str) -> None:
    recording = open_recording(room)
    frame = recording.frame(0)
    assert load_mask(recording, frame) is None
    (room / folder).mkdir(parents=True)
    path = room / folder / "a.png"
    with pytest.raises(FormatError, match="cannot be read"):
        load_mask(recording, frame)
    cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH + 1), np.uint8))
    with pytest.raises(FormatError, match=r"the mask is \(9, 6\) pixels, the image \(8, 6\)"):
        load_mask(recording, frame)
    numbers = np.arange(WIDTH * HEIGHT, dtype=np.uint8).reshape(HEIGHT, WIDTH) % 3
    cv2.imwrite(str(path), numbers)
    np.testing.assert_array_equal(load_mask(recording, frame), numbers)


def beside(project: Project) -> RecordedLabels:
    return RecordedLabels(project, with_files=True)


class Changed(LabelSet):
    """The labels beside a recording, changed by a test.

    Args:
        change: returns the objects of a frame, from its name, and its objects.
        frames: names; None = all of `base`.
    """

    def __init__(
        self,
        base: RecordedLabels,
        change: Callable[[str, list[Truth]], list[Truth]],
        frames: Sequence[str] | None = None,
    ) -> None:
        super().__init__(base.path, dict.fromkeys(base.frames if frames is None else frames, LabelledFrame(())))
        self.base, self.change = base, change

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return self.change(name, self.base.truths(name, frame))


def no_skip(stored: StoredFrame, error: FrameError) -> None:
    raise error


def test_only_2d_boxes_are_stored_and_they_are_training_data(people: Project) -> None:
    done = boxes_from_3d(people, beside(people), fraction=0.4)
    assert (done.chosen, done.frames, done[Note.DRAWN], list(done.of(Note.UNREADABLE))) == (2, 2, 0, [])
    assert people.statistics().labels.total == 0
    on_images, views = people.boxes.on_images(), people.boxes.on_views()
    assert [(x.box_kind, x.source, x.author) for x in on_images] == [(BoxKind.BOX, Source.IMPORTED, AUTHOR)] * 2
    assert {(x.box_kind, x.source) for x in views} == {(BoxKind.BOX, Source.IMPORTED)}
    assert done.boxes == Counter(person=sum(len(x.boxes) for x in on_images))
    assert Counter(view.step for view in views) == {0: 2 * done.objects["person"], 1: 2 * done.objects["person"]}
    assert done.view_boxes == sum(len(x.boxes) for x in views) > len(views) == done.views
    # the three people occlude each other, but all are in the image
    assert done.objects["person"] + done.of(Note.WITHOUT_VIEWS)["person"] + done.of(Note.HIDDEN)["person"] == 6

    material = gather(people, tuple(DetectorKind))
    assert (material.kind, material.views_of_kind) == (BoxKind.BOX, material.views)
    images = list(image_samples(people, material, no_skip))
    taught = list(view_samples(people, material, rcv_config(people), SampleConfig(), no_skip))
    assert (len(images), len(taught)) == (2, len(views))
    assert {sample.origin for sample in images + taught} == {DRAWN}
    assert [len(sample.boxes) for sample in taught] == [len(view.boxes) for view in views]


def moved(labels: RecordedLabels, by_m: float) -> LabelSet:
    shift = np.array([by_m, 0.0, 0.0])

    def change(name: str, truths: list[Truth]) -> list[Truth]:
        boxes = [OrientedBox.from_parts(t.box.center_m + shift, t.box.rotation, t.box.size_m) for t in truths]
        return [replace(t, box=box) for t, box in zip(truths, boxes, strict=True)]

    return Changed(labels, change)


def test_repeating_changes_nothing_and_other_boxes_replace_the_old_ones(people: Project) -> None:
    labels = beside(people)
    first = boxes_from_3d(people, labels, fraction=0.2)
    last = people.log.last()
    assert boxes_from_3d(people, labels, fraction=0.2) == first
    assert (first.in_all, people.log.last()) == (1, last)
    before = {view.view_id for view in people.boxes.on_views()}
    boxes_from_3d(people, moved(labels, 0.03), fraction=0.2)
    (on_image,) = people.boxes.on_images()
    now = people.boxes.on_views()
    assert {view.geometry.image_box for view in now if view.geometry} <= set(on_image.boxes)
    assert not before & {view.view_id for view in now}


def test_drawn_boxes_and_finalised_frames_are_not_changed(people: Project) -> None:
    first, second, *_ = people.frames.of()
    mine = (Box2D("person", 10.0, 10.0, 50.0, 50.0),)
    people.boxes.set_on_image(first.id, mine, BoxKind.SILHOUETTE, WriteContext(first.revision, "me"))

    def meanwhile(name: str, truths: list[Truth]) -> list[Truth]:
        """An operator draws on the second frame while its views are rendered."""
        if name == f"people/{second.key}":
            people.boxes.set_on_image(second.id, mine, BoxKind.SILHOUETTE, WriteContext(second.revision, "me"))
        return truths

    labels, third = beside(people), people.frames.of()[2]
    people.frames.finalise(third.id, WriteContext(third.revision, "me"))
    done = boxes_from_3d(people, Changed(labels, meanwhile, labels.frames[:4]))
    assert (done.chosen, done[Note.DRAWN], done.frames) == (4, 3, 1)
    assert people.boxes.on_image(third.id) is None
    for stored in (first, second):
        boxes = people.boxes.on_image(stored.id)
        assert boxes is not None
        assert (boxes.boxes, boxes.author) == (mine, "me")
        assert people.boxes.on_views_of(stored.id) == ()


def test_corrected_views_are_kept(people: Project) -> None:
    labels = beside(people)
    first = boxes_from_3d(people, labels, fraction=0.2)
    before = {view.view_id: view for view in people.boxes.on_views()}
    view = next(iter(before.values()))
    better = (replace(view.boxes[0], x_max=view.boxes[0].x_max + 1.5),)
    context = WriteContext(people.frames.get(view.frame_id).revision, "import", Source.IMPORTED)
    people.boxes.set_on_view(
        view.view_id, better, BoxKind.BOX, context, frame_id=view.frame_id, step=view.step, geometry=view.geometry
    )
    again = boxes_from_3d(people, labels, fraction=0.2)
    assert (again.frames, again[Note.OTHERS_VIEWS]) == (1, 1)
    assert (again.views + 1, again.view_boxes + len(view.boxes)) == (first.views, first.view_boxes)
    after = {each.view_id: each for each in people.boxes.on_views()}
    assert (after[view.view_id].boxes, after[view.view_id].author) == (better, "import")
    assert {key: each.boxes for key, each in after.items() if key != view.view_id} == {
        key: each.boxes for key, each in before.items() if key != view.view_id
    }


def test_without_labels_beside_the_recordings_the_error_names_them(own_copy, make_project) -> None:
    folder = own_copy("people")
    (folder / "truth" / "boxes.json").unlink()
    with pytest.raises(ConfigError, match=r"no 3D boxes lie beside the recordings \(people\)"):
        beside(make_project(folder))


def test_boxes_of_other_classes_are_an_error_that_names_them(people: Project) -> None:
    people.configure(classes=["hand"])
    with pytest.raises(ConfigError, match=r"1 frame without a box of hand \(other classes there: person\)"):
        boxes_from_3d(people, beside(people), fraction=0.1)
    assert people.boxes.on_views() == ()


@pytest.mark.parametrize("fraction", [0.0, 1.01, float("nan")])
def test_an_invalid_fraction_is_an_error(fraction: float) -> None:
    with pytest.raises(ConfigError, match="cannot take a fraction of"):
        share_of([("a", "0")], fraction, 0)


NAMES = st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 60).map(str)), min_size=1, max_size=90, unique=True)


@given(NAMES, st.floats(0.01, 1), st.floats(0.01, 1), st.integers(0, 9), st.randoms(use_true_random=False))
def test_the_selection_does_not_depend_on_the_order_and_is_even_over_recordings(
    names, one, other, seed, random
) -> None:
    taken = share_of(names, one, seed)
    assert len(taken) == max(1, round(one * len(names)))
    shuffled = list(names)
    random.shuffle(shuffled)
    assert share_of(shuffled, one, seed) == taken
    small, large = sorted((one, other))
    assert share_of(names, small, seed) <= share_of(names, large, seed)
    for recording, length in Counter(recording for recording, _ in names).items():
        got = sum(name[0] == recording for name in taken)
        assert abs(got - one * length) <= 2
