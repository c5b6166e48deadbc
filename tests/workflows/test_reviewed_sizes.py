"""Typical sizes of a project's classes from its reviewed boxes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.project import BoxRotation, NewLabel, Project, ProjectSettings, WriteContext, create_project
from annotator.rcv.typical_size.sizes import typical_size
from annotator.recordings import open_recording
from annotator.types import BoxKind, OrientedBox, ReviewState
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.reviewed_sizes import reviewed_sizes
from annotator.workflows.settings import rcv_config

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
    state: ReviewState = ReviewState.ACCEPTED,
) -> None:
    stored = project.frames.of()[frame]
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), rotation, np.array(size_m))
    new = NewLabel(label, box, box_kind=kind, state=state)
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
    assert rcv_config(project).typical_sizes == (four,)


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
    assert rcv_config(project, without_frames=[held_out]).typical_sizes == (size,)


def test_freely_rotated_boxes_are_ordered_by_length(project: Project) -> None:
    add(project, 0, (2.0, 1.0, 0.5))
    add(project, 1, (1.0, 0.5, 2.0), Rotation.from_euler("x", 1.2).as_matrix())
    (size,) = reviewed_sizes(project)
    assert size.size_m == pytest.approx((2.0, 1.0, 0.5))
    assert max(size.spread) < 0.2


def test_freely_rotated_boxes_are_ordered_in_free_projects(tmp_path: Path, generated: Path) -> None:
    settings = ProjectSettings(rotation=BoxRotation.FREE)
    with create_project(tmp_path, "free", ("thing",), settings=settings) as project:
        register_recording(project, open_recording(generated / "hands"))
        add(project, 0, (0.1, 0.05, 0.2))
        (size,) = reviewed_sizes(project)
        assert size.size_m == pytest.approx((0.2, 0.1, 0.05))


def test_a_well_known_class_begins_with_its_size(project: Project) -> None:
    known = typical_size("Car")
    assert known is not None
    add(project, 0, (6.0, 1.6, 1.5), label="Car")
    (size,) = reviewed_sizes(project)
    assert known.size_m[0] < size.size_m[0] < 6.0


def test_sizes_of_the_settings_come_first(project: Project) -> None:
    add(project, 0, (2.0, 1.0, 0.5))
    own = {"label": "thing", "size_m": [3.0, 2.0, 1.0], "spread": [0.1, 0.1, 0.1]}
    project.configure(settings=ProjectSettings.model_validate({"rcv": {"typical_sizes": [own]}}))
    sizes = rcv_config(project).typical_sizes
    assert typical_size("thing", sizes).size_m == (3.0, 2.0, 1.0)
