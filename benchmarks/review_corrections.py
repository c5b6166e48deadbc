"""How the simulated operator of Review corrects a box, or draws an object."""

from __future__ import annotations

from collections import Counter

import numpy as np

from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.project import StoredFrame
from annotator.rcv.known_objects import draw_object
from annotator.rcv.teach import project_box
from annotator.types import Box2D, BoxKind, OrientedBox, PseudoView
from annotator.workflows.training.held_out import inaccurate
from annotator.workflows.workbench.drawing_steps import frame_config, label_config, label_steps
from annotator.workflows.workbench.loaded_detectors import ready_view
from annotator.workflows.workbench.open_frame import OpenFrame
from annotator.workflows.workbench.refit import find_box, refit
from benchmarks.keystrokes import CHORD_S, DRAG_S, KEY_S, Bill, M
from benchmarks.review_desk import Desk, Thing
from benchmarks.review_moves import moves, plan, shaky

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

        Args:
            margin: how much better than right it is to be, share of the way to a perfect one.
        """
        quality = self._desk.quality + margin * (1 - self._desk.quality)
        tried = set() if can_redraw else {"redraw"}
        actions, is_new = 0, False
        while iou_3d(box, thing.box) < quality and actions < MOST_ACTIONS:
            drags = plan(box, thing.box, quality, self._moves)
            by_hand_s = sum(move.seconds + M for move in drags)
            offers = {"drag": by_hand_s}
            for kind, seconds in (("refit", KEY_S), ("redraw", DRAG_S + 2 * KEY_S)):
                if kind not in tried:
                    chance = (self._helped[kind] + 1) / (self._tries[kind] + 2)
                    offers[kind] = seconds + self._desk.waits[kind] + M + (1 - chance) * by_hand_s
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
        return self._desk.wait("refit", bill, lambda: refit(opened, box, thing.label, config, ready)).box

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
        return self._on_views(opened, image_box, thing, bill) if found is None else found

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
        # the page has changed to Label by itself
        bill.act("back to Review", KEY_S)
        return label_steps(opened, image_box, boxes, config, BoxKind.BOX, axes=drawn.views[2].view.axes).box
