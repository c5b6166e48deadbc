"""The samples that continue a class-agnostic detector."""

from __future__ import annotations

import numpy as np
from view_detectors import SEEN, WHOLE, Fixed

from annotator.detection.dataset import TrainingSample
from annotator.project import NewLabel, Origin, Project, WriteContext
from annotator.rcv.config import RcvConfig
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.simulate import image_box_of, simulate_recording, visible_objects
from annotator.workflows.training.samples import SampleConfig, agnostic_samples, gather, with_generated


def test_only_the_object_of_a_view_is_labelled_and_the_start_gives_what_is_not_known(people: Project) -> None:
    recording = people.recordings.all()[0].id
    simulate_recording(people, recording, BoxKind.SILHOUETTE, RcvConfig(), every=2)
    given = Fixed((Box2D(WHOLE, 1.0, 1.0, 60.0, 60.0, 0.9), Box2D(WHOLE, 3.0, 3.0, 9.0, 9.0, 0.8)))
    samples = list(
        agnostic_samples(people, gather(people), RcvConfig(), SampleConfig(views=24), given, lambda *_: None)
    )
    assert {sample.origin for sample in samples} == {"drawn", "taught"}
    with_boxes = [sample for sample in samples if sample.boxes]
    assert len(with_boxes) > 0.7 * len(samples)
    for sample in with_boxes:
        assert sorted(box.label for box in sample.boxes) == [SEEN, WHOLE]
        assert next(box for box in sample.boxes if box.label == WHOLE) == given.boxes[0]


def test_the_confirmed_whole_box_is_taught_beside_the_silhouette(people: Project) -> None:
    recording = people.recordings.all()[0].id
    simulate_recording(people, recording, BoxKind.SILHOUETTE, RcvConfig(), every=5)
    drawn = people.boxes.on_views()
    image_boxes = [view.geometry.image_box for view in drawn if view.geometry is not None]
    frame_id = people.frames.of()[0].id
    frame = FrameSource(people).read(people.frames.get(frame_id))
    truth = visible_objects(open_recording(people.recordings.all()[0].path), 0, frame, ["person"])[0]
    image_box = image_box_of(frame, truth, BoxKind.SILHOUETTE)
    assert image_box in image_boxes
    new = NewLabel("person", truth.box, origin=Origin.DRAWN, image_box=image_box)
    people.labels.create(frame_id, [new], WriteContext(people.frames.get(frame_id).revision, "me"))
    given = Fixed((Box2D(WHOLE, 1.0, 1.0, 60.0, 60.0, 0.9), Box2D(SEEN, 2.0, 2.0, 50.0, 50.0, 0.9)))
    samples = list(
        agnostic_samples(people, gather(people), RcvConfig(), SampleConfig(views=24), given, lambda *_: None)
    )
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


def test_generated_views_are_about_the_share_that_was_asked_for() -> None:
    own = [TrainingSample(np.zeros((64, 64, 3), np.uint8), (), "1/1", "drawn")] * 100
    assert list(with_generated(own, 0.0, 64, 0)) == own
    samples, others = (list(with_generated(own, 0.5, 64, seed)) for seed in (0, 1))
    assert samples[:100] == own
    assert 50 < len(samples) - 100 < 200
    assert {sample.origin for sample in samples[100:]} == {"generated"}
    assert not {sample.group for sample in samples[100:]} & {sample.group for sample in others[100:]}
