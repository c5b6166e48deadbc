"""The simulated operator confirms whole boxes of what it has drawn."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest

from annotator.geometry.iou import iou_3d
from annotator.project import BoxRotation, Origin, Project
from annotator.rcv.config import RcvConfig
from annotator.rcv.whole_box import Offered, SeenObject
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Correction
from annotator.web.context import Caches
from annotator.workflows import simulate_whole
from annotator.workflows.add_recordings import move_recording
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.simulate import simulate_recording
from annotator.workflows.simulate_whole import FITS_IOU, confirm_whole_boxes
from annotator.workflows.training.samples import gather
from annotator.workflows.workbench import whole_boxes as workbench
from annotator.workflows.workbench.whole_boxes import WholeBoxes


@pytest.fixture
def drawn(people: Project, monkeypatch: pytest.MonkeyPatch) -> Project:
    """People drawn as they are seen, in a project without a detector."""
    monkeypatch.setattr(simulate_whole, "ready_view", lambda project: None)
    simulate_recording(people, people.recordings.all()[0].id, BoxKind.SILHOUETTE, RcvConfig(), every=2)
    return people


def test_boxes_that_fit_become_labels_beside_the_silhouettes(drawn: Project, generated: Path) -> None:
    recording, silhouettes = drawn.recordings.all()[0].id, drawn.boxes.on_views()
    confirmed = confirm_whole_boxes(drawn, recording)
    labels = drawn.labels.select()
    assert confirmed.objects == 9 and 0 < confirmed.confirmed == len(labels) <= 9
    assert confirmed.actions >= confirmed.confirmed
    assert drawn.boxes.on_views() == silhouettes
    truths = open_recording(generated / "people")
    for stored in labels:
        assert (stored.origin, stored.label.box_kind) == (Origin.DRAWN, BoxKind.BOX)
        assert stored.image_box is not None and stored.image_box in drawn.boxes.on_image(stored.frame_id).boxes
        index = [frame.id for frame in drawn.frames.of()].index(stored.frame_id)
        true_boxes = [truth.box for truth in load_truth(truths, index, truths.frame(index))]
        assert max(iou_3d(stored.label.box, box) for box in true_boxes) >= FITS_IOU
    assert gather(drawn).whole.keys() == {(stored.frame_id, stored.image_box) for stored in labels}


def test_confirming_again_asks_only_about_the_others(drawn: Project) -> None:
    recording = drawn.recordings.all()[0].id
    first = confirm_whole_boxes(drawn, recording)
    again = confirm_whole_boxes(drawn, recording)
    assert (again.objects, again.confirmed) == (first.objects - first.confirmed, 0)


def test_only_objects_with_all_silhouettes_have_whole_boxes(drawn: Project) -> None:
    stored = drawn.frames.of()[0]
    image_box = drawn.boxes.on_image(stored.id).boxes[0]
    offers = WholeBoxes(drawn)
    frame = FrameSource(drawn).read(stored)
    assert offers.of(frame, stored, image_box, None)
    never_drawn = Box2D(image_box.label, 1.0, 1.0, 9.0, 9.0)
    assert offers.of(frame, stored, never_drawn, None) == []


def test_another_setting_for_the_rotation_applies_at_once(drawn: Project) -> None:
    stored = drawn.frames.of()[0]
    image_box, frame = drawn.boxes.on_image(stored.id).boxes[0], FrameSource(drawn).read(stored)
    offers = WholeBoxes(drawn)
    upright = offers.of(frame, stored, image_box, None)
    drawn.configure(settings=drawn.config.settings.model_copy(update={"rotation": BoxRotation.FREE}))
    free = offers.of(frame, stored, image_box, None)
    expected = WholeBoxes(drawn).of(frame, stored, image_box, None)
    assert [one.box.size_m.tolist() for one in free] == [one.box.size_m.tolist() for one in expected]
    assert [one.box.size_m.tolist() for one in free] != [one.box.size_m.tolist() for one in upright]


def test_a_correction_of_the_calibration_applies_at_once(drawn: Project) -> None:
    stored = drawn.frames.of()[0]
    image_box, offers = drawn.boxes.on_image(stored.id).boxes[0], WholeBoxes(drawn)
    before = offers.of(FrameSource(drawn).read(stored), stored, image_box, None)
    drawn.adjustments.correct(stored.recording_id, Correction(shift_m=(0.0, 0.0, 0.2)), "Ann")
    frame = FrameSource(drawn).read(stored)
    corrected = [one.box.center_m.tolist() for one in offers.of(frame, stored, image_box, None)]
    assert corrected == [one.box.center_m.tolist() for one in WholeBoxes(drawn).of(frame, stored, image_box, None)]
    assert corrected != [one.box.center_m.tolist() for one in before]


def test_frames_of_a_moved_recording_are_read_at_their_new_place(
    drawn: Project, own_copy: Callable[[str], Path]
) -> None:
    caches, recording, here = Caches(), drawn.recordings.all()[0].id, own_copy("people")
    move_recording(drawn, recording, here, "Ann")
    first, second = [frame for frame in drawn.frames.of() if drawn.boxes.on_views_of(frame.id)][:2]
    offers = caches.whole_boxes(drawn)
    assert offers._objects(first)
    there = here.rename(here.with_name("there"))
    move_recording(drawn, recording, there, "Ann")
    caches.frames.forget(drawn)  # as the server does
    assert offers._objects(second)
    caches.close()


def test_a_long_search_does_not_block_another_operators(drawn: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = drawn.frames.of()[0]
    one, other = drawn.boxes.on_image(stored.id).boxes[:2]
    offers, frame = WholeBoxes(drawn), FrameSource(drawn).read(stored)
    searching, go_on = Event(), Event()

    def search(seen: SeenObject, *_: object) -> list[Offered]:
        if seen.image_box == one:
            searching.set()
            assert go_on.wait(60)
        return []

    monkeypatch.setattr(workbench, "whole_boxes", search)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(offers.of, frame, stored, one, None)
        try:
            assert searching.wait(60)
            assert pool.submit(offers.of, frame, stored, other, None).result(60) == []
        finally:
            go_on.set()
        assert first.result(60) == []
