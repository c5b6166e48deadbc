"""All files are read through `annotator/files.py`, which takes regular files of a bounded size only."""

from __future__ import annotations

import ast
import errno
import os
import re
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from annotator.files import (
    MOST_DIRECTORY_BYTES,
    check_file,
    end_of_file,
    open_archive,
    open_file,
    read_file,
    read_text_file,
)

PACKAGE = Path(__file__).resolve().parent.parent / "annotator"
# What opens a file by its path.
OPENERS = {
    "open", "io.open", "os.open", "np.load", "np.fromfile", "np.loadtxt", "np.genfromtxt", "np.memmap", "cv2.imread",
    "cv2.VideoCapture", "json.load", "zipfile.ZipFile", "zipfile.is_zipfile", "sqlite3.connect", "av.open",
    "laspy.open", "laspy.read", "tarfile.open", "Image.open", "feather.read_table", "scipy.io.loadmat", "loadmat",
    "torch.load",
}  # fmt: skip
METHODS = {"read_bytes", "read_text"}
SUSPECT = re.compile("|".join(rf"\b{re.escape(name.rpartition('.')[2])}\(" for name in (*OPENERS, *METHODS)))
# Modules that open what they have checked, or made themselves, and why.
EXCEPT = {
    "files.py": "it is the door",
    "project/store.py": "SQLite; the path is checked to be a regular file",
    "recordings/ros/sqlite_file.py": "SQLite; the file's beginning is read through the door first",
    "cli/main.py": "os.devnull",
    "project/backup/archive.py": "a backup's list of files may be long; its file is opened through the door",
    "project/backup/content.py": "SQLite, on a copy of our own",
    "project/backup/generation.py": "SQLite; a `-wal` is read through the door",
    "project/backup/snapshot.py": "SQLite; the path is checked to be a regular file",
    "project/backup/take_in.py": "regular files only, and no links",
    "project/backup/unfinished.py": "folders of our own",
    "project/database/expected.py": "SQLite, in memory",
    "project/database/replaced.py": "SQLite, on a copy of our own",
    "web/security.py": "the token may come from a pipe",
}


def openers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yields line and name of each call that opens a file for reading."""
    for function in [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Module)]:
        own = list(calls(function))
        is_checked = any(ast.unparse(call.func) == "check_file" for call in own)
        for call in own:
            name = ast.unparse(call.func)
            method = call.func.attr if isinstance(call.func, ast.Attribute) else ""
            in_memory = bool(call.args) and ast.unparse(call.args[0]).startswith("io.BytesIO")
            if in_memory or is_checked or is_writing(call):
                continue
            if name in OPENERS or method in METHODS or (method == "open" and is_of_path(call)):
                yield call.lineno, name


def calls(function: ast.AST) -> Iterator[ast.Call]:
    """Yields the calls of a function, without those of functions in it."""
    for node in ast.iter_child_nodes(function):
        if isinstance(node, ast.Call):
            yield node
        if not isinstance(node, ast.FunctionDef):
            yield from calls(node)


def mode(call: ast.Call) -> str | None:
    given = [word.value for word in call.keywords if word.arg == "mode"] + call.args[:2]
    texts = [value.value for value in given if isinstance(value, ast.Constant) and isinstance(value.value, str)]
    return next((text for text in texts if text and set(text) <= set("rwaxbt+")), None)


def is_writing(call: ast.Call) -> bool:
    return bool(set(mode(call) or "") & set("wax"))


def is_of_path(call: ast.Call) -> bool:
    """True for `path.open("rb")`, `path.open(encoding=...)`, but not for `cache.open(project, frame)`."""
    return mode(call) is not None or any(word.arg in ("encoding", "newline", "buffering") for word in call.keywords)


def test_files_are_read_through_one_door():
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE).as_posix()
        text = path.read_text()
        # parsing all would take seconds
        if place not in EXCEPT and SUSPECT.search(text):
            found += [f"{place}:{line}: {name}" for line, name in openers(ast.parse(text))]
    assert found == [], "use annotator.files, or call check_file before a library opens a path"


@pytest.mark.parametrize(
    ("source", "is_found"),
    [
        ("path.read_bytes()", True),
        ("path.open('rb')", True),
        ("path.open(encoding='utf-8')", True),
        ("np.load(path)", True),
        ("def f(path):\n    av.open(str(path))", True),
        ("def f(path):\n    check_file(path)\n    av.open(str(path))", False),
        ("path.open('wb')", False),
        ("zipfile.ZipFile(out, 'w')", False),
        ("zipfile.ZipFile(io.BytesIO(data))", False),
        ("cache.open(project, frame_id)", False),
        ("read_file(path)", False),
    ],
)
def test_the_rule_finds_what_opens_files(source: str, is_found: bool):
    assert bool(list(openers(ast.parse(source)))) == is_found


READERS: list[Callable[[Path], object]] = [
    open_file,
    read_file,
    read_text_file,
    check_file,
    lambda path: end_of_file(path, 10),
]


@pytest.mark.parametrize("read", READERS)
def test_only_regular_files_are_opened(tmp_path: Path, read: Callable[[Path], object]):
    """A pipe would wait for its other end for ever, and a device has no end."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    for name in ("pipe", "device"):
        with pytest.raises(OSError, match="not a regular file") as caught:
            read(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name)
    with pytest.raises(IsADirectoryError):
        read(tmp_path)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "missing")


def test_large_files_are_refused_without_reading_them(tmp_path: Path):
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(700 * 2**20)  # sparse
    tracemalloc.start()
    with pytest.raises(OSError, match=r"larger than 16 MiB, the limit") as caught:
        read_file(path)
    assert caught.value.errno == errno.EFBIG
    assert end_of_file(path, 4) == "\0" * 4
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_text_has_line_feeds(tmp_path: Path):
    (tmp_path / "a").write_bytes("ä\r\nb\rc\n".encode())
    assert read_text_file(tmp_path / "a") == "ä\nb\nc\n" == (tmp_path / "a").read_text(encoding="utf-8")
    (tmp_path / "a").write_bytes("ä\r\nb\rc\n".encode("utf-16"))
    assert read_text_file(tmp_path / "a") == "ä\nb\nc\n"
    (tmp_path / "a").write_bytes("a\nä\n".encode("latin-1"))
    with pytest.raises(UnicodeDecodeError, match=r"^not UTF-8 text in line 2 \(0xe4\); save it as UTF-8$"):
        read_text_file(tmp_path / "a")


def test_an_archive_with_an_endless_list_of_files_is_refused(tmp_path: Path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "text")
    with open_file(path) as file, open_archive(file) as archive:
        assert archive.read("a.txt") == b"text"
    data = bytearray(path.read_bytes())
    at = data.rindex(b"PK\5\6") + 12
    data[at : at + 4] = (MOST_DIRECTORY_BYTES + 1).to_bytes(4, "little")
    path.write_bytes(data)
    with open_file(path) as file, pytest.raises(zipfile.BadZipFile, match="its list of files has"):
        open_archive(file)
