"""The simulated operator: five boxes per object from the ground truth, and whole boxes that it confirms."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from annotator.geometry.oriented_box import contains
from annotator.project import BoxRotation, Project
from annotator.rcv.config import RcvConfig
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Correction, Source
from annotator.types.errors import ConfigError, FrameError, RecordingError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.simulate import MIN_VISIBLE_POINTS, simulate_recording, visible_objects
from annotator.workflows.workbench.drawing_steps import WholeBoxes


def simulated(project: Project, kind: BoxKind, every: int = 1):
    (recording,) = project.recordings.all()
    return simulate_recording(project, recording.id, kind, RcvConfig(), every)


@pytest.mark.parametrize("kind", list(BoxKind))
def test_five_boxes_per_object_are_drawn(people: Project, kind: BoxKind) -> None:
    drawn = simulated(people, kind, every=2)
    assert drawn.frames == 3
    assert drawn.objects == 3 * 3
    assert drawn.boxes == (1 + 4) * drawn.objects
    counts = people.statistics()
    assert (counts.image_boxes.pictures, counts.image_boxes.boxes) == (3, 9)
    assert (counts.view_boxes.pictures, counts.view_boxes.boxes) == (36, 36)
    # true boxes are labels, too
    assert counts.labels.total == (drawn.objects if kind is BoxKind.BOX else 0)
    views = people.boxes.on_views()
    assert Counter(view.step for view in views) == {0: 18, 1: 18}
    assert {(view.box_kind, view.source) for view in views} == {(kind, Source.MANUAL)}
    assert all(people.views.load(view.view_id).any() for view in views)
    labelled = {boxes.frame_id for boxes in people.boxes.on_images()}
    assert [frame.id in labelled for frame in people.frames.of()] == [True, False, True, False, True]


def test_silhouettes_on_the_image_enclose_the_mask(people: Project) -> None:
    """They enclose exactly the pixels of the mask that have a depth."""
    simulated(people, BoxKind.SILHOUETTE, every=5)
    recording = open_recording(people.recordings.all()[0].path)
    frame = recording.frame(0)
    mask = cv2.imread(str(recording.path / "truth" / "mask" / f"{frame.key}.png"), cv2.IMREAD_UNCHANGED)
    (boxes,) = people.boxes.on_images()
    assert frame.depth_m is not None
    for number, box in enumerate(boxes.boxes, 1):
        rows, columns = np.nonzero((mask == number) & (frame.depth_m > 0))
        assert box.xyxy == pytest.approx((columns.min(), rows.min(), columns.max(), rows.max()), abs=1e-3)


def test_simulating_again_replaces_the_boxes(people: Project) -> None:
    first = simulated(people, BoxKind.BOX, every=2)
    before = people.statistics()
    assert simulated(people, BoxKind.BOX, every=2) == first
    after = people.statistics()
    assert after.labels == before.labels
    assert (after.image_boxes, after.view_boxes) == (before.image_boxes, before.view_boxes)


def two_classes(folder: Path) -> Path:
    """Changes the class of the second of three people to robot; masks are unchanged."""
    file = folder / "truth" / "boxes.json"
    content = json.loads(file.read_text())
    for entries in content.values():
        entries[1]["label"] = "robot"
    file.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(
    ("classes", "numbers"), [(("person",), (1, 3)), (("robot",), (2,)), (("robot", "person"), (1, 2, 3))]
)
def test_mask_numbers_count_objects_of_all_classes(
    own_copy: Callable[[str], Path], classes: tuple[str, ...], numbers: tuple[int, ...]
) -> None:
    recording = open_recording(two_classes(own_copy("people")))
    frame = recording.frame(0)
    mask = cv2.imread(str(recording.path / "truth" / "mask" / f"{frame.key}.png"), cv2.IMREAD_UNCHANGED)
    assert frame.cloud.pixel_index is not None
    found = visible_objects(recording, 0, frame, classes)
    assert len(found) == len(numbers)
    for item, number in zip(found, numbers, strict=True):
        assert item.label == ("robot" if number == 2 else "person")
        np.testing.assert_array_equal(item.points, mask.ravel()[frame.cloud.pixel_index] == number)


def test_without_a_mask_the_objects_points_are_those_in_its_box(own_copy: Callable[[str], Path]) -> None:
    folder = own_copy("people")
    for path in (folder / "truth" / "mask").iterdir():
        path.unlink()
    (folder / "truth" / "mask").rmdir()
    recording = open_recording(folder)
    frame = recording.frame(0)
    objects = visible_objects(recording, 0, frame, ["person"])
    assert len(objects) == 3
    for item in objects:
        np.testing.assert_array_equal(item.points, contains(item.box, frame.cloud.xyz_m))


def test_an_occluded_object_is_not_drawn(own_copy: Callable[[str], Path]) -> None:
    folder = own_copy("people")
    path = folder / "truth" / "mask" / "000000.png"
    mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    hidden = np.flatnonzero(mask.ravel() == 2)[MIN_VISIBLE_POINTS - 1 :]
    mask.ravel()[hidden] = 0
    cv2.imwrite(str(path), mask)
    recording = open_recording(folder)
    assert len(visible_objects(recording, 0, recording.frame(0), ["person"])) == 2


def masks_only(folder: Path) -> Path:
    (folder / "truth" / "boxes.json").unlink()
    return folder


def test_silhouettes_can_be_drawn_from_masks_alone(people: Project, own_copy: Callable[[str], Path]) -> None:
    stored = register_recording(people, open_recording(masks_only(own_copy("people"))))
    drawn = simulate_recording(people, stored.id, BoxKind.SILHOUETTE, RcvConfig(), every=4)
    assert drawn == simulate_recording(people, people.recordings.all()[0].id, BoxKind.SILHOUETTE, RcvConfig(), every=4)
    with_boxes, without = (people.boxes.on_images([r.id]) for r in people.recordings.all())
    assert [b.boxes for b in with_boxes] == [b.boxes for b in without]
    assert all(len(b.boxes) == 3 for b in without)


@pytest.mark.parametrize("boxes", [True, False])
def test_masks_belong_to_the_image_if_the_depth_has_another_size(own_copy: Callable[[str], Path], boxes: bool) -> None:
    folder = own_copy("people") if boxes else masks_only(own_copy("people"))
    path = folder / "depth" / "000000.png"
    cv2.imwrite(str(path), np.ascontiguousarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2]))
    recording = open_recording(folder)
    frame = recording.frame(0)
    assert frame.cloud.pixel_index is None
    mask = cv2.imread(str(folder / "truth" / "mask" / "000000.png"), cv2.IMREAD_UNCHANGED)
    objects = visible_objects(recording, 0, frame, ("person",))
    assert len(objects) > 1
    # a depth pixel covers two by two pixels of the image
    for number, item in enumerate(objects, 1):
        around = np.stack([mask[dv::2, du::2] for dv in (0, 1) for du in (0, 1)]) == number
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0
        assert (
            np.count_nonzero(raw & around.all(axis=0))
            <= item.points.sum()
            <= np.count_nonzero(raw & around.any(axis=0))
        )


def without_truth(folder: Path) -> Path:
    shutil.rmtree(folder / "truth")
    return folder


@pytest.mark.parametrize(
    ("change", "kind", "classes", "every", "problem"),
    [
        (masks_only, BoxKind.BOX, ("person",), 1, "`box` needs true boxes"),
        (masks_only, BoxKind.SILHOUETTE, ("person", "robot"), 1, r"class of an object \(person, robot\) is unknown"),
        (without_truth, BoxKind.BOX, ("person",), 1, r"people: has no true boxes; looked for .*boxes\.json"),
        (Path, BoxKind.BOX, ("robot",), 1, "no visible true boxes of robot"),
        (Path, BoxKind.BOX, ("person",), 0, "give 1 or more"),
    ],
)
def test_what_cannot_be_simulated_is_refused(
    make_project: Callable[..., Project],
    own_copy: Callable[[str], Path],
    change: Callable[[Path], Path],
    kind: BoxKind,
    classes: tuple[str, ...],
    every: int,
    problem: str,
) -> None:
    project = make_project(change(own_copy("people")), classes=classes)
    with pytest.raises((ConfigError, RecordingError), match=problem):
        simulated(project, kind, every)
    assert project.statistics().image_boxes.boxes == 0


def test_a_broken_frame_is_an_error_and_earlier_boxes_are_kept(
    people: Project, own_copy: Callable[[str], Path]
) -> None:
    folder = own_copy("people")
    depth = folder / "depth" / "000001.png"
    depth.write_bytes(depth.read_bytes()[:1000])
    stored = register_recording(people, open_recording(folder))
    with pytest.raises(FrameError, match=r"depth/000001\.png"):
        simulate_recording(people, stored.id, BoxKind.SILHOUETTE, RcvConfig())
    assert people.statistics().image_boxes.pictures == 1


@pytest.fixture
def drawn(prepared: Callable[..., Project]) -> Project:
    """People drawn as they are seen, in a project without a detector."""
    return prepared("drawn_silhouettes", lambda project: simulated(project, BoxKind.SILHOUETTE, every=2))


def test_other_settings_and_corrections_apply_at_once_to_objects_with_all_silhouettes(drawn: Project) -> None:
    stored = drawn.frames.of()[0]
    image_box, offers = drawn.boxes.on_image(stored.id).boxes[0], WholeBoxes(drawn)

    def offered(offers: WholeBoxes, box: Box2D = image_box) -> list[list[float]]:
        found = offers.of(FrameSource(drawn).read(stored), stored, box, None)
        return [[*one.box.center_m.tolist(), *one.box.size_m.tolist()] for one in found]

    assert offered(offers, Box2D(image_box.label, 1.0, 1.0, 9.0, 9.0)) == [], "never drawn"
    seen = [offered(offers)]
    drawn.configure(settings=drawn.config.settings.model_copy(update={"rotation": BoxRotation.FREE}))
    seen.append(offered(offers))
    drawn.adjustments.correct(stored.recording_id, Correction(shift_m=(0.0, 0.0, 0.2)), "Ann")
    seen.append(offered(offers))
    assert seen[2] == offered(WholeBoxes(drawn)) and seen[0] != seen[1] != seen[2]
