"""2D boxes on camera images and pseudo-views."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis.extra import numpy as npst
from store_samples import NOT_AXIS_ALIGNED, by_hand, matrix3

from annotator.project import Project, ViewGeometry, WriteContext
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import ProjectError, StaleRevisionError

HANDS = (Box2D("hand", 1.5, 2.0, 3.0, 4.0), Box2D("hand", -3.0, 0.0, 100.25, 1 / 3, 0.5))


@pytest.fixture
def view(project: Project) -> str:
    return project.views.store(np.full((12, 16, 3), 7, np.uint8))


def test_setting_boxes_on_an_image_replaces_the_earlier_ones(project: Project, frame: int) -> None:
    assert project.boxes.on_image(frame) is None
    for count, kind, source in ((2, BoxKind.SILHOUETTE, Source.MANUAL), (0, BoxKind.BOX, Source.IMPORTED)):
        change = WriteContext(project.frames.get(frame).revision, "ann", source)
        project.boxes.set_on_image(frame, HANDS[:count], kind, change)
        boxes = project.boxes.on_image(frame)
        assert boxes is not None, "an image without boxes is labelled, too"
        assert (boxes.boxes, boxes.box_kind, boxes.source, boxes.author) == (HANDS[:count], kind, source, "ann")
    first = project.frames.of()[0].id
    project.boxes.set_on_image(first, HANDS, BoxKind.BOX, by_hand())
    assert [entry.frame_id for entry in project.boxes.on_images()] == [first, frame], "in the order of the frames"
    assert project.boxes.frames_with_images() == {first, frame}


def test_boxes_on_a_view_raise_the_revision_of_its_frame(project: Project, frame: int, view: str) -> None:
    geometry = ViewGeometry(axes=matrix3(NOT_AXIS_ALIGNED), metres_per_px=0.001, origin_m=(-0.5, 1 / 3))
    receipt = project.boxes.set_on_view(view, HANDS, BoxKind.BOX, by_hand(), frame_id=frame, step=1, geometry=geometry)
    assert receipt.revision == project.frames.get(frame).revision == 1
    (boxes,) = project.boxes.on_views_of(frame)
    assert (boxes.view_id, boxes.frame_id, boxes.boxes, boxes.step) == (view, frame, HANDS, 1)
    assert boxes.geometry == geometry
    assert project.boxes.on_views() == (boxes,)
    project.boxes.set_on_view(view, [], BoxKind.BOX, by_hand(1), frame_id=frame)
    (boxes,) = project.boxes.on_views_of(frame)
    assert (boxes.boxes, boxes.step, boxes.geometry) == ((), None, None)
    assert project.boxes.on_views() == (boxes,)


def test_a_view_without_a_frame_has_its_own_revision(project: Project, frame: int, view: str) -> None:
    assert project.boxes.set_on_view(view, HANDS, BoxKind.BOX, by_hand()).revision == 1
    with pytest.raises(StaleRevisionError, match="view "):
        project.boxes.set_on_view(view, [], BoxKind.BOX, by_hand())
    project.boxes.set_on_view(view, HANDS[:1], BoxKind.SILHOUETTE, by_hand(1))
    (boxes,) = project.boxes.on_views()
    assert (boxes.frame_id, boxes.revision, boxes.boxes, boxes.box_kind) == (None, 2, HANDS[:1], BoxKind.SILHOUETTE)
    # the same image may be a view of a frame, too
    project.boxes.set_on_view(view, HANDS, BoxKind.BOX, by_hand(), frame_id=frame)
    assert [(boxes.frame_id, len(boxes.boxes)) for boxes in project.boxes.on_views()] == [(None, 1), (frame, 2)]


def test_boxes_on_a_view_need_its_image(project: Project, frame: int) -> None:
    with pytest.raises(ProjectError, match="the image is missing"):
        project.boxes.set_on_view("0" * 64, HANDS, BoxKind.BOX, by_hand(), frame_id=frame)
    assert project.boxes.on_views() == ()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(rgb=npst.arrays(np.uint8, npst.array_shapes(min_dims=2, max_dims=2, max_side=9).map(lambda s: (*s, 3))))
def test_an_image_is_read_back(project: Project, rgb: np.ndarray) -> None:
    assert np.array_equal(project.views.load(project.views.store(rgb)), rgb)


def test_the_id_is_the_hash_and_an_image_is_stored_once(project: Project) -> None:
    rgb = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    view = project.views.store(rgb)
    content = project.views.path(view).read_bytes()
    assert view == hashlib.sha256(content).hexdigest()
    assert project.views.store(content) == project.views.store(rgb.copy()) == view
    assert [path.name for path in project.views.folder.iterdir()] == [f"{view}.png"]


def test_a_damaged_image_and_what_is_none_are_refused(project: Project) -> None:
    view = project.views.store(np.zeros((4, 4, 3), np.uint8))
    path = project.views.path(view)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ProjectError, match=r"\.png: is damaged"):
        project.views.load(view)
    with pytest.raises(ProjectError, match="only PNG"):
        project.views.store(b"\xff\xd8\xff jpeg")
    undecodable = project.views.store(b"\x89PNG\r\n\x1a\n and then nonsense")
    with pytest.raises(ProjectError, match="cannot be decoded as an image"):
        project.views.load(undecodable)


@pytest.mark.parametrize("view", ["", "../project", "0" * 63, "A" * 64])
def test_an_invalid_view_id_is_refused(project: Project, view: str) -> None:
    with pytest.raises(ProjectError, match="not the id of a view"):
        project.views.load(view)
