"""Weights: nothing in a file is run, what does not fit is refused; loading ultralytics has no side effects."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import pytest
from time_limit import time_limit

from annotator.detection import weights
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import (
    DESCRIPTION,
    NetworkDescription,
    build,
    describe,
    load_weights,
    read_tensors,
    write_network,
    write_tensors,
)
from annotator.types.errors import DetectionError


@pytest.fixture(scope="module")
def model() -> Any:
    with api().torch.random.fork_rng(devices=[]):
        api().torch.manual_seed(0)
        return build(NetworkDescription(architecture="yolo11n", labels=("cat", "dog"))).eval()


@pytest.fixture
def file(model: Any, tmp_path: Path) -> Path:
    write_network(tmp_path / "network", model)
    return tmp_path / "network"


def test_a_network_is_read_as_it_was_written(model: Any, file: Path) -> None:
    read = load_weights(file, "cpu")
    assert describe(read) == describe(model)
    assert read.names == {0: "cat", 1: "dog"}
    written = model.state_dict()
    for name, tensor in read.state_dict().items():
        # half precision has 11 significant bits
        assert api().torch.allclose(tensor.float(), written[name].float(), rtol=2**-10, atol=1e-7), name
    assert file.stat().st_size < 6_000_000


def changed(file: Path, **changes: Any) -> Path:
    """A copy of a file with other facts about its network."""
    tensors, facts = read_tensors(file, "")
    described = json.loads(facts[DESCRIPTION]) | changes
    write_tensors(file.with_name("changed"), tensors, {DESCRIPTION: json.dumps(described)})
    return file.with_name("changed")


@pytest.mark.parametrize(
    "changes",
    [
        {"labels": ["cat", "dog", "cow"]},
        {"architecture": "yolo11s"},
        {"architecture": "../../yolo11n"},
        {"format": "annotator network 2"},
        {"code": "print()"},
    ],
)
def test_a_description_that_does_not_fit_is_refused(file: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(
        DetectionError, match=r"changed: cannot be read as detector weights .*; train the detector again"
    ):
        load_weights(changed(file, **changes), "cpu")


class Touch:
    """Creates a file when it is unpickled by an unsafe reader."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self._path,)


@pytest.mark.parametrize("name", ["detector.pt", "detector.safetensors"])
def test_no_code_of_a_weights_file_is_run(tmp_path: Path, name: str) -> None:
    trap = tmp_path / "ran"
    api().torch.save({"model": Touch(trap)}, tmp_path / name)
    with pytest.raises(DetectionError, match=f"{name}: cannot be read as detector weights"):
        load_weights(tmp_path / name, "cpu")
    (tmp_path / name).write_bytes(pickle.dumps(Touch(trap)))
    with pytest.raises(DetectionError, match=f"{name}: cannot be read as detector weights"):
        load_weights(tmp_path / name, "cpu")
    assert not trap.exists()


@pytest.mark.parametrize(
    "name",
    ["yolo26n", pytest.param("yolo11n", marks=pytest.mark.slow), pytest.param("yolov5n6", marks=pytest.mark.slow)],
)
def test_an_old_file_is_converted_once_and_stays_the_same(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    torch, old = api().torch, tmp_path / "detector.pt"
    written = api().DetectionModel(f"{name}.yaml", nc=2, verbose=False)
    written.names = {1: "dog", 0: "cat"}
    torch.save({"model": None, "ema": written.half(), "train_args": {"data": Path("/set")}}, old)
    first = load_weights(old, "cpu")
    monkeypatch.setattr(weights, "_network", None)  # reading the pickle again would fail
    for read in (first, load_weights(old, "cpu")):
        assert read.names == {0: "cat", 1: "dog"}
        assert bool(read.end2end) == bool(written.end2end)
        for key, tensor in written.state_dict().items():
            assert torch.equal(read.state_dict()[key], tensor.float() if tensor.is_floating_point() else tensor), key
    assert [path.suffix for path in (tmp_path / "cache" / "annotator" / "converted").iterdir()] == [".safetensors"]


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (b")" + b"2\x86" * 60 + b"0}" + b")" + b"2\x86" * 60 + b"K\x01s.", "unhashable"),  # takes 2**60 steps to hash
        (b"r\xff\xff\xff\x7f" + b".", "cannot be read"),  # memory for 2**31 remembered objects
        (b"]" * (2**22 + 1) + b".", "more than 4 MiB"),
    ],
)
def test_a_weights_file_that_takes_time_or_memory_is_refused(tmp_path: Path, program: bytes, reason: str) -> None:
    with zipfile.ZipFile(tmp_path / "detector.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", b"\x80\x02" + program)
    tracemalloc.start()
    try:
        with time_limit(20), pytest.raises(DetectionError, match=reason):
            load_weights(tmp_path / "detector.pt", "cpu")
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()


class Made:
    """Pickled as a call of a class, with arguments."""

    def __init__(self, kind: Any, *args: Any) -> None:
        self._call = kind, args

    def __reduce__(self) -> Any:
        return self._call


def test_no_layer_of_a_weights_file_is_constructed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ultralytics' safe loading would allocate any amount of memory, and read and download any description."""
    made: list[str] = []
    torch = api().torch
    for kind in (torch.nn.Linear, api().DetectionModel):
        monkeypatch.setattr(kind, "__init__", lambda self, *_, **__: made.append(type(self).__name__))
        torch.save({"model": Made(kind, 10**6, 10**6)}, tmp_path / "detector.pt")
        made.clear()
        with pytest.raises(DetectionError, match="holds no network"):
            load_weights(tmp_path / "detector.pt", "cpu")
    assert made == []


def test_no_description_in_the_working_folder_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trap = tmp_path / "ran"
    for name in ("yolo11n.yaml", "yolo11.yaml"):
        code = f"activation: __import__('pathlib').Path({str(trap)!r}).touch()\n"
        (tmp_path / name).write_text(f"nc: 1\n{code}backbone: []\nhead: []\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert len(build(NetworkDescription(architecture="yolo11n", labels=("cat",))).model) == 24
    assert not trap.exists()


ROOT = Path(__file__).resolve().parents[2]


SILENT = """
import json, os, socket, sys
asked = []
def refuse(*args, **kwargs):
    asked.append(str(args))
    raise OSError("no network in this test")
socket.getaddrinfo = socket.socket.connect = socket.create_connection = refuse
import cv2, numpy
before = dict(os.environ), str(numpy.get_printoptions()), cv2.getNumThreads()
from annotator.detection.ultralytics_api import api
parts = api()
after = dict(os.environ), str(numpy.get_printoptions()), cv2.getNumThreads()
changed = sorted(k for k in after[0] if before[0].get(k) != after[0][k])
print(json.dumps({
    "asked": asked, "changed": changed, "gone": sorted(set(before[0]) - set(after[0])), "same": before[1:] == after[1:],
    "threads": [parts.threads, parts.torch.get_num_threads()], "torchvision": "torchvision" in sys.modules,
}))
"""


def run(code: str, tmp_path: Path) -> tuple[str, Path]:
    work, home = tmp_path / "work", tmp_path / "home"
    work.mkdir()
    home.mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("YOLO_", "OMP_", "XDG_", "ULTRALYTICS_"))}
    environment |= {"HOME": str(home), "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=work,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert list(work.iterdir()) == []
    return done.stdout, home


def test_loading_has_no_side_effects_except_the_stated_variables_and_settings(tmp_path: Path) -> None:
    out, home = run(SILENT, tmp_path)
    state = json.loads(out)
    assert state["asked"] == []
    assert state["gone"] == []
    assert state["same"]
    assert state["changed"] == [
        "ULTRALYTICS_SAFE_LOAD",
        "YOLO_AUTOINSTALL",
        "YOLO_CONFIG_DIR",
        "YOLO_OFFLINE",
        "YOLO_VERBOSE",
    ]
    assert state["threads"][0] == state["threads"][1]
    assert not state["torchvision"]
    files = sorted(str(path.relative_to(home)) for path in home.rglob("*") if path.is_file())
    assert files == [".cache/annotator/Ultralytics/settings.json"]


# scipy gets its first array while another thread imports torch; scipy remembers what it found out earlier
PROGRAM = """
import sys, threading
from scipy.spatial.transform import Rotation
from annotator.detection.ultralytics_api import api

loading = threading.Thread(target=api)
loading.start()
while "torch" not in sys.modules:
    pass
Rotation.from_quat([0.0, 0.0, 0.0, 1.0])
print("incomplete" if not hasattr(sys.modules["torch"], "nn") else "complete")
loading.join()
torch = api().torch
assert torch.Tensor.__module__ == "torch" and isinstance(torch.zeros(1), torch.Tensor), torch.Tensor
"""


def test_rotations_work_while_another_thread_imports_torch() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "incomplete\n"
