"""Weights whose pickle is small, but takes exponential time or memory to hash, compare, print or read."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import pytest

from annotator.detection.weights import MOST_NAME, load_weights
from annotator.types.errors import DetectionError

LEVELS = 60


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def mapping(**values: bytes) -> bytes:
    return b"}(" + b"".join(text(name) + value for name, value in values.items()) + b"u"


def layer(name: str, **state: bytes) -> bytes:
    empty = {"_parameters": b"}", "_buffers": b"}", "_modules": b"}"}
    return b"cultralytics.nn\n" + name.encode() + b"\n)R" + mapping(**(empty | state)) + b"b"


def tensor(key: bytes, storage: str = "FloatStorage") -> bytes:
    """A tensor of one number."""
    stored = b"(" + text("storage") + b"ctorch\n" + storage.encode() + b"\n" + key + text("cpu") + b"K\x01tQ"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + stored + b"K\x00(K\x01t(K\x01t\x89NtR"


def network(
    names: bytes = b"}K\x00X\x01\x00\x00\x00as", end2end: bytes = b"N", layer_name: str = "0", **parameters: bytes
) -> bytes:
    """The program of a detection model of one layer."""
    head = layer("Detect", _end2end=end2end, _parameters=mapping(**parameters))
    layers = layer("Sequential", _modules=mapping(**{layer_name: head}))
    yaml = mapping(yaml_file=text("yolo11n.yaml"))
    model = layer("DetectionModel", _modules=mapping(model=layers), names=names, yaml=yaml)
    return b"\x80\x04" + mapping(model=model) + b"."


def shared_tuples() -> bytes:
    """A tuple of two equal tuples, and so on: 2**LEVELS in all, in two bytes each."""
    return b"K\x01" + b"2\x86" * LEVELS


def shared_sets() -> bytes:
    """Two equal nested frozen sets as keys of one mapping."""
    level = b"q\x01(h\x01(h\x01\x91\x91"  # keeps the set, and makes {set, {set}} of it
    one = b"(K\x01\x91" + level * LEVELS
    return b"}(" + one + b"K\x01" + one + b"K\x02u"


PROGRAMS = {
    "tuples as the name of a storage": network(w=tensor(shared_tuples())),
    "tuples as the name of a class": network(names=b"}K\x00" + shared_tuples() + b"s"),
    "tuples as a setting": network(end2end=shared_tuples()),
    "tuples as a key": network(names=b"}" + shared_tuples() + text("a") + b"s"),
    "frozen sets": network(names=shared_sets()),
    "a long name for many tensors": network(layer_name="x" * MOST_NAME, w=tensor(text("0"))),
}


def written(path: Path, program: bytes, storage_bytes: int = 4) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", program)
        archive.writestr("a/data/0", bytes(storage_bytes))
    return path


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", PROGRAMS)
def test_small_pickles_take_no_exponential_time(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path / "detector.pt", PROGRAMS[kind])
    with pytest.raises(DetectionError, match=r"detector\.pt: cannot be read as detector weights \("):
        load_weights(path, "cpu")


def test_a_storage_is_read_once_for_all_formats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    formats = ("FloatStorage", "HalfStorage", "DoubleStorage", "ByteStorage")
    tensors = {f"w{number}": tensor(text("0"), storage) for number, storage in enumerate(formats)}
    path = written(tmp_path / "detector.pt", network(**tensors), storage_bytes=1 << 10)
    read: list[str] = []
    original = zipfile.ZipFile.read

    def counted(archive: zipfile.ZipFile, name: str, *rest: object) -> bytes:
        read.append(name)
        return original(archive, name)

    monkeypatch.setattr(zipfile.ZipFile, "read", counted)
    with pytest.raises(DetectionError):  # it is not a yolo11n
        load_weights(path, "cpu")
    assert read.count("a/data/0") == 1
