"""Typical sizes of a project's classes from its reviewed boxes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.project import BoxRotation, NewLabel, Project, ProjectSettings, WriteContext, create_project
from annotator.rcv.config import typical_size
from annotator.recordings import open_recording
from annotator.types import BoxKind, OrientedBox, ReviewState
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.settings import editable, rcv_config, reviewed_sizes

ABOUT_Z = Rotation.from_euler("z", 0.4).as_matrix()


@pytest.fixture
def project(tmp_path: Path, generated: Path) -> Iterator[Project]:
    with create_project(tmp_path, "p", ("thing", "Car", "other")) as created:
        register_recording(created, open_recording(generated / "people"))
        yield created


def add(
    project: Project,
    frame: int,
    size_m: tuple[float, float, float],
    rotation: np.ndarray = ABOUT_Z,
    label: str = "thing",
    kind: BoxKind = BoxKind.BOX,
    track: int | None = None,
    state: ReviewState = ReviewState.ACCEPTED,
) -> None:
    stored = project.frames.of()[frame]
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), rotation, np.array(size_m))
    new = NewLabel(label, box, box_kind=kind, state=state, track_id=track)
    project.labels.create(stored.id, [new], WriteContext(stored.revision, "ann"))


def test_without_reviewed_boxes_there_are_no_sizes(project: Project) -> None:
    add(project, 0, (2.0, 1.0, 0.5), state=ReviewState.REJECTED)
    add(project, 1, (2.0, 1.0, 0.5), kind=BoxKind.SILHOUETTE)
    assert reviewed_sizes(project) == ()


def test_the_first_box_gives_the_size_and_further_ones_make_it_sure(project: Project) -> None:
    add(project, 0, (1.0, 2.0, 0.5))
    (one,) = reviewed_sizes(project)
    assert one.label == "thing"
    assert one.size_m == pytest.approx((2.0, 1.0, 0.5))  # upright: the longer of length and width first
    for frame in (1, 2, 3):
        add(project, frame, (2.0, 1.0, 0.5))
    (four,) = reviewed_sizes(project)
    assert four.size_m == pytest.approx((2.0, 1.0, 0.5))
    assert max(four.spread) < min(one.spread) < 0.2
    assert rcv_config(project).reviewed_sizes == (four,)


def test_boxes_of_unlike_sizes_have_a_wide_spread(project: Project) -> None:
    for frame, factor in enumerate((0.5, 1.0, 2.0)):
        add(project, frame, (2.0 * factor, 1.0, 0.5))
    (size,) = reviewed_sizes(project)
    assert size.size_m == pytest.approx((2.0, 1.0, 0.5))
    assert size.spread[0] > 0.4 > 0.15 > size.spread[2]


def test_some_frames_do_not_count(project: Project) -> None:
    add(project, 0, (2.0, 1.0, 0.5))
    add(project, 1, (8.0, 1.0, 0.5))
    held_out = project.frames.of()[1].id
    (size,) = reviewed_sizes(project, [held_out])
    assert size.size_m[0] == pytest.approx(2.0)
    assert rcv_config(project, without_frames=[held_out]).reviewed_sizes == (size,)


def test_free_boxes_are_compared_in_the_order_in_which_they_are_most_alike(project: Project) -> None:
    add(project, 0, (2.0, 1.0, 0.5))
    add(project, 1, (1.0, 0.5, 2.0), Rotation.from_euler("x", 1.2).as_matrix())
    (size,) = reviewed_sizes(project)
    assert sorted(size.size_m) == pytest.approx([0.5, 1.0, 2.0])
    assert max(size.spread) < 0.2


def test_upright_boxes_keep_their_height_however_the_camera_is_tilted(project: Project) -> None:
    for frame, tilt in enumerate((0.0, 0.3, 0.6)):
        add(project, frame, (0.5, 0.3, 1.6 + 0.05 * frame), Rotation.from_euler("x", tilt).as_matrix())
    (size,) = reviewed_sizes(project)
    assert size.size_m == pytest.approx((0.5, 0.3, 1.65), rel=0.01)


def test_boxes_of_free_projects_are_like_those_of_a_well_known_class(tmp_path: Path, generated: Path) -> None:
    settings = ProjectSettings(rotation=BoxRotation.FREE)
    known = typical_size("pedestrian")
    assert known is not None
    length, width, height = known.size_m
    with create_project(tmp_path, "free", ("pedestrian",), settings=settings) as project:
        register_recording(project, open_recording(generated / "hands"))
        add(project, 0, (height, length, width), label="pedestrian")
        (size,) = reviewed_sizes(project)
        assert size.size_m == pytest.approx(known.size_m)


def test_a_well_known_class_begins_with_its_size(project: Project) -> None:
    known = typical_size("Car")
    assert known is not None
    add(project, 0, (4.6, 1.7, 1.5), label="Car")
    (size,) = reviewed_sizes(project)
    assert known.size_m[0] < size.size_m[0] < 4.6


def test_toy_cars_are_no_cars(project: Project) -> None:
    add(project, 0, (0.08, 0.04, 0.03), label="Car")
    (size,) = reviewed_sizes(project)
    assert size.size_m == pytest.approx((0.08, 0.04, 0.03))


def test_a_track_counts_once(project: Project) -> None:
    for frame in range(3):
        add(project, frame, (2.0, 1.0, 0.5), track=7)
    add(project, 3, (1.0, 1.0, 0.5), track=8)
    (size,) = reviewed_sizes(project)
    assert size.size_m[0] == pytest.approx(np.sqrt(2.0))


def test_sizes_of_the_settings_come_first(project: Project) -> None:
    add(project, 0, (2.0, 1.0, 0.5))
    own = {"label": "thing", "size_m": [3.0, 2.0, 1.0], "spread": [0.1, 0.1, 0.1]}
    project.configure(settings=ProjectSettings.model_validate({"rcv": {"typical_sizes": [own]}}))
    config = rcv_config(project).for_detector(BoxKind.BOX, class_agnostic=True)
    size = config.typical_size("thing")
    assert size is not None and size.size_m == (3.0, 2.0, 1.0)
    assert json.loads(editable(config))["typical_sizes"] == [own]
    assert "reviewed_sizes" not in editable(config)
