"""A project that a stranger sent: code wherever weights are looked for, and links."""

from __future__ import annotations

import io
import json
import pickle
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from annotator.cli.main import main
from annotator.detection.config import TrainingConfig
from annotator.detection.trained import TrainedModel, TrainingMetrics
from annotator.detection.ultralytics_api import api
from annotator.project import Project, open_project
from annotator.types import BoxKind, DetectorKind

EVIL_YAML = "nc: 1\nactivation: __import__('pathlib').Path({trap!r}).touch()\nbackbone: []\nhead: []\n"
NUMPY_CACHE = b"\x93NUMPY\x01\x00v\x00{'descr': '|O', 'fortran_order': False, 'shape': (), }" + b" " * 60 + b"\n"


class Touch:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self._path,)


class Called:
    """Pickled as a call of a function or class."""

    def __init__(self, call: Any, *args: Any) -> None:
        self._call = call, args

    def __reduce__(self) -> Any:
        return self._call


def torch_file(content: Any) -> bytes:
    """A file as torch writes it."""
    file = io.BytesIO()
    api().torch.save(content, file)
    return file.getvalue()


def torch_script(trap: Path) -> bytes:
    """An archive of TorchScript, with a pickle in the place of its constants."""
    torch, file = api().torch, io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        torch.jit.save(torch.jit.trace(torch.nn.Identity(), torch.zeros(1)), file)
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(file.getvalue())) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            is_pickle = name.endswith(("data.pkl", "constants.pkl"))
            new.writestr(name, pickle.dumps(Touch(trap)) if is_pickle else old.read(name))
    return out.getvalue()


def in_a_network(trap: Path) -> bytes:
    """A detection model, complete, with one layer that is code."""
    model = api().DetectionModel("yolo11n.yaml", nc=1, verbose=False)
    model.model[3].hidden = Touch(trap)
    return torch_file({"model": model})


PICKLES: dict[str, Callable[[Path], bytes]] = {
    "raw": lambda trap: pickle.dumps(Touch(trap)),
    "archive": lambda trap: torch_file({"model": Touch(trap)}),
    "in a network": in_a_network,
    "TorchScript": torch_script,
}
NAMES = ("detector.pt", "detector.safetensors", "best.pt", "last.pt", "yolo11n.pt", "network.onnx", "train.cache")


def sent_project(root: Path, recording: Path, trap: Path, weights: bytes, name: str = "detector.pt") -> Path:
    """The project `sent`, with labels, two active models of these weights, and code wherever it could be looked for."""
    for words in (["new", "sent", "--classes", "person"], ["add", "sent", str(recording)]):
        assert main([*words, "--projects", str(root)]) == 0
    with open_project(root / "sent") as project:
        for role in DetectorKind:
            _model(project, role, weights, name, trap)
        folder = project.path
    code = PICKLES["archive"](trap)
    for place in (folder, folder / "models", folder / "models" / "weights", folder / "weights"):
        place.mkdir(exist_ok=True)
        for file in NAMES:
            (place / file).write_bytes(code)
        for file in ("yolo11n.yaml", "yolo11.yaml", "data.yaml"):
            (place / file).write_text(EVIL_YAML.format(trap=str(trap)), encoding="utf-8")
    return folder


def _model(project: Project, role: DetectorKind, weights: bytes, name: str, trap: Path) -> None:
    folder = project.models_folder / role.value / "run"
    (folder / "weights").mkdir(parents=True)
    (folder / name).write_bytes(weights)
    code = PICKLES["archive"](trap)
    dataset = folder.parent / "dataset"
    for place in (folder / "weights", dataset / "labels", dataset / "images" / "train"):
        place.mkdir(parents=True, exist_ok=True)
        for file in ("last.pt", "best.pt", "last.safetensors", "best.safetensors"):
            (place / file).write_bytes(code)
    for file in ("labels/train.cache", "labels/val.cache", "images/train/0.npy"):
        (dataset / file).parent.mkdir(parents=True, exist_ok=True)
        (dataset / file).write_bytes(NUMPY_CACHE + pickle.dumps(Touch(trap)))
    config = TrainingConfig(image_size_px=96)
    TrainedModel(
        role=role,
        weights=folder / name,
        classes=("person",),
        kind=BoxKind.BOX,
        image_size_px=96,
        metrics=TrainingMetrics(map50=1.0, map50_95=1.0, precision=1.0, recall=1.0, measured_on="val"),
        epochs=1,
        seconds=1.0,
        pretrained=False,
        note="",
        dataset_sha256="",
        config=config,
    ).write(folder)
    facts: dict[str, Any] = {"labels": ["person"], "box_kind": BoxKind.BOX, "metrics": {"map50": 1.0}}
    project.models.register(role, folder / name, fingerprint=role.value, **facts)


def safetensors(header: Any, payload: bytes = b"", length: int | None = None) -> bytes:
    """A file with this header (JSON, or bytes)."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return (len(text) if length is None else length).to_bytes(8, "little") + text + payload
