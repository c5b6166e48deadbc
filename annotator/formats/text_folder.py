"""A folder of text files, or a zip archive of such a folder: names and contents, nothing unpacked."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePath, PurePosixPath

from annotator.files import ARCHIVE_ERRORS, read_at_most
from annotator.types.errors import FormatError

# A label file of a single frame is some kilobytes.
MAX_BYTES = 16 * 2**20
MAX_FILES = 1_000_000


def text_files(path: Path, suffix: str = ".txt", within: str | None = None) -> Iterator[tuple[str, Path, str]]:
    """The text files of a folder or zip archive, by name: key (the name without suffix), path and content.

    Of an archive each file's own name counts, in whatever folder it lies; nothing is written anywhere. Other files
    are passed over, and so are hidden ones: a Mac puts `._KEY.txt` beside each file that it packs.

    Args:
        path: the folder or the archive.
        suffix: of the files that are wanted.
        within: name of a folder; where an archive has such files in a folder of that name, no others of it count.

    Raises:
        FormatError: there is no such folder or archive, none of its files has that suffix, two have the same name, or
            one cannot be read: damaged, encrypted, no UTF-8, or longer than `MAX_BYTES`.
    """
    if path.is_dir():
        yield from _of_folder(path, suffix)
    elif path.is_file() and zipfile.is_zipfile(path):
        yield from _of_archive(path, suffix, within)
    elif path.exists():
        raise FormatError(path, f"is neither a folder of *{suffix} files nor a zip archive of one")
    else:
        raise FormatError(path, "there is no such folder or archive")


def _of_folder(path: Path, suffix: str) -> Iterator[tuple[str, Path, str]]:
    try:
        files = sorted(file for file in path.iterdir() if _is_wanted(file, suffix))
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    if not files:
        raise FormatError(path, f"has no {suffix} file; name the folder that holds them")
    for file in files:
        yield file.stem, file, read_text(file)


def _is_wanted(file: PurePath, suffix: str) -> bool:
    return file.suffix == suffix and not file.name.startswith(".")


def read_text(file: Path) -> str:
    """The content of a text file.

    Raises:
        FormatError: it cannot be read, is no UTF-8 or longer than `MAX_BYTES`.
    """
    try:
        content = read_at_most(file, MAX_BYTES)
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror})") from error
    return _text(file, content)


def text_rows(file: Path) -> list[tuple[int, list[str]]]:
    """The words of all lines of a text file that are not blank, with their 1-based line numbers.

    Raises:
        FormatError: as `read_text`.
    """
    return [(line, row.split()) for line, row in enumerate(read_text(file).splitlines(), 1) if row.strip()]


def _of_archive(path: Path, suffix: str, within: str | None) -> Iterator[tuple[str, Path, str]]:
    try:
        with zipfile.ZipFile(path) as archive:
            named: dict[str, zipfile.ZipInfo] = {}
            for info in _wanted(archive, suffix, within):
                name = PurePosixPath(info.filename)
                if name.stem in named:
                    raise FormatError(path, f"has two files called {name.name}")
                named[name.stem] = info
            if not named:
                raise FormatError(path, f"has no {suffix} file")
            for key in sorted(named):
                with archive.open(named[key]) as stream:
                    # what the archive says of its size is not believed
                    content = stream.read(MAX_BYTES + 1)
                file = path / PurePosixPath(named[key].filename).name
                yield key, file, _text(file, content)
    except ARCHIVE_ERRORS as error:
        raise FormatError(path, f"the archive cannot be read ({error})") from error


def _wanted(archive: zipfile.ZipFile, suffix: str, within: str | None) -> list[zipfile.ZipInfo]:
    found = [
        info
        for info in archive.infolist()[:MAX_FILES]
        if not info.is_dir() and _is_wanted(PurePosixPath(info.filename), suffix)
    ]
    return [info for info in found if PurePosixPath(info.filename).parent.name == within] or found


def _text(file: Path, content: bytes) -> str:
    if len(content) > MAX_BYTES:
        raise FormatError(file, f"is longer than {MAX_BYTES // 2**20} MiB; that is no label file of one frame")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(file, "is not UTF-8 text; it may be truncated or of another kind") from error
