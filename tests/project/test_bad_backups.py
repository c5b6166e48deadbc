"""Damaged and hostile backups are refused, and leave nothing."""

from __future__ import annotations

import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from annotator.project.backup.make import back_up
from annotator.project.backup.take_in import restore
from annotator.types.errors import FormatError

Change = Callable[[Path, Path], object]
"""Writes a changed backup: (of this one, to this file)."""
Entry = tuple[zipfile.ZipInfo, bytes]


def rezipped(start: str, change: Callable[[zipfile.ZipInfo, bytes], list[Entry]]) -> Change:
    """Changes the entries whose names start so."""

    def write(old: Path, new: Path) -> None:
        with zipfile.ZipFile(old) as source, zipfile.ZipFile(new, "w") as target:
            for info in source.infolist():
                entry = (info, source.read(info))
                for each, data in change(*entry) if info.filename.startswith(start) else [entry]:
                    target.writestr(each, data)

    return write


def renamed(name: str) -> Change:
    """Gives the view another name, in the manifest, too."""

    def change(info: zipfile.ZipInfo, content: bytes) -> list[Entry]:
        if info.filename.startswith("views/"):
            info = zipfile.ZipInfo(name)
        if info.filename == "manifest.json":
            view = content[content.index(b"views/") :].split(b'"')[0]
            content = content.replace(view, name.encode())
        return [(info, content)]

    return rezipped("", change)


def with_mode(mode: int) -> Change:
    def change(info: zipfile.ZipInfo, content: bytes) -> list[Entry]:
        info.external_attr = mode << 16
        return [(info, content)]

    return rezipped("views/", change)


BAD_BACKUPS: list[tuple[str, Change, str]] = [
    ("not a zip", lambda old, new: new.write_bytes(b"nothing"), "cannot be read as a backup"),
    ("cut", lambda old, new: new.write_bytes(old.read_bytes()[:-200]), "cannot be read as a backup"),
    (
        "an unlisted file",
        rezipped("manifest.json", lambda info, data: [(info, data), (zipfile.ZipInfo("views/x"), b"x")]),
        "which its manifest does not list",
    ),
    ("an absolute path", renamed("/tmp/evil.png"), "which is no file of a project"),
    ("a path that leads out", renamed("views/../../evil.png"), "which is no file of a project"),
    ("a hidden file", renamed("models/image/.bashrc"), "which is no file of a project"),
    ("a link", with_mode(stat.S_IFLNK | 0o777), "a link, a device or a folder"),
    ("a device", with_mode(stat.S_IFCHR | 0o600), "a link, a device or a folder"),
    (
        "more bytes than declared",
        rezipped("project.db", lambda info, data: [(info, data + b"0" * 1000)]),
        "has another size than its manifest says",
    ),
    ("other bytes", rezipped("views/", lambda info, data: [(info, data[:-1] + b"\0")]), "its size or hash differs"),
    ("a file twice", rezipped("views/", lambda info, data: [(info, data)] * 2), "contains a file twice"),
    ("a missing file", rezipped("views/", lambda *_: []), "which its manifest lists"),
]


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(("change", "says"), [pytest.param(*row[1:], id=row[0]) for row in BAD_BACKUPS])
def test_a_bad_backup_is_refused_and_leaves_nothing(full: Path, tmp_path: Path, change: Change, says: str) -> None:
    back_up(full, tmp_path / "good.zip")
    change(tmp_path / "good.zip", tmp_path / "bad.zip")
    root = tmp_path / "projects"
    root.mkdir()
    with pytest.raises(FormatError, match=says):
        restore(tmp_path / "bad.zip", root)
    assert list(root.iterdir()) == []
