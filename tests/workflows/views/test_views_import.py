"""Importing pseudo-views labelled with other tools in two rounds, and COCO boxes on camera images; and errors."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from annotator.formats.coco import read_coco, write_coco
from annotator.formats.frame_names import PictureLabels
from annotator.project import Project, WriteContext
from annotator.project.changes import FrameFinalised
from annotator.project.overview import FramePage
from annotator.rcv.config import RcvConfig
from annotator.rcv.teach import span_on_view
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Frame, Source
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import ImportReport, Note, boxes_2d, import_image_boxes, import_view_boxes
from annotator.workflows.simulate import draw_frame, visible_objects
from annotator.workflows.training.samples import drawn_objects, gather, taught_by_drags
from annotator.workflows.views import read_places, write_views

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
