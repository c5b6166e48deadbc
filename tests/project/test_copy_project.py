"""A foreign project is copied without what could lead out of it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from backup_samples import content, files

from annotator.project.backup.take_in import copy_project
from annotator.types.errors import ProjectError


def test_a_foreign_project_is_copied_without_links_and_caches(full: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    before = content(full)
    (full / "models/image/one/validation/1.jpg").symlink_to(secret)
    (full / "models/image/two/validation").rename(tmp_path / "away")
    (full / "models/image/two/validation").symlink_to(tmp_path / "away")
    os.mkfifo(full / "models/image/one/pipe")
    (full / "cache").mkdir()
    (full / "cache/points.json").write_text("{}")
    path = copy_project(full, tmp_path / "mine", "taken")
    assert content(path) == before
    left_out = {"cache/points.json", "models/image/one/pipe", "models/image/one/validation/1.jpg"}
    assert files(path) == {
        name for name in files(full) - left_out if "openvino" not in name and "two/valid" not in name
    }
    assert not [path for path in path.rglob("*") if path.is_symlink()]


@pytest.mark.parametrize("name", ["project.json", "project.db"])
def test_a_foreign_project_whose_main_files_are_links_is_refused(full: Path, tmp_path: Path, name: str) -> None:
    (full / name).rename(tmp_path / name)
    (full / name).symlink_to(tmp_path / name)
    with pytest.raises(ProjectError, match=f"{name} is missing or no regular file"):
        copy_project(full, tmp_path, "taken")
