"""Images of pseudo-views, stored by the hash of their content."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis.extra import numpy as npst

from annotator.project import Project
from annotator.types.errors import ProjectError


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


def test_only_png_is_stored(project: Project) -> None:
    with pytest.raises(ProjectError, match="only PNG"):
        project.views.store(b"\xff\xd8\xff jpeg")
    assert list(project.views.folder.iterdir()) == []


def test_a_damaged_image_is_detected(project: Project) -> None:
    view = project.views.store(np.zeros((4, 4, 3), np.uint8))
    path = project.views.path(view)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ProjectError, match=r"\.png: is damaged"):
        project.views.load(view)


@pytest.mark.parametrize("view", ["", "../project", "0" * 63, "A" * 64])
def test_an_invalid_view_id_is_refused(project: Project, view: str) -> None:
    with pytest.raises(ProjectError, match="not the id of a view"):
        project.views.load(view)


def test_an_undecodable_image_is_refused_on_reading(project: Project) -> None:
    view = project.views.store(b"\x89PNG\r\n\x1a\n and then nonsense")
    with pytest.raises(ProjectError, match="cannot be decoded as an image"):
        project.views.load(view)
