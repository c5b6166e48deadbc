"""Cache of exported networks in the user's cache folder: each trained model is converted once."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.detection.backends.network import ExportKind, NetworkFacts
from annotator.detection.ultralytics_api import cache_dir, forget_oldest
from annotator.files import NETWORK_BYTES, new_folder, read_file
from annotator.types.errors import FormatError

RECORD, LOCK = "export.json", "exports.lock"
# Increase when the export code changes its output for the same weights and packages.
REVISIONS: Mapping[ExportKind, int] = {"openvino": 3, "onnxruntime": 2}
# An export is repeated when the version of one of these packages changes.
PACKAGES: Mapping[ExportKind, tuple[str, ...]] = {
    "openvino": ("torch", "ultralytics-opencv-headless", "openvino"),
    "onnxruntime": ("torch", "ultralytics-opencv-headless", "onnx"),
}


@dataclass(frozen=True, eq=False)
class Export:
    """A converted network.

    Attributes:
        facts: its classes, stride and kind of output.
        parts: the content of its files, by name.
    """

    facts: NetworkFacts
    parts: Mapping[str, bytes]


class _Record(BaseModel):
    """Content of `export.json`: the key of the export, the network's facts and the SHA-256 of each file by name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    facts: NetworkFacts
    files: dict[str, str]


def export_key(kind: ExportKind, weights_sha256: str) -> str:
    """Cache key of an export: SHA-256 of the weights' digest, the package versions and the revision of the export."""
    versions = {name: _version(name) for name in PACKAGES[kind]}
    inputs = json.dumps([REVISIONS[kind], kind, weights_sha256, versions], sort_keys=True)
    return hashlib.sha256(inputs.encode()).hexdigest()


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """A lock with which only one process of the user converts at a time.

    Workers start together, one per core. If each loaded torch at once, the machine could run out of memory. The
    operating system releases the lock when a process dies. Without file locks (Windows), processes do not wait.
    """
    try:
        import fcntl

        path = cache_dir() / LOCK
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except (ImportError, OSError):
        yield
        return
    with file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def find_export(kind: ExportKind, key: str) -> Export | None:
    """Reads an export from the user's cache; None if it has no valid copy."""
    folder = _place(kind, key)
    export = _read(folder, key)
    if export is not None:
        with suppress(OSError):
            os.utime(folder)  # the least recently used exports are removed
    return export


def keep_export(kind: ExportKind, key: str, export: Export) -> None:
    """Stores an export in the user's cache, and removes the least recently used ones.

    Never beside the weights: those may lie in a project that somebody else made, and an export found there could be
    anything. If the cache is not writable, a warning is logged, and the export is repeated each time. If two processes
    store the same export at once, the first result is kept.
    """
    folder = _place(kind, key)
    try:
        _write(folder, key, export)
    except (FormatError, OSError) as error:
        if _read(folder, key) is None:  # else another process was faster
            LOG.warning("an export for %s cannot be stored, so it is repeated each time: %s", kind, error)
        return
    forget_oldest(folder.parent)


def _place(kind: ExportKind, key: str) -> Path:
    return cache_dir() / "exports" / f"{kind}-{key}"


def _read(folder: Path, key: str) -> Export | None:
    try:
        record = _Record.model_validate_json(read_file(folder / RECORD))
        parts = {name: read_file(folder / name, NETWORK_BYTES) for name in record.files if Path(name).name == name}
    except (OSError, ValidationError) as error:
        if folder.exists():
            LOG.warning("%s: cannot be read (%s); exporting again", folder, type(error).__name__)
        return None
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in parts.items()}
    if record.key != key or digests != record.files:
        LOG.warning("%s: damaged; exporting again", folder)
        return None
    return Export(record.facts, parts)


def _write(folder: Path, key: str, export: Export) -> None:
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in export.parts.items()}
    record = _Record(key=key, facts=export.facts, files=digests)
    with new_folder(folder, lambda existing: _read(existing, key) is None) as part:
        for name, content in export.parts.items():
            (part / name).write_bytes(content)
        (part / RECORD).write_text(record.model_dump_json(indent=1), encoding="utf-8")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
