"""The choice of the engine, paths of recordings on workers, and packed weights; no workers are started."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from engine_samples import Unloadable

from annotator.types import BoxKind
from annotator.types.errors import ConfigError, DetectionError, WorkerError
from annotator.workflows.proposing import engines
from annotator.workflows.proposing.engines import MIN_FRAMES, EngineName, cuda_devices, make_engine
from annotator.workflows.proposing.pool import TASKS_PER_WORKER, WorkerPool
from annotator.workflows.proposing.runner import InlineEngine
from annotator.workflows.proposing.tasks import (
    PackedDetectors,
    Storage,
    TrainedDetectors,
    parse_elsewhere,
    scratch_folder,
)


@pytest.mark.parametrize(
    ("name", "cores", "gpus", "options", "workers"),
    [
        ("auto", 4, (), {}, 4),
        ("auto", 4, (), {"workers": 3}, 3),
        ("auto", 4, (), {"workers": 1}, None),
        ("auto", 1, (), {}, None),
        ("auto", 1, ("0",), {}, 1),
        ("auto", 4, (), {"frames": MIN_FRAMES - 1}, None),
        ("local", 4, (), {"frames": 1}, 4),
        ("local", 8, ("0", "1"), {}, 2),
        ("inline", 4, (), {}, None),
    ],
)
def test_the_number_of_workers_depends_on_cores_gpus_and_frames(
    name: str,
    cores: int,
    gpus: tuple[str, ...],
    options: dict[str, int],
    workers: int | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(engines, "usable_cores", lambda: cores)
    monkeypatch.setattr(engines, "cuda_devices", lambda: gpus)
    engine = make_engine(EngineName(name), Unloadable(), **{"frames": 1000, **options})
    assert isinstance(engine, InlineEngine if workers is None else WorkerPool)
    assert engine.window == (1 if workers is None else workers * (TASKS_PER_WORKER + 1))


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("local", {"workers": 0}, "--workers 0 is too small"),
        ("inline", {"threads": -1}, "--threads -1 is too small"),
        ("inline", {"workers": 2}, "has no workers"),
        ("local", {"address": "auto"}, "add --engine ray"),
    ],
)
def test_conflicting_options_are_errors(name: str, options: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        make_engine(EngineName(name), Unloadable(), frames=100, **options)


def test_without_gpus_counting_devices_needs_no_torch(tmp_path: Path) -> None:
    assert cuda_devices(tmp_path) == ()


def test_paths_are_mapped_to_the_longest_matching_folder() -> None:
    storage = Storage(parse_elsewhere(["/data/a=s3://bucket/a/", "/data=/mnt/data"]))
    assert storage.place(Path("/data/a/room")) == "s3://bucket/a/room"
    assert storage.place(Path("/data/a")) == "s3://bucket/a"
    assert storage.place(Path("/data/b/room")) == "/mnt/data/b/room"
    assert storage.place(Path("/database/room")) == "/database/room"


@pytest.mark.parametrize("word", ["", "/data", "=s3://bucket", "/data="])
def test_invalid_mappings_are_errors(word: str) -> None:
    with pytest.raises(ConfigError, match="not of the form FOLDER=PLACE"):
        parse_elsewhere([word])


def test_weights_are_unpacked_once_into_a_private_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "training"
    folder.mkdir()
    trained = TrainedDetectors(folder / "detector.pt", folder / "detector.pt", BoxKind.BOX)
    with pytest.raises(DetectionError, match="train the detector again"):
        PackedDetectors.of(trained)
    (folder / "detector.pt").write_bytes(b"weights")
    (folder / "model.json").write_text("{}")
    packed = PackedDetectors.of(trained)
    place = packed.image.unpacked(tmp_path / "out")
    for path in (place, place.with_name("model.json")):  # the system may remove temporary files one by one
        before = place.stat().st_ino
        assert packed.image.unpacked(tmp_path / "out") == place and place.stat().st_ino == before
        path.unlink()
        assert packed.image.unpacked(tmp_path / "out") == place and place.read_bytes() == b"weights"
    assert sorted(path.name for path in (tmp_path / "out").rglob("*") if path.is_file()) == [
        "detector.pt",
        "model.json",
    ]
    with pytest.raises(DetectionError, match=r"detector\.pt.*: cannot be written .*TMPDIR"):
        packed.image.unpacked(folder / "detector.pt")

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert scratch_folder().stat().st_mode & 0o077 == 0
    scratch_folder().chmod(0o777)
    with pytest.raises(WorkerError, match="other users can write to it"):
        scratch_folder()
