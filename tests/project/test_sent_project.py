"""Projects that somebody sent: nothing outside their folder is read or written through them."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from annotator.project import create_project, list_projects, open_project
from annotator.project.backup.repair import repair
from annotator.project.backup.verify import verify
from annotator.types.errors import NotFoundError, ProjectError

PLACES = (
    "project.json",
    "project.db",
    "project.db-wal",
    "models",
    "models/view/run/validation/0.jpg",
    "views",
    ".cache/points.json",
)


@pytest.fixture
def sent(tmp_path: Path) -> Path:
    create_project(tmp_path / "projects", "sent", ["person"]).close()
    return tmp_path / "projects" / "sent"


def link(place: Path, target: Path | str) -> None:
    """Puts a link in the place of a file or folder, which moves to the target unless that is missing."""
    if isinstance(target, Path) and place.exists():
        shutil.move(place, target)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)
    place.symlink_to(target)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("is_there", [True, False])
def test_a_project_with_a_link_that_leads_out_is_refused(
    sent: Path, tmp_path: Path, place: str, is_there: bool
) -> None:
    outside = tmp_path / "outside"
    if is_there and not (sent / place).exists():
        outside.mkdir()
    elif not is_there:
        shutil.rmtree(sent / place) if (sent / place).is_dir() else (sent / place).unlink(missing_ok=True)
    link(sent / place, outside)
    before = sorted(tmp_path.rglob("*"))
    assert f"{place}: is a link that leads out of the project" in verify(sent).problems[0]
    with pytest.raises(ProjectError, match=rf"{place}: is a link that leads out of the project.*(remove|put)"):
        open_project(sent)
    assert sorted(tmp_path.rglob("*")) == before
    if place == "project.json" and is_there:
        assert [project.problem is None for project in list_projects(sent.parent)] == [False]


@pytest.mark.parametrize("target", ["../../outside", "view/../../../outside", "loop"])
def test_a_relative_link_or_a_circular_one_is_refused(sent: Path, target: str) -> None:
    link(sent / "models" / "loop", target)
    with pytest.raises(ProjectError, match="models/loop: is a link"):
        open_project(sent)


def test_links_within_a_project_and_to_a_project_are_followed(sent: Path, tmp_path: Path) -> None:
    (sent / "models" / "newest").symlink_to("view/run")
    (sent / "notes").symlink_to(sent / "project.json")
    (tmp_path / "projects" / "same").symlink_to(sent)
    with open_project(tmp_path / "projects" / "same") as project:
        assert project.config.name == "sent"


def test_a_view_that_is_a_link_is_missing_and_replaced(sent: Path, tmp_path: Path) -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    with open_project(sent) as project:
        view = project.views.store(image)
        link(project.views.path(view), tmp_path / "picture.png")
        secret = (tmp_path / "picture.png").read_bytes()
        for read in (project.views.path, project.views.load, project.views.content, project.views.size):
            with pytest.raises(NotFoundError, match="the image is missing"):
                read(view)
        assert project.views.store(image) == view
        assert not project.views.path(view).is_symlink()
        assert project.views.content(view) == secret


STRANGE = {
    "trigger": "CREATE TRIGGER spy AFTER UPDATE ON frames BEGIN DELETE FROM labels; END",
    "view": "CREATE VIEW spy AS SELECT * FROM labels",
}


@pytest.mark.parametrize("kind", STRANGE)
def test_a_project_with_triggers_or_views_of_a_stranger_is_not_opened(sent: Path, kind: str) -> None:
    with closing(sqlite3.connect(sent / "project.db")) as connection:
        connection.execute(STRANGE[kind])
    with pytest.raises(ProjectError, match=rf"has the {kind} 'spy', which does not belong .*project repair"):
        open_project(sent)
    repaired = repair(sent)
    assert verify(repaired.path, deep=True).problems == ()
    open_project(repaired.path).close()
