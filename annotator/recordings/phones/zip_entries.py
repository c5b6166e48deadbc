"""Files of a zip archive, or of a folder with the same content.

`zipfile` would parse the list of all files again for each one that is read: 0.2 s for 10,000 frames.
Format: PKWARE, "APPNOTE", 4.3.7 (local file header).
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path

from annotator.files import ARCHIVE_ERRORS, open_archive, open_file
from annotator.frame_limits import read_frame_file, require_memory

SIGNATURE, HEAD = b"PK\3\4", struct.Struct("<26xHH")
ENCRYPTED = 1

# None: a file in a folder.
Entries = dict[str, zipfile.ZipInfo | None]


def list_entries(path: Path) -> Entries:
    """Lists the files of an archive by name, or of a folder and the folders in it.

    Raises:
        OSError: it cannot be read.
        ValueError: not an archive, or its list of files is damaged.
    """
    if path.is_dir():
        files = (*path.iterdir(), *(file for folder in path.iterdir() if folder.is_dir() for file in folder.iterdir()))
        return {file.relative_to(path).as_posix(): None for file in files}
    try:
        with open_file(path) as file, open_archive(file) as archive:
            return {info.filename: info for info in archive.infolist()}
    except OSError:
        raise
    except ARCHIVE_ERRORS as error:
        raise ValueError(f"not a complete zip archive ({error})") from error


def read_entry(path: Path, name: str, info: zipfile.ZipInfo | None) -> bytes:
    """Reads one file.

    Raises:
        OSError: it cannot be read.
        ValueError: truncated, damaged, encrypted, too large, or compressed in an unknown way; the message says which.
    """
    if info is None:
        return read_frame_file(path / name)
    if info.flag_bits & ENCRYPTED:
        raise ValueError("it is encrypted")
    require_memory(more_bytes=info.file_size + info.compress_size)
    with open_file(path) as file:
        file.seek(info.header_offset)
        head = file.read(len(SIGNATURE) + HEAD.size - 4)
        if not head.startswith(SIGNATURE) or len(head) < HEAD.size:
            raise ValueError("the archive is damaged here")
        file.seek(sum(HEAD.unpack(head)), 1)
        data = file.read(info.compress_size)
    if info.compress_type == zipfile.ZIP_DEFLATED:
        try:
            data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, info.file_size + 1)
        except zlib.error as error:
            raise ValueError("its compression is damaged") from error
    elif info.compress_type != zipfile.ZIP_STORED:
        raise ValueError("it is compressed in an unknown way; pack the archive again, without compression")
    if len(data) != info.file_size or zlib.crc32(data) != info.CRC:
        raise ValueError("it is truncated or damaged")
    return data
