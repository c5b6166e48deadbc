"""Weights, checkpoints, exports and descriptions from strangers: refused with a clear error, or harmless."""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import shutil
import socket
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import NUMPY_CACHE, PICKLES, Called, Touch, safetensors, sent_project, torch_file
from live_server import running

from annotator.cli.main import main
from annotator.detection.config import DetectorConfig, TrainingConfig
from annotator.detection.dataset import TrainingSample, write_dataset
from annotator.detection.trained import LAST, STATE, read_checkpoint
from annotator.detection.training import train_detector
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import (
    DESCRIPTION,
    NetworkDescription,
    build,
    load_weights,
    read_tensors,
    write_network,
    write_tensors,
)
from annotator.detection.yolo import YoloDetector
from annotator.files import NETWORK_BYTES
from annotator.types import Box2D, BoxKind, DetectorKind
from annotator.types.errors import AnnotatorError, DetectionError
from annotator.web.security import ServerSettings

UNREADABLE = "cannot be read as detector weights"


@pytest.fixture
def trap(tmp_path: Path) -> Iterator[Path]:
    """A file that code of an attack would create."""
    path = tmp_path / "code was run"
    yield path
    assert not path.exists()


@pytest.fixture
def sent(tmp_path: Path, generated: Path, trap: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The project `sent` in the folder `projects`; it is the working folder, too."""
    folder = sent_project(tmp_path / "projects", generated / "people", trap, PICKLES["archive"](trap))
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound network file."""
    path = tmp_path_factory.mktemp("network") / "detector.safetensors"
    write_network(path, build(NetworkDescription(architecture="yolo11n", labels=("cat",))))
    return path


@pytest.mark.parametrize("backend", ["auto", "torch", "openvino"])
@pytest.mark.parametrize("kind", PICKLES)
def test_no_backend_runs_a_pickle(tmp_path: Path, trap: Path, kind: str, backend: Any) -> None:
    for name in ("detector.pt", "detector.safetensors"):
        (tmp_path / name).write_bytes(PICKLES[kind](trap))
        with pytest.raises(DetectionError, match=UNREADABLE):
            YoloDetector(tmp_path / name, DetectorConfig(image_size_px=96, device="cpu", backend=backend))


@pytest.mark.parametrize(
    ("words", "codes", "said"),
    [
        (["annotate", "sent", "--engine", "inline"], {2}, UNREADABLE),
        (["annotate", "sent", "--backend", "openvino"], {2}, UNREADABLE),
        (["lift", "sent", "--detector", "best.pt"], {2}, UNREADABLE),
        (["live", "sent", "people", "--limit", "1", "--port", "0"], {2}, UNREADABLE),
        (["train", "sent", "--only", "image", "--weights", "best.pt"], {2}, UNREADABLE),
        (["train", "sent", "--only", "view", "--epochs", "1", "--views", "2", "--weights", "never"], {0, 2}, ""),
        (["stats", "sent"], {0}, ""),
        (["check", "sent"], {0}, ""),
        (["export", "sent", "out"], {0}, ""),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_no_command_runs_code_of_a_sent_project(
    sent: Path, generated: Path, words: list[str], codes: set[int], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(generated / "people") if word == "people" else word for word in words]
    words = [str(sent.parent.parent / "out") if word == "out" else word for word in words]
    code = main([*words, "--projects", str(sent.parent)])
    answer = capsys.readouterr()
    assert code in codes, answer
    assert said in answer.err + answer.out
    assert "/etc/passwd" not in answer.err + answer.out


def test_a_server_runs_no_code_of_a_sent_project(sent: Path) -> None:
    with running(ServerSettings(sent.parent, port=0)) as live:
        frame = "/api/projects/sent/frames/1"
        for path in ("/api/projects", "/api/projects/sent", "/api/projects/sent/models", frame):
            assert live.client.get(path).status_code == 200, path
        project = live.context.project("sent")
        while (ready := live.context.caches.detectors.readiness(project, DetectorKind.VIEW)).state == "loading":
            pass
        assert ready.state == "failed"
        suggestions = live.client.get(f"{frame}/label/suggestions")
        assert suggestions.status_code == 200 and UNREADABLE in suggestions.text
        live.client.post("/api/projects/sent/models/1/activate")


def training_set(folder: Path) -> Path:
    rgb = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    samples = [TrainingSample(rgb, (Box2D("cat", 8.0, 8.0, 40.0, 40.0),), str(i), "drawn") for i in range(4)]
    write_dataset(folder, samples, ["cat"], {"3"}.__contains__, kind=BoxKind.BOX)
    return folder


def test_a_training_reads_no_cache_and_no_checkpoint_of_a_sent_project(
    tmp_path: Path, trap: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, out = training_set(tmp_path / "dataset"), tmp_path / "run"
    code = PICKLES["archive"](trap)
    for split in ("train", "val"):
        (dataset / "labels" / f"{split}.cache").write_bytes(NUMPY_CACHE + pickle.dumps(Touch(trap)))
        (dataset / "labels" / f"{split}.cache.npy").write_bytes(NUMPY_CACHE + pickle.dumps(Touch(trap)))
    for name in ("last.pt", "best.pt", "last.safetensors", "best.safetensors"):
        (out / "weights").mkdir(parents=True, exist_ok=True)
        (out / "weights" / name).write_bytes(code)
    monkeypatch.chdir(tmp_path)
    for name in ("yolo11n.yaml", "yolo11.yaml", "data.yaml"):
        (tmp_path / name).write_text(f"activation: open({str(trap)!r}, 'w')\nnc: 1\nbackbone: []\nhead: []\n")
    config = TrainingConfig(pretrained="never", image_size_px=64, epochs=1, batch=2, device="cpu")
    assert train_detector(dataset, out, config, role=DetectorKind.IMAGE).epochs == 1


HOSTILE_STATES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no settings": lambda state: state | {"groups": [{} for _ in state["groups"]]},
    "other parameters": lambda state: state | {"groups": [{**g, "params": [10**9]} for g in state["groups"]]},
    "attributes": lambda state: state | {"plain": {"0": {"__class__": 1.0}}},
    "negative epoch": lambda state: state | {"epoch": -5},
    "not a number": lambda state: state | {"stopper": {"best_fitness": None, "best_epoch": None}},
    "code": lambda state: state | {"code": "print()"},
}


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A training set, and the folder of a training that was stopped after its first epoch."""
    folder = tmp_path_factory.mktemp("interrupted")
    training_set(folder / "dataset")
    done: list[int] = []

    def progress(report: Any) -> None:
        done.append(report.epoch)

    with pytest.raises(AnnotatorError):
        train_detector(folder / "dataset", folder / "run", RESUMED, progress, stop=lambda: max(done, default=0) >= 1)
    assert (folder / "run" / "weights" / LAST).is_file()
    return folder / "dataset", folder / "run"


RESUMED = TrainingConfig(pretrained="never", image_size_px=64, epochs=2, batch=2, device="cpu")


@pytest.mark.parametrize("kind", HOSTILE_STATES)
def test_a_hostile_checkpoint_is_an_error_or_harmless(
    interrupted: tuple[Path, Path], tmp_path: Path, kind: str
) -> None:
    dataset, out = interrupted[0], Path(shutil.copytree(interrupted[1], tmp_path / "run"))
    path = out / "weights" / LAST
    tensors, facts = read_tensors(path, "")
    facts[STATE] = json.dumps(HOSTILE_STATES[kind](json.loads(facts[STATE])))
    write_tensors(path, tensors, facts)
    try:
        train_detector(dataset, out, RESUMED)
    except AnnotatorError as error:
        assert str(out) in str(error)


HEADER = {"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}}
FILES: dict[str, bytes] = {
    "huge header": safetensors(HEADER, bytes(8), 2**62),
    "no JSON": safetensors(b"{\x00\xff\xfe}"),
    "deep JSON": safetensors(b'{"a":' * 100_000),
    "negative offsets": safetensors({"a": {"dtype": "F32", "shape": [2], "data_offsets": [-8, 0]}}, bytes(8)),
    "overlap": safetensors({**HEADER, "b": HEADER["a"]}, bytes(8)),
    "metadata that is no text": safetensors({"__metadata__": {"description": {"a": 1}}, **HEADER}, bytes(8)),
    "no description": safetensors(HEADER, bytes(8)),
    "two equal names": safetensors(
        b'{"a":{"dtype":"U8","shape":[1],"data_offsets":[0,1]},"a":{"dtype":"U8","shape":[1],"data_offsets":[1,2]}}',
        b"12",
    ),
    "many tensors": safetensors(
        {str(i): {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]} for i in range(200_000)}
    ),
}


@pytest.mark.parametrize("kind", FILES)
def test_hostile_network_files_are_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "detector.safetensors"
    path.write_bytes(FILES[kind])
    with pytest.raises(DetectionError, match=f"detector.safetensors: {UNREADABLE}"):
        load_weights(path, "cpu")
    with pytest.raises(DetectionError):
        read_checkpoint(path)


def test_huge_files_and_pipes_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "detector.safetensors"
    for begin in (FILES["no description"], b"PK\x03\x04"):
        with path.open("wb") as file:
            file.write(begin)
            file.truncate(50 * NETWORK_BYTES)  # a hole
        with pytest.raises(DetectionError):
            load_weights(path, "cpu")
        with pytest.raises(DetectionError):
            YoloDetector(path, DetectorConfig(image_size_px=96))
        path.unlink()
    os.mkfifo(path)
    for read in (lambda: load_weights(path, "cpu"), lambda: YoloDetector(path, DetectorConfig(image_size_px=96))):
        with pytest.raises(DetectionError):
            read()


@pytest.mark.parametrize(
    "changes",
    [
        {"architecture": "yolo11x"},
        {"architecture": "../../../tmp/yolo11n"},
        {"architecture": "yolo" + "1" * 10_000},
        {"architecture": "__import__('os')"},
        {"labels": ["x"] * 10_001},
        {"labels": ["x" * 10**6]},
        {"end2end": [1]},
        {"activation": "__import__('os')"},
    ],
    ids=lambda changes: f"{next(iter(changes))} {next(iter(changes.values()))!r:.30}",
)
def test_hostile_descriptions_are_refused(network: Path, tmp_path: Path, changes: dict[str, Any]) -> None:
    tensors, facts = read_tensors(network, "")
    described = json.loads(facts[DESCRIPTION]) | changes
    write_tensors(tmp_path / "changed", tensors, {DESCRIPTION: json.dumps(described)})
    with pytest.raises(DetectionError, match=UNREADABLE):
        load_weights(tmp_path / "changed", "cpu")


def test_wild_numbers_are_no_boxes(network: Path, tmp_path: Path) -> None:
    tensors, facts = read_tensors(network, "")
    for number in (float("nan"), float("inf")):
        wild = {
            name: value.clone().fill_(number) if value.is_floating_point() else value for name, value in tensors.items()
        }
        write_tensors(tmp_path / "wild", wild, facts)
        detector = YoloDetector(tmp_path / "wild", DetectorConfig(image_size_px=96, backend="torch", device="cpu"))

        class Picture:
            rgb = np.zeros((96, 96, 3), np.uint8)

        (boxes,) = detector.detect([Picture()])
        assert all(np.isfinite([box.x_min, box.y_min, box.x_max, box.y_max]).all() for box in boxes)


def archive(program: bytes, **files: bytes) -> bytes:
    """An archive as torch writes it, with any pickle."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("a/data.pkl", program)
        for name, content in files.items():
            packed.writestr(f"a/data/{name}", content)
    return out.getvalue()


def bomb() -> bytes:
    """A program of more bytes than any weights have, packed into a thousandth."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as packed, packed.open("a/data.pkl", "w") as file:
        for _ in range(NETWORK_BYTES // 2**24 + 1):
            file.write(bytes(2**24))
    return out.getvalue()


def nested(levels: int) -> Any:
    """A module with two children that are one module, and so on: 2**levels in all."""
    torch = api().torch
    module = torch.nn.Module()
    for _ in range(levels):
        outer = torch.nn.Module()
        outer.a = outer.b = module
        module = outer
    return module


def in_network(change: Callable[[Any], None]) -> bytes:
    """A detection model after a change."""
    model = api().DetectionModel("yolo11n.yaml", nc=1, verbose=False)
    change(model)
    return torch_file({"model": model})


def replaced(value: Any) -> Callable[[Any], None]:
    def change(model: Any) -> None:
        model.model[0]._buffers["extra"] = value

    return change


def exceeding(torch: Any, size: tuple[int, ...], stride: tuple[int, ...], offset: int) -> Any:
    storage = torch.zeros(4).untyped_storage()
    typed = torch.storage.TypedStorage(wrap_storage=storage, dtype=torch.float32, _internal=True)
    return Called(torch._utils._rebuild_tensor_v2, typed, offset, size, stride, False, OrderedDict())


ATTACKS: dict[str, Callable[[], bytes]] = {
    "a function of the system": lambda: torch_file({"model": Called(os.system, "true")}),
    "torch.hub": lambda: torch_file({"model": Called(api().torch.hub.load, "a/b", "c")}),
    "a network of any description": lambda: torch_file({"model": Called(api().DetectionModel, "/etc/passwd")}),
    "2**60 layers in a network": lambda: in_network(lambda model: model.model.add_module("0", nested(60))),
    "no model": lambda: torch_file([1, 2, 3]),
    "a bomb": bomb,
    "deep": lambda: archive(b"\x80\x02" + b"(" * 10**6 + b"."),
    "a long text": lambda: archive(b"\x80\x04\x8d" + struct.pack("<Q", 2**62)),
    "another version": lambda: archive(b"\x80\xff."),
    "an attribute in the place of a method": lambda: archive(
        b"\x80\x02ccollections\nOrderedDict\n)R}(X\x03\x00\x00\x00getK\x01ub."
    ),
    "beyond the storage": lambda: in_network(replaced(exceeding(api().torch, (10**9,), (1,), 0))),
    "overflow": lambda: in_network(replaced(exceeding(api().torch, (2**62, 2**62), (2**62, 1), 0))),
    "a petabyte by repetition": lambda: in_network(replaced(exceeding(api().torch, (10**9, 10**6), (0, 0), 0))),
    "a text as size": lambda: in_network(replaced(exceeding(api().torch, ("x",), (1,), 0))),
    "another architecture": lambda: in_network(lambda model: model.yaml.update(yaml_file="yolo11x.yaml")),
    "a URL": lambda: in_network(lambda model: model.yaml.update(yaml_file="http://127.0.0.1/yolo99n.yaml")),
    "no architecture": lambda: in_network(lambda model: model.yaml.clear()),
    "many classes": lambda: in_network(lambda model: setattr(model, "names", dict.fromkeys(range(10**6), "x"))),
    "classes that are no texts": lambda: in_network(lambda model: setattr(model, "names", {0: model.yaml})),
}


@pytest.mark.parametrize("kind", ATTACKS)
def test_hostile_pickles_are_refused(tmp_path: Path, kind: str) -> None:
    (tmp_path / "detector.pt").write_bytes(ATTACKS[kind]())
    with pytest.raises(DetectionError, match=rf"detector\.pt: {UNREADABLE}"):
        load_weights(tmp_path / "detector.pt", "cpu")


def test_reading_weights_asks_no_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(socket.socket, "connect", lambda _, address: asked.append(address))
    url = "http://127.0.0.1:80/yolo11n.yaml"
    monkeypatch.chdir(tmp_path)
    for content in (
        torch_file({"model": Called(api().DetectionModel, url)}),
        torch_file({"model": Called(api().torch.hub.load_state_dict_from_url, url)}),
        in_network(lambda model: model.yaml.update(yaml_file=url)),
    ):
        (tmp_path / "detector.pt").write_bytes(content)
        # the last one names an architecture of ultralytics, and only that is used of the URL
        try:
            load_weights(tmp_path / "detector.pt", "cpu")
        except DetectionError as error:
            assert UNREADABLE in str(error)
    with pytest.raises(DetectionError):
        build(NetworkDescription.model_construct(architecture=url.removesuffix(".yaml"), labels=("a",)))
    assert asked == []
    assert [path.name for path in tmp_path.iterdir()] == ["detector.pt"]


@pytest.mark.parametrize("kind", ["pickle", "network file"])
def test_random_damage_is_an_error_or_harmless(
    network: Path, tmp_path: Path, kind: str, chance: random.Random, times: int
) -> None:
    content = network.read_bytes() if kind == "network file" else in_network(lambda model: model.half())
    # where the damage matters: in the header, and in the program of the pickle
    where = 60_000 if kind == "network file" else content.index(b"data.pkl") + 60_000
    path = tmp_path / "detector"
    for _ in range(5 * times):
        damaged = bytearray(content)
        for _ in range(chance.choice((1, 3, 30))):
            damaged[chance.randrange(where)] = chance.randrange(256)
        path.write_bytes(damaged[: chance.choice((len(damaged), chance.randrange(len(damaged))))])
        try:
            load_weights(path, "cpu")
        except DetectionError as error:
            assert UNREADABLE in str(error)


@pytest.mark.parametrize("weights", ["/etc/passwd", "../../../../outside.pt", "~/outside.pt", "https://a.b/c.pt"])
def test_a_training_names_weights_in_its_folder_only(
    sent: Path, weights: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = sent / "models" / "view" / "run" / "model.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"weights": weights}), encoding="utf-8")
    (sent / "models" / "image" / "run" / "model.json").write_bytes(file.read_bytes())
    assert main(["annotate", "sent", "--projects", str(sent.parent)]) == 2
    assert "names weights outside its folder" in capsys.readouterr().err
