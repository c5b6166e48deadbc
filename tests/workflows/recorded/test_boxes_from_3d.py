"""2D boxes from 3D boxes: stored like drawn ones, without 3D labels; and the selection of a fraction of the frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from annotator.formats.frame_names import LabelledFrame
from annotator.project import Project, StoredFrame, WriteContext
from annotator.types import Box2D, BoxKind, DetectorKind, Frame, OrientedBox, Source, Truth
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.importing import Note
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.recorded.boxes_from_3d import AUTHOR, boxes_from_3d, share_of
from annotator.workflows.recorded.own_labels import RecordedLabels
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.samples import DRAWN, SampleConfig, gather, image_samples, view_samples


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
