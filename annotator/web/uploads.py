"""Files with boxes that a page has sent, kept in the project's folder until they are imported.

A JSON or CSV file is kept as it is. Of a packed dataset (`.zip`), only the text files are unpacked: images are not
needed, since the project has them.
"""

from __future__ import annotations

import io
import re
import shutil
import time
import uuid
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from annotator.files import ARCHIVE_ERRORS, open_archive, private_folder
from annotator.formats.box_files import is_box_csv
from annotator.formats.coco import ANNOTATIONS
from annotator.formats.table import AnyFormat, BoxFormat, FlatFormat, format_of, marked
from annotator.formats.yolo import CLASSES, DATA_YAML
from annotator.project import Project
from annotator.text import is_within
from annotator.types.errors import FormatError, NotFoundError
from annotator.web.security import UPLOAD_LIMIT

FOLDER = ".uploads"
# An upload that nobody has imported is kept so long; no job waits as long for its turn.
KEPT_S = 24 * 3600.0
# Limits of a packed dataset: files, and bytes of its text files, which are read into some ten times as much memory.
MOST_FILES, MOST_BYTES = 200_000, UPLOAD_LIMIT
TEXTS = (".json", ".txt", ".yaml", ".csv")
# Their readers take the folder of all frames.
OF_FRAMES = (BoxFormat.SUSTECHPOINTS, BoxFormat.LABELCLOUD)
_NAME = re.compile(r"[^\w.-]+")


@dataclass(frozen=True)
class Upload:
    """A dataset of 2D or 3D boxes: the file or the folder to read."""

    id: str
    path: Path
    format: AnyFormat


def add_upload(project: Project, name: str, content: bytes) -> Upload:
    """Stores a file, and unpacks it if it is a `.zip`; removes old uploads."""
    uploads = project.path / FOLDER
    place = uploads / uuid.uuid4().hex
    file = Path(_NAME.sub("_", PurePosixPath(name).name)[-100:].lstrip(".") or "boxes")
    if file.suffix.lower() not in (".json", ".csv", ".zip"):
        raise FormatError(file, "is neither a file of boxes (.json, .csv) nor a packed folder of boxes (.zip)")
    private_folder(uploads)
    place.mkdir()
    try:
        if file.suffix.lower() == ".zip":
            _unpack(file, content, place / file.stem)
        else:
            (place / file).write_bytes(content)
        upload = find_upload(project, place.name)
    except BaseException:
        remove_upload(project, place.name)
        raise
    for old in uploads.iterdir():
        with suppress(FileNotFoundError):  # another request has removed it
            if old.stat().st_mtime < time.time() - KEPT_S:
                shutil.rmtree(old, ignore_errors=True)
    return upload


def find_upload(project: Project, upload_id: str) -> Upload:
    place = project.path / FOLDER / upload_id
    path = next(iter(place.iterdir()), None) if place.is_dir() else None
    if path is None:
        raise NotFoundError("this file was removed from the server; choose it again")
    if path.is_dir():
        return Upload(upload_id, *_dataset(path))
    format = _format_of(path)
    if format in OF_FRAMES:
        raise FormatError(path, "has the labels of one frame; pack the folder of all frames as .zip, and give that")
    return Upload(upload_id, path, format)


def _format_of(file: Path) -> AnyFormat:
    try:
        return format_of(file)
    except FormatError:
        # its reader says what is wrong
        return BoxFormat.BOX_CSV if file.suffix.lower() == ".csv" else FlatFormat.COCO


def as_sent(text: str, root: str) -> str:
    """A message in which files have their names on the operator's computer, without the folder of their upload.

    Args:
        text: with paths that begin with the name of the projects folder.
    """
    place = rf"{re.escape(root)}/[^/\s]+/{re.escape(FOLDER)}/[0-9a-f]{{32}}"
    return re.sub(place, "the folder that was sent", re.sub(f"{place}/", "", text))


def remove_upload(project: Project, upload_id: str) -> None:
    shutil.rmtree(project.path / FOLDER / upload_id, ignore_errors=True)


def _unpack(file: Path, content: bytes, folder: Path) -> None:
    try:
        with open_archive(io.BytesIO(content)) as packed:
            texts = [entry for entry in packed.infolist() if _is_wanted(PurePosixPath(entry.filename))]
            if len(texts) > MOST_FILES or sum(entry.file_size for entry in texts) > MOST_BYTES:
                raise FormatError(
                    file, f"has more than {MOST_FILES} files or {MOST_BYTES >> 20} MiB of text; divide it"
                )
            folder.mkdir()
            for entry in texts:
                if not is_within(folder, folder / entry.filename):
                    raise FormatError(file, f"contains {entry.filename[:60]!r}, which leads out of its folder")
                packed.extract(entry, folder)
    except ARCHIVE_ERRORS as error:
        raise FormatError(file, f"cannot be unpacked: {error}; pack the folder again, without a password") from error


def _is_wanted(entry: PurePosixPath) -> bool:
    """False for other files than texts, and for the hidden ones that macOS adds to each file."""
    return entry.suffix.lower() in TEXTS and not entry.name.startswith(".") and "__MACOSX" not in entry.parts


def _dataset(folder: Path) -> tuple[Path, AnyFormat]:
    """Finds the dataset in an unpacked folder: on the highest level that has one."""
    levels = sorted([folder, *(path for path in folder.rglob("*") if path.is_dir())], key=lambda path: len(path.parts))
    for level in levels:
        if flat := [format for format in marked(level) if isinstance(format, FlatFormat)]:
            return level, flat[-1]
    files = [path for path in folder.rglob("*.json") if path.is_file()]
    files = files or [path for path in folder.rglob("*.csv") if is_box_csv(path)]
    if len(files) == 1 and (format := _format_of(files[0])) not in OF_FRAMES:
        return files[0], format
    for level in levels:
        with suppress(FormatError):
            return level, format_of(level)
    raise FormatError(
        folder,
        f"contains no dataset of boxes: of 2D boxes, it has no {DATA_YAML}, no {CLASSES}, no "
        f"{ANNOTATIONS}/instances_*.json, and not exactly one JSON file; and no known format of 3D boxes",
    )
