"""Pseudo-views labelled with other tools, COCO boxes on images, and the simulated operator that draws both."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from annotator.formats.coco import read_coco, write_coco
from annotator.formats.frame_names import PictureLabels
from annotator.geometry.oriented_box import contains
from annotator.project import BoxRotation, Project, WriteContext
from annotator.project.changes import FrameFinalised
from annotator.project.overview import FramePage
from annotator.rcv.config import RcvConfig
from annotator.rcv.teach import span_on_view
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Correction, Frame, Source
from annotator.types.errors import ConfigError, FormatError, FrameError, RecordingError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import ImportReport, Note, boxes_2d, import_image_boxes, import_view_boxes
from annotator.workflows.simulate import MIN_VISIBLE_POINTS, draw_frame, simulate_recording, visible_objects
from annotator.workflows.training.samples import drawn_objects, gather, taught_by_drags
from annotator.workflows.views import read_places, write_views
from annotator.workflows.workbench.drawing_steps import WholeBoxes

CONFIG = RcvConfig()
SIZE = (320, 240)


def true_image_boxes(project: Project, index: int) -> list[Box2D]:
    """The boxes that an operator would draw on the camera image of a frame."""
    recording, frame = first_recording(project), read(project, index)
    objects = visible_objects(recording, index, frame, project.config.classes)
    return draw_frame(frame, objects, BoxKind.SILHOUETTE, CONFIG)[0]


def first_recording(project: Project):
    return open_recording(project.recordings.all()[0].path)


def read(project: Project, index: int) -> Frame:
    return FrameSource(project).read(project.frames.of()[index])


def coco_of_frames(path: Path, project: Project, indices: list[int], label: str | None = None) -> Path:
    images = []
    for index in indices:
        boxes = true_image_boxes(project, index)
        boxes = boxes if label is None else [replace(box, label=label) for box in boxes]
        images.append(PictureLabels(f"color/{project.frames.of()[index].key}.jpg", tuple(boxes), SIZE))
    write_coco(path, images)
    return path


def draw_on(pictures: Path, project: Project, backwards: bool = False) -> Path:
    """Writes the result of an annotation tool: each picture with the box of its object."""
    places = read_places(pictures)
    recording = first_recording(project)
    keys = {frame.key: index for index, frame in enumerate(project.frames.of())}
    drawn = []
    for image in read_coco(pictures / "coco.json"):
        place = places[image.file_name]
        frame = read(project, keys[place.frame])
        objects = visible_objects(recording, keys[place.frame], frame, project.config.classes)
        boxes, _ = draw_frame(frame, objects, BoxKind.SILHOUETTE, CONFIG)
        (target,) = [o for o, box in zip(objects, boxes, strict=True) if box == place.geometry.image_box]
        picture = cv2.imread(str(pictures / image.file_name))[:, :, ::-1]
        box = span_on_view(place.geometry.view(picture), frame.cloud.xyz_m[target.points], target.label)
        assert box is not None
        drawn.append(replace(image, boxes=(box,)))
    write_coco(pictures / "drawn.json", drawn[::-1] if backwards else drawn)
    return pictures / "drawn.json"


@pytest.mark.parametrize("backwards", [False, True], ids=["in order", "side before front"])
def test_two_rounds_of_labelled_views_give_silhouettes(hands: Project, tmp_path: Path, backwards: bool) -> None:
    on_images = import_image_boxes(hands, coco_of_frames(tmp_path / "c.json", hands, [0, 3]), BoxKind.SILHOUETTE)
    assert (on_images.frames, on_images.boxes.total()) == (2, 4)
    for step in (1, 2):
        pictures = tmp_path / f"step{step}"
        assert write_views(hands, pictures, step, CONFIG).pictures == 8
        done = import_view_boxes(hands, draw_on(pictures, hands, backwards), pictures, BoxKind.SILHOUETTE)
        assert (done.frames, done.views, done.boxes.total(), done.notes) == (0, 8, 8, {})
    assert hands.statistics().view_boxes.boxes == 16
    assert {view.source for view in hands.boxes.on_views()} == {Source.IMPORTED}

    finished = drawn_objects(gather(hands).views)
    assert sorted(map(len, finished.values())) == [2, 2]
    recording = first_recording(hands)
    for index in (0, 3):
        frame = read(hands, index)
        truths = visible_objects(recording, index, frame, ["hand"])
        for views in finished[hands.frames.of()[index].id]:
            taught = taught_by_drags(frame, views)
            assert taught is not None
            assert taught.points is not None
            truth = max(truths, key=lambda known: (known.points & taught.points).sum())
            both = (taught.points & truth.points).sum()
            assert both > 0.97 * truth.points.sum()
            assert both > 0.9 * taught.points.sum(), "the boxes select the hand and few other points"


def test_reimported_image_boxes_keep_the_views_of_unchanged_boxes(hands: Project, tmp_path: Path) -> None:
    file = coco_of_frames(tmp_path / "c.json", hands, [0])
    import_image_boxes(hands, file, BoxKind.SILHOUETTE)
    write_views(hands, tmp_path / "one", 1, CONFIG)
    import_view_boxes(hands, draw_on(tmp_path / "one", hands), tmp_path / "one", BoxKind.SILHOUETTE)
    (first,) = hands.boxes.on_images()
    import_image_boxes(hands, file, BoxKind.BOX)
    assert hands.boxes.on_images()[0].boxes == first.boxes, "rounding in the file is not a change"
    assert [view.box_kind for view in hands.boxes.on_views()] == [BoxKind.BOX] * 4
    (image,) = read_coco(file)
    moved = replace(image.boxes[0], x_max=image.boxes[0].x_max + 3)
    write_coco(file, [replace(image, boxes=(moved, image.boxes[1]))])
    import_image_boxes(hands, file, BoxKind.BOX)
    left = {view.geometry.image_box for view in hands.boxes.on_views() if view.geometry is not None}
    assert (left, len(hands.boxes.on_views())) == ({first.boxes[1]}, 2)


def test_written_pictures_agree_with_their_metadata(hands: Project, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no object with boxes on camera images yet"):
        write_views(hands, tmp_path / "out", 1, CONFIG)
    import_image_boxes(hands, coco_of_frames(tmp_path / "c.json", hands, [1]), BoxKind.SILHOUETTE)
    (tmp_path / "out").mkdir()
    write_views(hands, tmp_path / "out", 1, CONFIG)
    for taken in (tmp_path / "out", tmp_path / "c.json"):
        with pytest.raises(FormatError, match="exists and is not"):
            write_views(hands, taken, 1, CONFIG)
    with pytest.raises(ConfigError, match="there is no step 3"):
        write_views(hands, tmp_path / "new", 3, CONFIG)
    images = read_coco(tmp_path / "out" / "coco.json")
    places = read_places(tmp_path / "out")
    assert {image.file_name for image in images} == set(places)
    assert json.loads((tmp_path / "out" / "coco.json").read_text())["categories"][0]["name"] == "hand"
    for image in images:
        picture = cv2.imread(str(tmp_path / "out" / image.file_name))
        assert picture.shape[1::-1] == image.size_px
        assert image.boxes == ()
        place = places[image.file_name]
        assert (place.recording, place.frame, place.step) == ("hands", "000001", 0)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted([*places, "coco.json", "views.json"])


def test_a_view_without_its_partner_is_not_ready(hands: Project, tmp_path: Path) -> None:
    import_image_boxes(hands, coco_of_frames(tmp_path / "c.json", hands, [0]), BoxKind.SILHOUETTE)
    write_views(hands, tmp_path / "one", 1, CONFIG)
    file = draw_on(tmp_path / "one", hands)
    only_fronts = [replace(i, boxes=() if "side" in i.file_name else i.boxes) for i in read_coco(file)]
    write_coco(file, only_fronts)
    done = import_view_boxes(hands, file, tmp_path / "one", BoxKind.SILHOUETTE)
    assert (done.views, done.boxes.total()) == (2, 2), "an unlabelled picture is not imported as empty"
    with pytest.raises(ConfigError, match="both views of the first step"):
        write_views(hands, tmp_path / "two", 2, CONFIG)


def test_an_unreadable_frame_is_reported_and_the_others_get_their_pictures(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = own_copy("hands")
    project = make_project(folder, classes=("hand",))
    import_image_boxes(project, coco_of_frames(tmp_path / "c.json", project, [0, 1]), BoxKind.SILHOUETTE)
    (folder / "depth" / "000000.png").write_bytes(b"\x89PNG nonsense")
    written = write_views(project, tmp_path / "out", 1, CONFIG)
    assert written.pictures == 4
    (line,) = written.unreadable
    assert line.startswith("000000: ")
    assert "depth/000000.png" in line


def test_pictures_without_metadata_are_imported_without_a_frame(hands: Project, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), rng.integers(0, 255, (40, 60, 3), np.uint8))
    box = Box2D("hand", 3.5, 4.5, 20.5, 30.5)
    file = tmp_path / "views.coco.json"
    for boxes in ((box,), (box, replace(box, x_max=10.5))):  # a second import replaces the first
        write_coco(file, [PictureLabels("a.png", boxes, (60, 40)), PictureLabels("b.png", (), (60, 40))])
        assert import_view_boxes(hands, file, tmp_path, BoxKind.BOX).boxes.total() == len(boxes)
    a, b = sorted(hands.boxes.on_views(), key=lambda view: -len(view.boxes))
    assert (len(a.boxes), b.boxes) == (2, ())
    assert (a.frame_id, a.geometry, a.step, a.box_kind) == (None, None, None, BoxKind.BOX)
    np.testing.assert_array_equal(hands.views.load(a.view_id)[:, :, ::-1], cv2.imread(str(tmp_path / "a.png")))


def good_views(project: Project, tmp_path: Path) -> tuple[Path, Path]:
    pictures = tmp_path / "pictures"
    import_image_boxes(project, coco_of_frames(tmp_path / "c.json", project, [0]), BoxKind.SILHOUETTE)
    write_views(project, pictures, 1, CONFIG)
    return draw_on(pictures, project), pictures


def remove_last(file: Path, pictures: Path) -> None:
    (pictures / read_coco(file)[-1].file_name).unlink()


def scale_last(file: Path, pictures: Path) -> None:
    path = pictures / read_coco(file)[-1].file_name
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), None, fx=2, fy=2))


def jpeg_last(file: Path, pictures: Path) -> None:
    path = pictures / read_coco(file)[-1].file_name
    path.write_bytes(cv2.imencode(".jpg", cv2.imread(str(path)))[1].tobytes())


def repeat_last(file: Path, pictures: Path) -> None:
    images = read_coco(file)
    shutil.copyfile(pictures / images[-1].file_name, pictures / images[0].file_name)
    write_coco(file, [replace(images[0], boxes=images[-1].boxes, size_px=images[-1].size_px), *images[1:]])


def break_sidecar(file: Path, pictures: Path) -> None:
    (pictures / "views.json").write_text('[{"file_name": "a.png"}]')


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (remove_last, "step1_side.png is not in"),
        (scale_last, "label the image itself, not a scaled copy"),
        (jpeg_last, "step1_side.png: is not a PNG image"),
        (repeat_last, "are the same image"),
        (break_sidecar, r"views.json: .*; write the views again"),
    ],
)
def test_unusable_pictures_are_errors_and_change_nothing(
    hands: Project, tmp_path: Path, damage: Callable[[Path, Path], None], problem: str
) -> None:
    file, pictures = good_views(hands, tmp_path)
    damage(file, pictures)
    with pytest.raises(FormatError, match=problem):
        import_view_boxes(hands, file, pictures, BoxKind.SILHOUETTE)
    assert hands.boxes.on_views() == ()


def image(name: str, *boxes: Box2D, size: tuple[int, int] = SIZE) -> PictureLabels:
    return PictureLabels(name, boxes, size)


BOX = Box2D("person", 10.5, 20.5, 60.5, 90.5)
OTHER = Box2D("dog", 100.5, 20.5, 160.5, 90.5)


def imported(project: Project, tmp_path: Path, *images: PictureLabels, **options: str) -> ImportReport:
    write_coco(tmp_path / "boxes.json", images)
    return import_image_boxes(project, tmp_path / "boxes.json", BoxKind.SILHOUETTE, **options)


def test_boxes_on_camera_images_replace_earlier_ones(people: Project, tmp_path: Path) -> None:
    done = imported(
        people,
        tmp_path,
        image("images/train/000001.jpg", BOX, OTHER),
        image("000002.png"),
        image("000099.jpg", BOX),
        image("cat.jpg"),
    )
    assert (done.frames, done.boxes) == (2, {"person": 1})
    assert done.notes == {Note.OTHER_CLASS: {"dog": 1}, Note.UNMATCHED_IMAGE: {"000099.jpg": 1, "cat.jpg": 1}}
    one, two = people.boxes.on_images()
    assert (one.frame_id, one.boxes, one.box_kind, one.source) == (
        people.frames.of()[1].id,
        (BOX,),
        BoxKind.SILHOUETTE,
        Source.IMPORTED,
    )
    assert two.boxes == ()
    # importing again replaces the earlier box
    imported(people, tmp_path, image("000001.jpg", replace(BOX, x_max=70.5)))
    assert people.boxes.on_images()[0].boxes == (replace(BOX, x_max=70.5),)


def test_replaced_drawn_boxes_are_counted_and_finalised_frames_are_kept(
    people: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, third = people.frames.of()[:3]
    mine = Box2D("person", 1.5, 2.5, 30.5, 40.5)
    for frame in (first, second):
        people.boxes.set_on_image(frame.id, [mine], BoxKind.SILHOUETTE, WriteContext(0, "ann", Source.MANUAL))
    people.log.append(second.id, [FrameFinalised()], WriteContext(1, "ann", Source.MANUAL))
    read, changed = boxes_2d.read_page, []

    def read_and_change(project: Project, frame_id: int) -> FramePage:
        page = read(project, frame_id)
        if frame_id == third.id and not changed:
            changed.append(project.boxes.set_on_image(frame_id, [mine], BoxKind.SILHOUETTE, WriteContext(0, "bob")))
        return page

    monkeypatch.setattr(boxes_2d, "read_page", read_and_change)
    done = imported(people, tmp_path, *(image(f"{frame.key}.jpg", BOX) for frame in (first, second, third)))
    assert (done.frames, done.boxes.total(), done[Note.REPLACED], done[Note.FINALISED]) == (2, 2, 2, 1)
    assert changed
    assert [found.boxes for found in people.boxes.on_images()] == [(BOX,), (mine,), (BOX,)]
    # equal and imported boxes do not count as replaced
    assert imported(people, tmp_path, image(f"{first.key}.jpg", BOX))[Note.REPLACED] == 0


@pytest.mark.parametrize(
    ("images", "problem"),
    [
        (
            [image("000000.jpg", OTHER), image("000001.jpg", OTHER)],
            "none of the dataset's classes is in the project: the dataset has dog",
        ),
        (
            [image("000000.jpg", BOX), image("000001.jpg", BOX, size=(640, 480))],
            "640 x 480 pixels, but the frame is 320 x 240",
        ),
    ],
    ids=["only other classes", "another size"],
)
def test_an_unusable_file_is_an_error_and_changes_nothing(
    people: Project, tmp_path: Path, images: list[PictureLabels], problem: str
) -> None:
    with pytest.raises(FormatError, match=problem):
        imported(people, tmp_path, *images)
    assert people.boxes.on_images() == ()


def test_boxes_on_an_unreadable_frame_are_imported(copied: tuple[Path, Project], tmp_path: Path) -> None:
    folder, project = copied
    (folder / "depth" / "000001.png").write_bytes(b"")
    assert imported(project, tmp_path, image("000000.jpg", BOX), image("000001.jpg", BOX)).boxes.total() == 2


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
