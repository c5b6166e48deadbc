"""Exported networks, kept so that each trained model is converted once."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.detection.backends.network import ExportKind, NetworkFacts
from annotator.detection.ultralytics_api import cache_dir
from annotator.files import new_folder
from annotator.types.errors import FormatError

LOG = logging.getLogger("annotator.detectors")

RECORD, LOCK = "export.json", "exports.lock"
# To be raised when the same weights and packages would be exported differently.
REVISIONS: Mapping[ExportKind, int] = {"openvino": 2, "onnxruntime": 1}
# An export is made anew where one of those that made it has another version.
PACKAGES: Mapping[ExportKind, tuple[str, ...]] = {
    "openvino": ("torch", "ultralytics-opencv-headless", "openvino"),
    "onnxruntime": ("torch", "ultralytics-opencv-headless", "onnx"),
}


@dataclass(frozen=True, eq=False)
class Export:
    """A converted network.

    Attributes:
        facts: what is known of it.
        parts: the content of its files, by name.
    """

    facts: NetworkFacts
    parts: Mapping[str, bytes]


class _Record(BaseModel):
    """What lies beside the files: whose export it is, and their SHA-256 by name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    facts: NetworkFacts
    files: dict[str, str]


def export_key(kind: ExportKind, weights_sha256: str) -> str:
    """What an export follows from: the weights, the packages' versions and this program's way to export."""
    versions = {name: _version(name) for name in PACKAGES[kind]}
    told = json.dumps([REVISIONS[kind], kind, weights_sha256, versions], sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """Held while a network is converted, by one of a user's processes: workers start together, one a core, and the
    memory of torch for each of them at once is more than a machine may have.

    A killed process gives it back. Where no locks can be had, nobody waits.
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


def find_export(weights: Path, kind: ExportKind, key: str) -> Export | None:
    """A kept export, beside the weights or in the user's cache; None where there is none that is whole."""
    for folder in _places(weights, kind, key):
        found = _read(folder, key)
        if found is not None:
            return found
    return None


def keep_export(weights: Path, kind: ExportKind, key: str, export: Export) -> None:
    """Keeps an export beside the weights; where nothing can be written there, in the user's cache.

    What cannot be kept at all is told in the log: it will be made anew each time. Two processes may keep the same at
    once; the first one's stays.
    """
    problems = []
    for folder in _places(weights, kind, key):
        try:
            _write(folder, key, export)
            return
        except (FormatError, OSError) as error:
            if _read(folder, key) is not None:  # somebody else was faster
                return
            problems.append(str(error))
    LOG.warning("%s: its export for %s is not kept and will be made anew: %s", weights, kind, "; ".join(problems))


def _places(weights: Path, kind: ExportKind, key: str) -> tuple[Path, Path]:
    return (
        weights.parent / f"{weights.stem}-{kind}-{key[:12]}",
        cache_dir() / "exports" / f"{kind}-{key}",
    )


def _read(folder: Path, key: str) -> Export | None:
    try:
        record = _Record.model_validate_json((folder / RECORD).read_bytes())
        parts = {name: (folder / name).read_bytes() for name in record.files if Path(name).name == name}
    except (OSError, ValidationError) as error:
        if folder.exists():
            LOG.warning("%s: cannot be read (%s); it is made anew", folder, type(error).__name__)
        return None
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in parts.items()}
    if record.key != key or digests != record.files:
        LOG.warning("%s: damaged; it is made anew", folder)
        return None
    return Export(record.facts, parts)


def _write(folder: Path, key: str, export: Export) -> None:
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in export.parts.items()}
    record = _Record(key=key, facts=export.facts, files=digests)
    with new_folder(folder, lambda there: _read(there, key) is None) as part:
        for name, content in export.parts.items():
            (part / name).write_bytes(content)
        (part / RECORD).write_text(record.model_dump_json(indent=1), encoding="utf-8")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
