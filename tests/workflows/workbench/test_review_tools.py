"""Views along a box's own axes and contact sheets, fitting a box again, and copying boxes of the previous frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains, same_box
from annotator.geometry.outline import box_on_image
from annotator.project import Effort, NewLabel, Project, WriteContext
from annotator.project.changes import LabelChanged
from annotator.rcv.config import Orientation, RcvConfig, TypicalSize
from annotator.recordings import open_recording
from annotator.types import (
    Box2D,
    BoxKind,
    Label,
    OrientedBox,
    PointCloud,
    Proposal,
    Quality,
    ReviewState,
    Source,
    Truth,
)
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.contact_sheet import (
    FRONT,
    GAP,
    GAP_PX,
    LINE,
    VIEW_PX,
    SeenBox,
    accept_boxes,
    picture,
    views_of_points,
)  # fmt: skip
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.refit import next_unlabelled, place_box, place_on_ground, refit
from annotator.workflows.workbench.save_object import copy_boxes


@pytest.fixture(scope="module")
def opened(generated: Path) -> OpenFrame:
    return OpenFrame(open_recording(generated / "people").frame(2))


@pytest.fixture(scope="module")
def truths(generated: Path, opened: OpenFrame) -> list[Truth]:
    return list(load_truth(open_recording(generated / "people"), 2, opened.frame))


# What is on the right, above and nearest in each view: an axis of the box (length, width, height), and its end. The
# positive ends are front, left and top.
SEEN = {
    "top": ((1, -1), (0, 1), (2, 1)),
    "front": ((1, 1), (2, 1), (0, 1)),
    "side": ((0, 1), (2, 1), (1, -1)),
}


@pytest.mark.parametrize("name", SEEN)
def test_a_view_shows_the_side_that_it_is_named_after(name: str) -> None:
    """Each side of a box of points has its own colour, also in a box with any rotation."""
    rotation = Rotation.from_euler("xyz", [0.3, -0.8, 2.1]).as_matrix()
    box = OrientedBox.from_parts(np.array([0.4, -0.2, 5.0]), rotation, np.array([4.0, 2.0, 1.5]))
    grid = np.stack(np.meshgrid(*[np.linspace(-0.45, 0.45, 90)] * 2), axis=-1).reshape(-1, 2)
    xyz, rgb, colors = [], [], dict[tuple[int, int], np.ndarray]()
    for axis in range(3):
        for end in (-1, 1):
            colors[axis, end] = np.full(3, 40 + 30 * (2 * axis + (end > 0)), np.uint8)
            xyz.append(np.insert(grid, axis, 0.5 * end, axis=1) * box.size_m)
            rgb.append(np.tile(colors[axis, end], (len(grid), 1)))
    cloud = PointCloud((np.concatenate(xyz) @ rotation.T + box.center_m).astype(np.float32), np.concatenate(rgb))
    larger = OrientedBox(box.pose, box.size_m * 1.001)
    view = views_of_points(cloud, np.arange(len(cloud)), larger, 200)[name]
    right, above, nearest = SEEN[name]
    np.testing.assert_allclose(view.axes[0], right[1] * rotation[:, right[0]], atol=1e-12)
    np.testing.assert_allclose(view.axes[1], -above[1] * rotation[:, above[0]], atol=1e-12)
    np.testing.assert_allclose(view.axes[2], -nearest[1] * rotation[:, nearest[0]], atol=1e-12)
    assert (view.rgb[100, 100] == colors[nearest]).all(), "the nearest side hides the others"


def put_off(box: OrientedBox, up: np.ndarray | None, seed: int = 1) -> OrientedBox:
    rng = np.random.default_rng(seed)
    vector = 0.3 * up if up is not None else rng.normal(0, 0.15, 3)
    turn = Rotation.from_rotvec(vector).as_matrix()
    center = box.center_m + rng.normal(0, 0.06, 3) * box.size_m
    return OrientedBox.from_parts(center, turn @ box.rotation, box.size_m * 1.1)


@pytest.mark.parametrize("kind", list(BoxKind))
def test_refitting_improves_a_displaced_box(
    opened: OpenFrame, truths: list[Truth], knowing: Callable[..., Detectors], kind: BoxKind
) -> None:
    config = RcvConfig(orientation=Orientation.UPRIGHT, box_kind=kind)
    better = []
    for number, truth in enumerate(truths):
        off = put_off(truth.box, opened.frame.up, number)
        found = refit(opened, off, truth.label, config, knowing("people", kind).view)
        assert found.note is None and found.quality is not None
        better.append(iou_3d(found.box, truth.box) - iou_3d(off, truth.box))
        # the heading stays on its side
        assert found.box.rotation[:, 0] @ off.rotation[:, 0] > 0.7
        assert found.box.rotation[:, 2] @ off.rotation[:, 2] > 0.7
    assert np.mean(better) > (0.2 if kind is BoxKind.BOX else 0.05)


def test_without_a_detector_the_box_is_fitted_to_the_points_with_a_note(opened: OpenFrame, truths: list[Truth]) -> None:
    box = truths[0].box
    wide = OrientedBox(box.pose, box.size_m + 0.02)
    found = refit(opened, wide, "person", RcvConfig(), None)
    assert found.quality is None
    assert found.note is not None and "no pseudo-view detector yet" in found.note
    assert np.allclose(found.box.rotation, box.rotation)
    assert (found.box.size_m <= wide.size_m + 1e-6).all()
    inside = opened.frame.cloud.xyz_m[contains(wide, opened.frame.cloud.xyz_m)]
    assert contains(found.box, inside, 1e-4).all()


def test_an_unknown_class_or_missing_object_gives_a_note(
    opened: OpenFrame, truths: list[Truth], knowing: Callable[..., Detectors]
) -> None:
    detector = knowing("people").view
    found = refit(opened, truths[0].box, "horse", RcvConfig(), detector)
    assert found.note is not None and "was not trained on horse" in found.note
    empty = OrientedBox.from_parts(np.array([0.0, 0.0, -5.0]), np.eye(3), np.ones(3))
    found = refit(opened, empty, "person", RcvConfig(), detector)
    assert found.note is not None and "found no object" in found.note and "the box is unchanged" in found.note
    assert found.box is empty


def label_at(x: float, track: int | None = None) -> NewLabel:
    box = OrientedBox.from_parts(np.array([x, 0.0, 3.0]), np.eye(3), np.array([0.6, 0.5, 1.7]))
    return NewLabel("person", box, track_id=track)


class Copying:
    """A project whose boxes are copied from frame to frame."""

    def __init__(self, project: Project) -> None:
        self.project, self.ids = project, [frame.id for frame in project.frames.of()]

    def context(self, index: int, author: str = "ann", effort: Effort | None = None) -> WriteContext:
        return WriteContext(self.project.frames.get(self.ids[index]).revision, author, effort=effort)

    def create(self, index: int, *labels: NewLabel) -> tuple[str, ...]:
        return self.project.labels.create(self.ids[index], labels, self.context(index)).uids

    def copy(self, index: int, source: int | None = None, **more: Any) -> None:
        copy_boxes(
            self.project, self.ids[index], None if source is None else self.ids[source], self.context(index, **more)
        )

    def labels(self, index: int) -> list[Label]:
        return list(self.project.labels.of_frame(self.ids[index]))

    def edit(self, index: int, label: Label, x: float) -> None:
        box = label_at(x).box
        self.project.labels.edit(self.ids[index], label.uid, self.context(index), label="person", box=box)

    def reject(self, index: int, uid: str) -> None:
        self.project.labels.reject(self.ids[index], uid, self.context(index))


@pytest.fixture
def copying(people: Project) -> Copying:
    return Copying(people)


def test_boxes_of_the_previous_frame_are_copied_once(copying: Copying) -> None:
    uids = copying.create(0, label_at(0.0, 7), label_at(2.0), label_at(4.0))
    copying.reject(0, uids[2])
    copying.create(1, label_at(9.0, 7))
    copying.copy(1)
    _, copied = copying.labels(1)
    assert (copied.state, copied.track_id) == (ReviewState.PROPOSED, None)
    assert same_box(copied.box, label_at(2.0).box)
    copying.project.labels.accept(copying.ids[1], copied.uid, copying.context(1))
    for index, source, match in (
        (1, None, r"^nothing was copied: a reviewed box is here already$"),
        (0, None, "this is the first frame of its recording"),
        (0, 0, "cannot be copied into itself"),
    ):
        with pytest.raises(ConfigError, match=match):
            copying.copy(index, source)
    with pytest.raises(StaleRevisionError):
        copy_boxes(copying.project, copying.ids[2], copying.ids[0], WriteContext(5, "ann"))
    copying.copy(2, 0)
    assert len(copying.labels(2)) == 2


def test_boxes_that_cannot_be_copied_are_refused_with_the_reason(copying: Copying) -> None:
    project, (uid,) = copying.project, copying.create(0, label_at(0.0, 7))
    copying.reject(0, uid)
    with pytest.raises(ConfigError, match=r"copied: the other frame has no reviewed boxes$"):
        copying.copy(1)
    project.history.undo("ann")
    (other,) = propose(project, copying.ids[1], label_at(0.0).box)
    project.log.append(copying.ids[1], [LabelChanged(uid=other, track_id=9)], copying.context(1, "bob"))
    match = "copied: a proposal of track 9 is here; if it is the same object, give both one track$"
    with pytest.raises(ConfigError, match=match):
        copying.copy(1)
    project.frames.finalise(copying.ids[1], copying.context(1))
    with pytest.raises(ConfigError, match=r"^this frame is finalised; reopen it first$"):
        copying.copy(1)
    assert [label.uid for label in copying.labels(1)] == [other]


def test_a_copy_takes_the_place_of_a_proposal_and_stands_where_a_wrong_box_was_rejected(copying: Copying) -> None:
    copying.create(0, label_at(0.0, 7), label_at(2.0), label_at(4.0))
    copying.copy(1)
    moved, wrong, right = copying.labels(1)
    copying.edit(1, right, 4.3)
    copying.reject(1, wrong.uid)
    copying.copy(1)
    # that of track 7 anew, and another one where one was rejected; the reviewed box at the third place covers the copy
    assert [(label.state, label.box.center_m[0], label.track_id) for label in copying.labels(1)] == [
        (ReviewState.REJECTED, 2.0, None),
        (ReviewState.EDITED, 4.3, None),
        (ReviewState.PROPOSED, 0.0, 7),
        (ReviewState.PROPOSED, 2.0, None),
    ]
    copying.project.history.undo("ann")
    assert [label.uid for label in copying.labels(1)] == [moved.uid, wrong.uid, right.uid]


def propose(project: Project, frame_id: int, *boxes: OrientedBox) -> tuple[Any, ...]:
    found = [
        Proposal("person", 0.8, box, Box2D("person", 1.0, 2.0, 30.0, 40.0), (), Quality(0.1, 0.9, 0.1)) for box in boxes
    ]
    context = WriteContext(project.frames.get(frame_id).revision, "rcv", Source.AUTO)
    return project.proposals.replace(frame_id, found, context).uids


@pytest.fixture
def project(people: Project) -> Project:
    """With one proposal in each frame."""
    for frame in people.frames.of():
        propose(people, frame.id, label_at(0.0).box)
    return people


def seen(project: Project) -> list[SeenBox]:
    return [
        SeenBox(frame.id, frame.revision, label.uid)
        for frame in project.frames.of()
        for label in project.labels.of_frame(frame.id)
    ]


def states(project: Project) -> list[ReviewState]:
    return [project.labels.get(each.uid).label.state for each in seen(project)]


def test_boxes_of_several_frames_are_accepted_and_undone_together(project: Project) -> None:
    *right, wrong = seen(project)
    accept_boxes(project, right, "Ada", Effort(3, 12.0))
    assert states(project) == [ReviewState.ACCEPTED] * len(right) + [ReviewState.PROPOSED]
    efforts = [event.effort for each in right for event in project.log.of_frame(each.frame_id) if event.effort]
    assert efforts == [Effort(3, 12.0)], "the effort is counted once"
    revision = project.frames.get(wrong.frame_id).revision
    assert revision == wrong.revision
    project.history.undo("Ada")
    assert set(states(project)) == {ReviewState.PROPOSED}


def test_what_has_changed_since_is_refused_and_nothing_is_stored(project: Project) -> None:
    boxes = seen(project)
    last = boxes[-1]
    project.labels.reject(last.frame_id, last.uid, WriteContext(last.revision, "Ben"))
    with pytest.raises(ConfigError, match="open the sheet again"):
        accept_boxes(project, boxes, "Ada")
    stale = [*boxes[:-2], SeenBox(boxes[-2].frame_id, boxes[-2].revision - 1, boxes[-2].uid)]
    with pytest.raises(StaleRevisionError):
        accept_boxes(project, stale, "Ada")
    with pytest.raises(NotFoundError):
        accept_boxes(project, [SeenBox(1, 1, "0" * 32)], "Ada")
    with pytest.raises(ConfigError, match="no box is chosen"):
        accept_boxes(project, [], "Ada")
    assert set(states(project)[:-1]) == {ReviewState.PROPOSED}


def test_a_picture_shows_three_views_and_the_box_on_them(generated: Path) -> None:
    recording = open_recording(generated / "people")
    frame = recording.frame(0)
    box = load_truth(recording, 0, frame)[0].box
    strip = picture(frame, box)
    assert strip.shape == (VIEW_PX, 3 * VIEW_PX + 2 * GAP_PX, 3)
    assert (strip[:, VIEW_PX : VIEW_PX + GAP_PX] == GAP).all()
    front = strip[:, VIEW_PX + GAP_PX : 2 * VIEW_PX + GAP_PX]
    rows, columns = np.nonzero((front == LINE).all(axis=2))
    # the view is 1.7 times as wide as its longer side, and the box is in its middle
    scale = VIEW_PX / (1.7 * box.size_m[1:].max())
    assert np.ptp(columns) == pytest.approx(scale * box.size_m[1], abs=1.5)
    assert np.ptp(rows) == pytest.approx(scale * box.size_m[2], abs=1.5)
    assert rows.min() + rows.max() == pytest.approx(VIEW_PX - 1, abs=2)
    # the front is up in the top view, on the right in that of the right side
    top, side = strip[:, :VIEW_PX], strip[:, 2 * (VIEW_PX + GAP_PX) :]
    for part, axis, (marked, others) in ((top, 0, (0, 95)), (side, 1, (95, 0))):
        edge, outline = (np.nonzero((part == color).all(axis=2))[axis] for color in (FRONT, LINE))
        assert np.ptp(edge) == 1 and len(edge) > 20
        assert abs(edge.mean() - marked) < abs(edge.mean() - others)
        assert abs(outline.mean() - others) < abs(edge.mean() - others)
    assert not (front == FRONT).all(axis=2).any()
    moved = OrientedBox.from_parts(box.center_m + np.array([0, 0, 40.0]), box.rotation, box.size_m)
    assert (picture(frame, moved) == LINE).all(axis=2).any(), "a box without points has a picture, too"


def test_an_object_without_points_is_placed_by_its_size(opened: OpenFrame) -> None:
    size_m = (4.2, 1.8, 1.5)
    sizes = (TypicalSize(label="Zorb", size_m=size_m, spread=(0.1, 0.1, 0.1)),)
    config = RcvConfig(reviewed_sizes=sizes)
    up = np.array([0.0, -1.0, 0.0]) if opened.frame.up is None else opened.frame.up
    camera = opened.frame.camera
    for heading in ("away", "left"):
        away = np.array([0.0, 0.0, 1.0]) - up[2] * up
        away /= np.linalg.norm(away)
        left = np.cross(up, away)
        rotation = np.column_stack([away, left, up] if heading == "away" else [left, -away, up])
        true = OrientedBox.from_parts(np.array([-0.5, 0.3, 30.0]), rotation, np.array(size_m))
        drawn = box_on_image(camera, true, "zorb", min_side_px=0.0)
        assert drawn is not None
        found = place_box(opened, drawn, config)
        assert found.box is not None and found.too_few_points and "its size alone" in (found.note or "")
        np.testing.assert_allclose(found.box.center_m, true.center_m, atol=0.5)
        np.testing.assert_allclose(found.box.size_m, true.size_m)
        assert abs(found.box.rotation[:, 0] @ true.rotation[:, 0]) > 0.99
    flat = place_box(opened, replace(drawn, y_max=drawn.y_min + 1e-6), config)
    assert flat.box is None and flat.note is not None, "it would be far beyond anything that is measured"
    unknown = place_box(opened, replace(drawn, label="unheard-of"), config)
    assert unknown.box is None and "how large a unheard-of is" in (unknown.note or "")


def test_a_box_is_placed_on_the_ground_and_turned_like_what_stands_there(opened: OpenFrame) -> None:
    camera_height_m, turn = 1.7, Rotation.from_euler("y", 30, degrees=True)
    ground = np.stack(np.meshgrid(np.arange(-8, 8, 0.2), [camera_height_m], np.arange(4, 20, 0.2)), -1).reshape(-1, 3)
    rng = np.random.default_rng(3)
    size_m, middle_m = np.array([4.0, 1.6, 1.5]), np.array([1.0, camera_height_m - 0.75, 12.0])
    # length along the view, width to the side, height up, before the turn
    standing = middle_m + turn.apply(rng.uniform(-0.5, 0.5, (400, 3)) * size_m[[1, 2, 0]])
    points = np.concatenate([ground, standing]).astype(np.float32)
    frame = replace(opened.frame, cloud=PointCloud(points), up=np.array([0.0, -1.0, 0.0]))
    config = RcvConfig(reviewed_sizes=(TypicalSize(label="zorb", size_m=tuple(size_m), spread=(0.1, 0.1, 0.1)),))
    point_m = np.array([1.1, 0.0, 12.1])
    found = place_on_ground(OpenFrame(frame), point_m, "zorb", config, None)
    assert found.box is not None and found.note is None
    np.testing.assert_allclose(found.box.center_m, [1.1, camera_height_m - 0.75, 12.1], atol=0.02)
    assert abs(found.box.rotation[:, 0] @ turn.apply([0.0, 0.0, 1.0])) > np.cos(np.radians(3))
    # it is also what nobody has labelled, until it is, or was passed over
    classes = ["pedestrian", "zorb"]
    seen, label, distance_m = next_unlabelled(OpenFrame(frame), [], 0.0, classes, config)
    true = OrientedBox.from_parts(middle_m, turn.as_matrix()[:, [2, 0, 1]] * [1, -1, -1], size_m)
    assert seen.box is not None and iou_3d(seen.box, true) > 0.9 and label == "zorb"
    assert abs(distance_m - np.linalg.norm(middle_m)) < 0.5
    for boxes, beyond_m, names in (([true], 0.0, classes), ([], 13.0, classes), ([], 0.0, ["pedestrian"])):
        none = next_unlabelled(OpenFrame(frame), boxes, beyond_m, names, config)[0]
        assert none.box is None and none.note == "nothing else stands here that nobody has labelled"
    empty = replace(frame, cloud=PointCloud(points[: len(ground)]))
    alone = place_on_ground(OpenFrame(empty), point_m, "zorb", config, None).box
    assert alone is not None and abs(alone.rotation[:, 0] @ (point_m / np.linalg.norm(point_m))) > 0.999
    below_the_camera = place_on_ground(OpenFrame(empty), np.array([0.0, 5.0, 0.0]), "zorb", config, None).box
    assert below_the_camera is not None and abs(below_the_camera.rotation[2, 0]) == 1, "it looks ahead"
    unknown = place_on_ground(OpenFrame(frame), point_m, "unheard-of", config, None)
    assert unknown.box is None and "draw one on the image first" in (unknown.note or "")
