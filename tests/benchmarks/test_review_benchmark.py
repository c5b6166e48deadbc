"""The benchmark of reviewing: the keystroke-level model, the plans of the hand, and the simulated operator."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.project import Project, WriteContext, create_project
from annotator.project.changes import LabelTracked
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, DetectorKind, OrientedBox, Proposal, Quality, ReviewState, Source, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.recorded.reading import load_truth
from benchmarks.review import Arguments, run, without_labels
from benchmarks.review_moves import (
    CHORD_S,
    CLICK_S,
    DRAG_S,
    KEY_S,
    SHIFT_CLICK_S,
    Bill,
    M,
    moves,
    number_s,
    peers,
    plan,
    shaky,
    steady,
)
from benchmarks.review_operator import Operator

QUALITY = 0.7
BOX = OrientedBox.from_parts(
    np.array([0.5, 0.2, 8.0]), Rotation.from_euler("y", 0.4).as_matrix(), np.array([4.0, 1.8, 1.5])
)


def moved(box: OrientedBox, along: tuple[float, float, float]) -> OrientedBox:
    """A box shifted along its own axes, metres."""
    return OrientedBox.from_parts(box.center_m + box.rotation @ np.array(along), box.rotation, box.size_m)


def test_the_model_adds_up() -> None:
    bill = Bill(looks=2)
    bill.act("accept", KEY_S)
    bill.act("drag edge", DRAG_S)
    total = bill + Bill(looks=1, waiting_s=0.5)
    assert total.seconds == pytest.approx(0.28 + 2.4 + 3 * 1.35 + 0.5)
    assert total.actions == {"accept": 1, "drag edge": 1}
    assert (CLICK_S, number_s(4)) == (pytest.approx(1.3), pytest.approx(1.3 + 0.8 + 5 * 0.28))
    # Shift is a keystroke
    assert pytest.approx(2 * 0.28) == CHORD_S
    assert pytest.approx(CLICK_S + 0.28) == SHIFT_CLICK_S


def test_a_shared_action_is_divided_and_remains_one_in_all() -> None:
    bills = [Bill() for _ in range(3)]
    for bill in bills:
        bill.act("accept all", CHORD_S, among=3)
        assert (bill.count, bill.seconds) == (pytest.approx(1 / 3), pytest.approx(CHORD_S / 3))
    bills[0].act("undo", CHORD_S)
    bills[0].act("undo", CHORD_S)
    total = sum(bills, Bill())
    assert total.by_kind == {"undo": 2.0, "accept all": 1.0}
    assert list(total.by_kind) == ["undo", "accept all"]
    assert total.count == 3.0


@pytest.mark.parametrize(
    ("steps", "boxes", "actions", "seconds"),
    [
        (1, 4, {"next box": 1}, KEY_S),
        (2, 3, {"previous box": 1}, CHORD_S),
        (2, 4, {"next box": 2}, 2 * KEY_S),
        (3, 4, {"previous box": 1}, CHORD_S),
        (6, 12, {"select": 1}, CLICK_S),
    ],
)
def test_the_way_to_another_box_is_the_quickest(
    steps: int, boxes: int, actions: dict[str, int], seconds: float
) -> None:
    bill = Bill()
    Operator._select(steps, boxes, bill)
    assert bill.actions == actions
    assert bill.hands_s == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("wrong", "kinds"),
    [
        (moved(BOX, (1.0, 0.8, 0.0)), ["drag box"]),
        (OrientedBox.from_parts(BOX.center_m, BOX.rotation, BOX.size_m * [0.5, 1, 1]), ["type number"]),
        (moved(OrientedBox.from_parts(BOX.center_m, BOX.rotation, BOX.size_m * [0.65, 1, 1]), (0.7, 0.0, 0.0)), None),
        (moved(BOX, (1.0, 0.8, 0.7)), ["drag box", "drag box"]),
        (
            OrientedBox.from_parts(BOX.center_m, BOX.rotation @ Rotation.from_euler("z", 0.6).as_matrix(), BOX.size_m),
            ["turn"],
        ),
    ],
)
def test_the_shortest_way_is_found(wrong: OrientedBox, kinds: list[str] | None) -> None:
    """`kinds` None: one drag of an edge or of a corner with it."""
    assert iou_3d(wrong, BOX) < QUALITY
    way = plan(wrong, BOX, QUALITY, moves())
    found = [move.kind for move in way]
    assert found == kinds if kinds is not None else found in (["drag edge"], ["drag corner"])
    for move in way:
        wrong = move.apply(wrong, BOX, steady)
    assert iou_3d(wrong, BOX) >= QUALITY


def test_the_hand_errs_by_pixels_of_the_view() -> None:
    edge = next(move for move in moves() if move.kind == "drag edge")
    hand = shaky(np.random.default_rng(0), 2.0)
    errors = [edge.apply(BOX, BOX, hand).size_m - BOX.size_m for _ in range(400)]
    # the view is 1.7 times as wide as the box is long, on 320 pixels
    assert np.linalg.norm(np.std(errors, axis=0)) == pytest.approx(2 * 4.0 * 1.7 / 320, rel=0.3)


@pytest.fixture
def people(generated: Path) -> Path:
    return generated / "people"


@pytest.fixture
def room(people: Path, tmp_path: Path) -> Project:
    """A project of the generated recording without labels."""
    project = create_project(tmp_path, "room", ["person"])
    register_recording(project, open_recording(people))
    return project


def truths_of(people: Path) -> list[list[Truth]]:
    recording = open_recording(people)
    return [load_truth(recording, index, recording.frame(index)) for index in range(len(recording))]


def propose(project: Project, boxes: list[list[OrientedBox]]) -> None:
    """One proposal for each box, in the order of the frames."""
    for stored, each in zip(project.frames.of(), boxes, strict=True):
        image_box = Box2D("person", 1.0, 2.0, 30.0, 40.0)
        new = [Proposal("person", 0.8, box, image_box, (), Quality(0.1, 0.9, 0.1)) for box in each]
        project.proposals.replace(stored.id, new, WriteContext(stored.revision, "rcv", Source.AUTO))


def reviewed(project: Project, with_sheets: bool = False) -> Operator:
    operator = Operator(project, project.frames.of(), QUALITY, 2.0, 0)
    operator.review(with_sheets)
    return operator


def total(operator: Operator) -> Bill:
    return sum(operator.desk.bills.values(), Bill())


def test_right_proposals_cost_a_look_each_and_a_key_a_frame(room: Project, people: Path) -> None:
    truths = truths_of(people)
    propose(room, [[truth.box for truth in each] for each in truths])
    operator = reviewed(room)
    left, bill = operator.left(), total(operator)
    count = sum(len(each) for each in truths)
    assert (left.missed, left.wrong) == (0, 0)
    several = sum(len(each) > 1 for each in truths)
    alone = sum(len(each) == 1 for each in truths)
    assert bill.actions == {name: times for name, times in (("accept all", several), ("accept", alone)) if times}
    assert bill.seconds - bill.waiting_s == pytest.approx(
        count * M + several * CHORD_S + alone * KEY_S + len(truths) * M
    )
    states = {label.state for frame in room.frames.of() for label in room.labels.of_frame(frame.id)}
    assert states == {ReviewState.ACCEPTED}


def test_the_key_that_accepts_several_boxes_is_divided_among_their_tracks(room: Project, people: Path) -> None:
    truths = truths_of(people)
    propose(room, [[truth.box for truth in each] for each in truths])
    operator = reviewed(room)
    shares: dict[int | None, Fraction] = {}
    for each in truths:
        for truth in each:
            if len(each) > 1:
                shares[truth.track_id] = shares.get(truth.track_id, Fraction(0)) + Fraction(1, len(each))
    assert len(shares) > 1
    booked = {key[1]: bill.actions["accept all"] for key, bill in operator.desk.bills.items() if key is not None}
    assert booked == shares


def test_the_row_from_nothing_uses_no_detector_of_the_project(room: Project, people: Path) -> None:
    propose(room, [[truth.box for truth in each] for each in truths_of(people)])
    for role in DetectorKind:
        weights = room.models_folder / role.value / "detector.safetensors"
        weights.parent.mkdir(parents=True)
        weights.touch()
        room.models.register(role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=role.value)
        assert room.models.active(role) is not None
    without_labels(room)
    assert [room.models.active(role) for role in DetectorKind] == [None, None]
    assert not room.labels.count(list(ReviewState))


def test_wrong_proposals_are_corrected_missing_ones_drawn_others_rejected(room: Project, people: Path) -> None:
    truths = truths_of(people)
    boxes = [[truth.box for truth in each] for each in truths]
    boxes[0][0] = moved(boxes[0][0], (0.3, 0.0, 0.0))
    missing = boxes[1].pop()
    boxes[2].append(moved(boxes[2][0], (0.0, 0.0, 5.0)))
    propose(room, boxes)
    operator = reviewed(room)
    left, bill = operator.left(), total(operator)
    assert (left.missed, left.wrong) == (0, 0)
    assert bill.actions["reject"] == 1
    assert bill.actions["draw on image"] == 1
    assert sum(bill.actions[kind] for kind in ("drag box", "drag edge", "drag corner", "refit", "draw on view")) >= 1
    drawn = room.labels.of_frame(room.frames.of()[1].id)
    assert max(iou_3d(label.box, missing) for label in drawn) >= QUALITY


def test_one_click_on_a_sheet_accepts_what_is_before_a_lost_object(room: Project, people: Path) -> None:
    boxes = [each[0].box for each in truths_of(people)]
    boxes[-1] = moved(boxes[-1], (3.0, 0.0, 0.0))
    propose(room, [[box] for box in boxes])
    frames = room.frames.of()
    for frame in frames:
        (label,) = room.labels.of_frame(frame.id)
        revision = room.frames.get(frame.id).revision
        room.log.append(frame.id, [LabelTracked(uid=label.uid, track_id=7)], WriteContext(revision, "Ada"))
    operator = Operator(room, frames, QUALITY, 2.0, 0)
    operator._use_sheet(7, frames[0])
    assert total(operator).actions == {"open sheet": 1, "correct from here": 1}
    assert operator._left_sheets == {7}
    states = [room.labels.of_frame(frame.id)[0].state for frame in frames]
    assert states == [ReviewState.ACCEPTED] * (len(frames) - 1) + [ReviewState.PROPOSED]
    # the page shows the sheet again, which costs no key
    operator._use_sheet(7, frames[0], is_back=True)
    assert total(operator).actions == {"open sheet": 1, "correct from here": 2}


def test_peers_pay_for_each_box() -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) * BOX.size_m @ BOX.rotation.T + BOX.center_m
    figures = peers([(BOX, points)], QUALITY, steady)
    assert set(figures) == {"SUSTechPOINTS", "CVAT", "labelCloud"}
    # the points fill the box, so that the fit is right
    assert figures["SUSTechPOINTS"]["actions_per_box"] == 1
    assert figures["labelCloud"]["actions_per_box"] == 5
    assert figures["CVAT"]["actions_per_box"] > 5, "a cube is no car"
    assert all(row["failures"] == 0 for row in figures.values())


def test_bad_arguments_say_what_is_possible(people: Path) -> None:
    with pytest.raises(ConfigError, match="unknown word 'all'; choose from proposals, base_detector"):
        run(Arguments(people, only="all"))
    with pytest.raises(ConfigError, match="has 5 frames; 10 of them teach"):
        run(Arguments(people))
