"""A simulated operator of the Review page, who knows where the objects are and does only what the page offers.

Each action calls the functions that the page's requests call, and is stored in the project as a person's. The operator
- looks before each decision: at a box on the image and in its three views, at a frame for objects without a box, at
  each picture of a contact sheet;
- looks at the small pictures of all boxes of a frame, corrects the wrong ones, and accepts the others with one key;
- drags with an error of `error_px` pixels of the picture, looks again, and corrects what is not good enough yet;
- cannot foresee what "Fit again", a new box on the image, or following a corrected box will give, and tries them when
  that pays on average, by how often they have helped so far.
- waits for what the page has not loaded before: it loads the frame and the pictures of the queue's next box while the
  operator is busy with this one.

The model has no errors of judgement: where an object ends is known as well where no point shows it.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from annotator.geometry.iou import iou_3d, iou_3d_matrix
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import box_on_image
from annotator.image_bytes import encoded_image
from annotator.project import REVIEWED, Origin, Project, StoredFrame
from annotator.project.changes import LabelChanged, NewLabel
from annotator.project.records import BoxRecord
from annotator.rcv.known_objects import draw_object
from annotator.rcv.teach import project_box
from annotator.types import Box2D, BoxKind, Label, OrientedBox, PseudoView, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.tracks.follow_run import follow_from_frame
from annotator.workflows.training.held_out import inaccurate
from annotator.workflows.workbench.contact_sheet import picture
from annotator.workflows.workbench.drawing_steps import frame_config, label_config, label_steps
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import ready_view, view_with_classes
from annotator.workflows.workbench.refit import find_box, refit
from benchmarks.review_desk import AUTHOR, Desk, Thing
from benchmarks.review_moves import CHORD_S, CLICK_S, DRAG_S, KEY_S, SHIFT_CLICK_S, Bill, M, moves, plan, shaky

# The operator gives up on a box after so many actions.
MOST_ACTIONS = 15


class Corrections:
    """Corrects boxes, and remembers which ways helped."""

    def __init__(self, desk: Desk, error_px: float, rng: np.random.Generator) -> None:
        self._desk, self._rng = desk, rng
        self._hand, self._error_px = shaky(rng, error_px), error_px
        self._ready, self._moves = ready_view(desk.project), moves()
        self._tries: Counter[str] = Counter()
        self._helped: Counter[str] = Counter()
        # the class that the page gives to the next box that is drawn
        self.shown_class = desk.project.config.classes[0]

    def corrected(
        self, frame: StoredFrame, box: OrientedBox, thing: Thing, bill: Bill, can_redraw: bool, margin: float = 0.0
    ) -> tuple[OrientedBox, bool]:
        """Corrects a box until it is good enough; returns it, and whether it was drawn anew.

        `margin` is how much better than right it is to be, share of the way to a perfect one.
        """
        quality = self._desk.quality + margin * (1 - self._desk.quality)
        tried = set() if can_redraw else {"redraw"}
        actions, is_new = 0, False
        while iou_3d(box, thing.box) < quality and actions < MOST_ACTIONS:
            drags = plan(box, thing.box, quality, self._moves)
            by_hand_s = sum(move.seconds + M for move in drags)
            offers = {"drag": by_hand_s} if drags else {}
            for kind, seconds in (("refit", KEY_S), ("redraw", DRAG_S + 2 * KEY_S)):
                if kind not in tried:
                    chance = (self._helped[kind] + 1) / (self._tries[kind] + 2)
                    offers[kind] = seconds + self._desk.waits[kind] + M + (1 - chance) * by_hand_s
            if not offers:  # it is somewhere else
                break
            choice = min(offers, key=lambda kind: offers[kind])
            actions += 1
            if choice == "drag":
                bill.act(drags[0].kind, drags[0].seconds)
                box = drags[0].apply(box, thing.box, self._hand)
            else:
                tried.add(choice)
                self._tries[choice] += 1
                found = self._refitted(frame, box, thing, bill) if choice == "refit" else self.drawn(frame, thing, bill)
                if found is not None:
                    is_better = iou_3d(found, thing.box) > iou_3d(box, thing.box)
                    self._helped[choice] += iou_3d(found, thing.box) >= quality
                    if is_better:
                        box, is_new = found, is_new or choice == "redraw"
                    else:
                        self._desk.look(frame, found, bill)
                        bill.act("undo", CHORD_S)
            self._desk.look(frame, box, bill)
        return box, is_new

    def _refitted(self, frame: StoredFrame, box: OrientedBox, thing: Thing, bill: Bill) -> OrientedBox:
        opened, ready = self._desk.open(frame), self._ready
        config = frame_config(self._desk.project, opened.frame, ready)
        bill.act("refit", KEY_S)
        return self._desk.wait("refit", bill, lambda: refit(opened, box, thing.label, config, ready)).box or box

    def drawn(self, frame: StoredFrame, thing: Thing, bill: Bill) -> OrientedBox | None:
        """Draws an object on the image; where no box is found, on the four views, too. None if it cannot be drawn."""
        opened, ready = self._desk.open(frame), self._ready
        camera = opened.frame.camera
        outline = box_on_image(camera, thing.box, thing.label)
        errors_px = self._rng.normal(0, self._error_px, 4)
        image_box = None if outline is None else inaccurate(camera, outline, errors_px)
        if image_box is None:
            return None
        if thing.label != self.shown_class:
            bill.act("class", KEY_S)
            self.shown_class = thing.label
        bill.act("draw on image", DRAG_S)
        config = frame_config(self._desk.project, opened.frame, ready)
        found = self._desk.wait("redraw", bill, lambda: find_box(opened, image_box, config, ready)).box
        is_there = found is not None and iou_3d(found, thing.box) > 0
        return found if is_there else self._on_views(opened, image_box, thing, bill)

    def _on_views(self, opened: OpenFrame, image_box: Box2D, thing: Thing, bill: Bill) -> OrientedBox | None:
        """Finishes an object in Label, on two and two views."""
        config = label_config(self._desk.project, opened.frame)

        def draw(view: PseudoView) -> Box2D | None:
            bill.looks += 1
            true = project_box(view, thing.box, thing.label)
            if true is None:
                return None
            bill.act("draw on view", DRAG_S)
            edges = np.array(true.xyxy) + self._rng.normal(0, self._error_px, 4)
            low, high = np.minimum(edges[:2], edges[2:] - 1), edges[2:]
            return Box2D(thing.label, float(low[0]), float(low[1]), float(high[0]), float(high[1]))

        drawn = draw_object(opened.with_normals, image_box, draw, config)
        if drawn is None:
            return None
        boxes = [item.box for item in drawn.views]
        return label_steps(opened, image_box, boxes, config, BoxKind.BOX, axes=drawn.views[2].view.axes).box


# A proposal is meant for an object that it overlaps by this IoU, or whose middle is that near, share of its diagonal.
SAME_IOU, SAME_DISTANCE = 0.05, 0.4
# A contact sheet is opened for so many proposals of a track; a corrected box is followed if so many are left.
SHEET_FROM, FOLLOW_FROM = 3, 3
# Followed boxes are expected to be right until so many of them were seen.
OPTIMISM = 4
# How much better than right a box is made before the later ones follow it or are corrected like it, share of the way to
# a perfect one: they inherit its errors, and add theirs.
CARE = 0.15

# So many boxes' small pictures are seen at once in the list of a frame's boxes, at 1366 x 768.
SEEN_TOGETHER = 4


class Left(NamedTuple):
    """What a review leaves: number of visible objects, of those without a right box, and of boxes of no object."""

    boxes: int
    missed: int
    wrong: int


class Operator:
    """Reviews frames of one recording, in time order, with a standard deviation `error_px` of the hand's error."""

    def __init__(
        self, project: Project, frames: Sequence[StoredFrame], quality: float, error_px: float, seed: int
    ) -> None:
        self.desk = Desk(project, frames, quality)
        self._corrections = Corrections(self.desk, error_px, np.random.default_rng(seed))
        self._on_sheets: set[int] = set()
        # tracks whose sheet was left to correct a box: it comes back when that is followed
        self._left_sheets: set[int] = set()
        # uids of boxes that following has made
        self._made: set[str] = set()
        self._right: Counter[object] = Counter()
        self._seen: Counter[object] = Counter()

    # -- the ways to review

    def review(self, with_sheets: bool) -> None:
        """Reviews the proposals of each frame in time order, draws what is missing, and follows it.

        `with_sheets` opens the contact sheet of each track first, and accepts the right boxes there.
        """
        for number, frame in enumerate(self.desk.frames):
            if with_sheets:
                self._use_sheets(frame)
            if number and not self.desk.open_labels(frame):
                # the queue opens only frames with proposals
                self.desk.bills[None].act("next frame", KEY_S)
            self._review_frame(frame)

    def left(self) -> Left:
        """Compares what is stored with the true objects."""
        boxes = missed = wrong = 0
        for frame in self.desk.frames:
            things = self.desk.things(frame)
            labels = [label for label in self.desk.labels(frame) if label.state in REVIEWED]
            boxes += sum(thing.due for thing in things)
            right = [any(self.desk.is_right(label, thing) for label in labels) for thing in things]
            missed += sum(thing.due and not found for thing, found in zip(things, right, strict=True))
            wrong += sum(not any(self.desk.is_right(label, thing) for thing in things) for label in labels)
        return Left(boxes, missed, wrong)

    def due_objects(self) -> Iterator[tuple[Thing, np.ndarray]]:
        """Yields the visible objects of all frames, each with the points inside it, (n, 3)."""
        for frame in self.desk.frames:
            for thing in self.desk.things(frame):
                if thing.due:
                    xyz_m = self.desk.open(frame).frame.cloud.xyz_m
                    yield thing, xyz_m[contains(thing.box, xyz_m)]

    # -- one frame

    def _review_frame(self, frame: StoredFrame) -> None:
        self.desk.enter(frame)
        things = self.desk.things(frame)
        labels = self.desk.open_labels(frame)
        done = [label for label in self.desk.labels(frame) if label.state in REVIEWED]
        has = {id(thing) for thing in things if any(self.desk.is_right(label, thing) for label in done)}
        meant = meant_for(labels, [thing for thing in things if id(thing) not in has])
        together = self._seen_together(frame, labels, meant)
        has |= {id(meant[label.uid]) for label in together}
        selected = 0
        for number, label in enumerate(labels):
            thing = meant.get(label.uid)
            if label in together:
                continue
            if together:
                self._select(number - selected, len(labels), self.desk.bills[None if thing is None else thing.key])
                selected = number
            if thing is not None and self._review(frame, label, thing, moves_on=not together):
                has.add(id(thing))
            elif thing is None:
                self.desk.look(frame, label.box, self.desk.bills[None], is_ahead=True)
                self.desk.bills[None].act("reject", KEY_S)
                self.desk.store(frame, [LabelChanged(uid=label.uid, state=ReviewState.REJECTED)])
        if together:
            for label in together:
                self.desk.bills[meant[label.uid].key].act("accept all", CHORD_S, among=len(together))
            self.desk.store(frame, [LabelChanged(uid=label.uid, state=ReviewState.ACCEPTED) for label in together])
        self.desk.bills[None].looks += 1  # is there an object without a box?
        for thing in things:
            if thing.due and id(thing) not in has:
                self._draw_missing(frame, thing)

    @staticmethod
    def _select(steps: int, boxes: int, bill: Bill) -> None:
        """Selects another box of the frame, with Tab and Shift+Tab or with the mouse."""
        ahead, back = steps % boxes, -steps % boxes
        seconds, keys, kind = min((ahead * KEY_S, ahead, "next box"), (back * CHORD_S, back, "previous box"))
        if seconds > CLICK_S:
            bill.act("select", CLICK_S)
        else:
            for _ in range(keys):
                bill.act(kind, seconds / keys)

    def _seen_together(self, frame: StoredFrame, labels: Sequence[Label], meant: dict[str, Thing]) -> list[Label]:
        """Looks at the small pictures of a frame's proposals, if it has several, but not more than are
        seen at once; returns the right ones."""
        if not 2 <= len(labels) <= SEEN_TOGETHER:
            return []
        opened = self.desk.open(frame)
        begin = time.perf_counter()
        for label in labels:
            encoded_image(picture(opened.frame, label.box))
        self.desk.waited(self.desk.bills[None], time.perf_counter() - begin, is_ahead=True)
        self.desk.ahead_since_s = self.desk.spent_s()
        for label in labels:
            self.desk.bills[meant[label.uid].key if label.uid in meant else None].looks += 1
        right = [label for label in labels if label.uid in meant and self.desk.is_right(label, meant[label.uid])]
        for label in right:
            self._count(label, is_right=True)
        return right

    def _review(self, frame: StoredFrame, label: Label, thing: Thing, *, moves_on: bool) -> bool:
        """Reviews a proposal of an object; returns whether the object now has a right box.

        `moves_on` with the key that accepts it; else a key accepts the others of the frame afterwards.
        """
        bill = self.desk.bills[thing.key]
        self.desk.look(frame, label.box, bill, is_ahead=True)
        if not thing.due and iou_3d(label.box, thing.box) < self.desk.quality:
            bill.act("reject", KEY_S)
            self.desk.store(frame, [LabelChanged(uid=label.uid, state=ReviewState.REJECTED)])
            return False
        name = label.label
        self._corrections.shown_class = thing.label
        if name != thing.label:
            bill.act("class", KEY_S)
        was_right = self.desk.is_right(label, thing)
        self._count(label, was_right)
        margin = 0.0 if was_right or not self._has_later(frame, label) else CARE
        box, is_new = self._corrections.corrected(frame, label.box, thing, bill, can_redraw=True, margin=margin)
        if is_new:
            # the new box stays selected
            for kind in ("accept", "next box", "reject"):
                bill.act(kind, KEY_S)
            self.desk.store(frame, [LabelChanged(uid=label.uid, state=ReviewState.REJECTED), self._created(thing, box)])
        elif box is label.box and name == thing.label:
            if moves_on:
                bill.act("accept", KEY_S)
            self.desk.store(frame, [LabelChanged(uid=label.uid, state=ReviewState.ACCEPTED)])
        else:
            # the page saves a correction by itself
            edit = LabelChanged(uid=label.uid, state=ReviewState.EDITED, label=thing.label, box=BoxRecord.of(box))
            moved = self.desk.store(frame, [edit])
            has_moved = not was_right and self._help_later(frame, label, moved, bill)
            if moves_on and not has_moved:
                bill.act("accept", KEY_S)
        return iou_3d(box, thing.box) >= self.desk.quality

    def _count(self, label: Label, is_right: bool) -> None:
        """Remembers how often proposals of a track were right, and those that following has made."""
        for what in (label.track_id, *(["follow"] if label.uid in self._made else [])):
            self._seen[what] += 1
            self._right[what] += is_right

    def _help_later(self, frame: StoredFrame, label: Label, moved: int, bill: Bill) -> bool:
        """Follows a corrected box, in place of the later proposals of its track, if that promises to help more than
        that `moved` of these were corrected with it.

        Returns whether the page has gone on to the next box.
        """
        if not self._has_later(frame, label) or label.track_id is None:
            return False
        chance = (self._right["follow"] + OPTIMISM) / (self._seen["follow"] + OPTIMISM)
        own = (self._right[label.track_id] + 1) / (self._seen[label.track_id] + 2)
        # one key: worth a try; what it made before drifts: begin anew
        helped = (label.uid in self._made or (chance > own and not moved)) and self._follow(frame, label.uid, bill)
        if helped and label.track_id in self._left_sheets:
            # the page shows the sheet again
            self._use_sheet(label.track_id, frame, is_back=True)
        return helped

    def _has_later(self, frame: StoredFrame, label: Label) -> bool:
        """Whether it pays to help the later proposals of a box's track."""
        return label.track_id is not None and len(self._shown(label.track_id, frame)) >= FOLLOW_FROM

    def _draw_missing(self, frame: StoredFrame, thing: Thing) -> None:
        """Draws an object, and follows it if the recording has later frames."""
        bill = self.desk.bills[thing.key]
        box = self._corrections.drawn(frame, thing, bill)
        if box is None:
            return
        self.desk.look(frame, box, bill)
        is_last = frame.id == self.desk.frames[-1].id
        margin = 0.0 if is_last else CARE
        box, _ = self._corrections.corrected(frame, box, thing, bill, can_redraw=False, margin=margin)
        created = self._created(thing, box)
        self.desk.store(frame, [created])
        if is_last:
            bill.act("accept", KEY_S)
        else:
            # this key also accepts a new box
            self._follow(frame, created.uid, bill)

    def _follow(self, frame: StoredFrame, uid: str, bill: Bill) -> bool:
        """Follows a reviewed or new box; returns False if there is no later frame."""
        bill.act("follow", KEY_S)
        view = view_with_classes(self.desk.project)

        def run() -> float:
            revision = self.desk.project.frames.get(frame.id).revision
            followed = follow_from_frame(self.desk.project, frame.id, revision, view, AUTHOR, uid=uid)
            begin = time.perf_counter()
            times_s: list[float] = []
            followed.run(lambda _: times_s.append(time.perf_counter() - begin))
            # the page shows the first box at once, and the others are found while the operator reviews
            later = pairwise(times_s)
            return times_s[0] + sum(max(0.0, after - before - (M + KEY_S)) for before, after in later)

        before = {label.uid for _, label in self._all_open()}
        try:
            self.desk.waits["follow"] = run()
        except ConfigError:
            return False  # there is no later box: the page says so
        bill.waiting_s += self.desk.waits["follow"]
        new = [label for _, label in self._all_open() if label.uid not in before]
        self._made |= {label.uid for label in new}
        self._on_sheets -= {label.track_id for label in new if label.track_id is not None}
        return True

    # -- contact sheets

    def _use_sheets(self, frame: StoredFrame) -> None:
        """Opens the sheet of each track in a frame that had none yet. It is that of the selected box."""
        labels, selected = self.desk.open_labels(frame), 0
        for place, label in enumerate(labels):
            if label.track_id is None or label.track_id in self._on_sheets:
                continue
            if len(self._shown(label.track_id, frame)) >= SHEET_FROM:
                self._select(place - selected, len(labels), self.desk.bills[None])
                selected = place
            self._use_sheet(label.track_id, frame)

    def _use_sheet(self, track: int, first: StoredFrame, *, is_back: bool = False) -> None:
        """Accepts the right boxes of a track on its contact sheet, which the page opens by itself if it `is_back`; the
        others stay proposals."""
        shown = self._shown(track, first)
        self._left_sheets.discard(track)
        if len(shown) < (1 if is_back else SHEET_FROM):
            return
        self._on_sheets.add(track)
        verdicts = [(frame, label, self._thing_at(frame, label)) for frame, label in shown]
        keys = Counter(thing.key for _, _, thing in verdicts if thing is not None)
        bill = self.desk.bills[keys.most_common(1)[0][0] if keys else None]
        if not is_back:
            bill.act("open sheet", KEY_S)
        if any(thing is None for _, _, thing in verdicts):
            self._left_sheets.add(track)
        for place, (frame, label, thing) in enumerate(verdicts):
            bill.looks += 1
            self._count(label, thing is not None)
            if thing is not None:
                self.desk.store(frame, [LabelChanged(uid=label.uid, state=ReviewState.ACCEPTED)])
                continue
            is_last = place + 1 == len(verdicts)
            if is_last or (label.uid in self._made and verdicts[place + 1][2] is None):
                # it drifted, or no other comes: one click (Ctrl) accepts what is before it, and opens it
                bill.act("correct from here", SHIFT_CLICK_S)
                bill.looks += not is_last
                return
            bill.act("click out", CLICK_S)
        bill.act("accept sheet", KEY_S)

    def _shown(self, track: int, first: StoredFrame) -> list[tuple[StoredFrame, Label]]:
        """The proposals of a track, from a frame on."""
        indices = [frame.id for frame in self.desk.frames]
        later = set(indices[indices.index(first.id) :])
        return [(frame, label) for frame, label in self._all_open() if label.track_id == track and frame.id in later]

    def _all_open(self) -> list[tuple[StoredFrame, Label]]:
        return [(frame, label) for frame in self.desk.frames for label in self.desk.open_labels(frame)]

    def _thing_at(self, frame: StoredFrame, label: Label) -> Thing | None:
        """The object of which a label is a right box."""
        return next((thing for thing in self.desk.things(frame) if self.desk.is_right(label, thing)), None)

    @staticmethod
    def _created(thing: Thing, box: OrientedBox) -> NewLabel:
        # the page gives a drawn box no track, also where it replaces a proposal of one
        return NewLabel(thing.label, box, origin=Origin.DRAWN)


def meant_for(labels: Sequence[Label], things: Sequence[Thing]) -> dict[str, Thing]:
    """Which object each label is meant for, by uid: the nearest; an object has one label at most."""
    if not labels or not things:
        return {}
    ious = iou_3d_matrix([label.box for label in labels], [thing.box for thing in things])
    centers = np.stack([label.box.center_m for label in labels])[:, None] - np.stack([t.box.center_m for t in things])
    reach_m = SAME_DISTANCE * np.array([float(np.linalg.norm(thing.box.size_m)) for thing in things])
    nearness = 1.0 - np.linalg.norm(centers, axis=2) / reach_m
    ranks = np.where(ious >= SAME_IOU, 1.0 + ious, nearness)
    meant: dict[str, Thing] = {}
    for place in np.argsort(-ranks, axis=None, kind="stable"):
        row, column = np.unravel_index(place, ranks.shape)
        if ranks[row, column] <= 0:
            break
        if labels[row].uid not in meant and things[column] not in meant.values():
            meant[labels[row].uid] = things[column]
    return meant
