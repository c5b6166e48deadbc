"""The only module that imports ultralytics; it switches off the side effects of the import.

When ultralytics is imported, or soon after, it contacts hosts, writes a settings file, installs packages, reports
usage and limits torch to one thread. This module sets ultralytics' switches first, and restores what the import
changes in the process. The packages are imported on first use.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

from annotator.types.errors import DetectionError

# Environment variables that ultralytics.utils reads when it is imported.
SWITCHES = {
    "YOLO_OFFLINE": "true",  # no network access, usage events or update check
    "YOLO_AUTOINSTALL": "false",  # a missing package is an error, not a pip run
    "YOLO_VERBOSE": "false",
    "ULTRALYTICS_SAFE_LOAD": "true",  # networks are built without eval
}
# Environment variables that the OpenMP library reads when torch loads it: waiting threads sleep. By default they spin,
# and training beside another program then takes up to twenty times as long (docs/detector_training.md).
THREAD_SWITCHES = {"OMP_WAIT_POLICY": "PASSIVE", "KMP_BLOCKTIME": "0"}
# Services to which ultralytics reports if their packages are installed.
SERVICES = ("sync", "clearml", "comet", "dvc", "mlflow", "raytune", "tensorboard", "wandb", "vscode_msg")
# Number of exports and converted networks in the cache, some 10 to 20 MB each for a nano model.
MOST_KEPT = 32


def cache_dir() -> Path:
    """The user's cache folder, for downloaded weights and ultralytics' settings."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "annotator"


def forget_oldest(folder: Path) -> None:
    """Removes the least recently used entries of a cache folder, except the newest; the others may be in use."""
    with suppress(OSError):  # another process may do the same
        for old in sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)[:-MOST_KEPT]:
            shutil.rmtree(old) if old.is_dir() else old.unlink()


@lru_cache(maxsize=1)
def api() -> SimpleNamespace:
    """The parts of ultralytics and torch that are used here, loaded on the first call.

    Attributes: `torch`, `DetectionModel`, `DetectionTrainer`, `downloads`, `weights_dir`, `version`;
    `threads`, torch's default number of threads; and `user_offline`, whether the user had set YOLO_OFFLINE. There is
    nothing that reads weights: that is `weights.load_weights`.
    """
    user_offline = os.environ.get("YOLO_OFFLINE", "").strip().lower() in {"1", "true", "yes", "on", "y", "t"}
    try:
        with _unchanged_process():
            parts = _load()
    except ImportError as error:
        raise DetectionError(
            f"the 2D detector's packages cannot be loaded ({error}); run: pip install ultralytics-opencv-headless"
        ) from error
    parts.user_offline = user_offline
    return parts


def _load() -> SimpleNamespace:
    os.environ.update(SWITCHES)
    os.environ.setdefault("YOLO_CONFIG_DIR", str(cache_dir()))
    for name, value in THREAD_SWITCHES.items():
        os.environ.setdefault(name, value)
    torch = _import_torch()  # before ultralytics, which limits it to one thread
    threads = torch.get_num_threads()
    import ultralytics
    import ultralytics.utils as utils

    # SETTINGS.update would write the user's settings file
    dict.update(utils.SETTINGS, dict.fromkeys(SERVICES, False))
    utils.LOGGER.setLevel("ERROR")
    from ultralytics.data import base, dataset
    from ultralytics.models.yolo.detect import DetectionTrainer
    from ultralytics.nn import tasks
    from ultralytics.utils import checks, downloads

    _find_architectures_in_the_package(tasks, checks, Path(ultralytics.__file__).parent / "cfg" / "models")
    dataset.load_dataset_cache_file = _unread
    base.LOCAL_RANK = 1  # its only use: images are cached without a progress bar
    return SimpleNamespace(
        torch=torch,
        DetectionModel=tasks.DetectionModel,
        DetectionTrainer=DetectionTrainer,
        downloads=downloads,
        threads=threads,
        weights_dir=Path(utils.SETTINGS["weights_dir"]),
        version=ultralytics.__version__,
    )


class _TorchWithTensor(MetaPathFinder):
    """Finds torch as usual, but gives the module a placeholder for `Tensor` before it appears in `sys.modules`.

    Python adds a module to `sys.modules` before it runs the module's code. If scipy 1.17 is first given an array during
    the seconds in which another thread imports torch, it looks up `torch.Tensor` (`_issubclass_fast` in scipy's
    array_api_compat) and raises AttributeError. In a server, the first requests would fail.
    """

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, path, target) if fullname == "torch" else None
        if spec is not None and spec.loader is not None:
            spec.loader.create_module = _with_placeholder  # type: ignore[method-assign]
        return spec


def _with_placeholder(spec: ModuleSpec) -> ModuleType:
    module = ModuleType(spec.name)
    module.Tensor = type("NoTensor", (), {})  # type: ignore[attr-defined]  # nothing is an instance of it
    return module


def _import_torch() -> ModuleType:
    finder = _TorchWithTensor()
    sys.meta_path.insert(0, finder)
    try:
        import torch
    finally:
        sys.meta_path.remove(finder)
    return torch


def _find_architectures_in_the_package(tasks: ModuleType, checks: ModuleType, folder: Path) -> None:
    """Makes ultralytics read its own descriptions of networks only.

    Its own search begins in the working folder, which may be somebody else's, and downloads URLs. A description names
    classes and has expressions that are evaluated.
    """

    def check_yaml(file: str | Path, suffix: Any = (), hard: bool = True) -> str:
        name = checks.check_yolov5u_filename(str(file))
        return next((str(path) for path in sorted(folder.rglob("*.yaml")) if path.name == name), "")

    tasks.check_yaml = check_yaml  # type: ignore[attr-defined]


def _unread(path: Path) -> Any:
    """In place of reading ultralytics' cache of a training set, which is a pickle: it is made anew."""
    raise FileNotFoundError(path)


@contextmanager
def _unchanged_process() -> Iterator[None]:
    """Restores what importing ultralytics changes: environment variables, numpy's print options, OpenCV's threads."""
    import cv2
    import numpy as np

    environment, printing, threads = dict(os.environ), np.get_printoptions(), cv2.getNumThreads()
    try:
        yield
    finally:
        np.set_printoptions(**printing)
        cv2.setNumThreads(threads)
        kept = {*SWITCHES, "YOLO_CONFIG_DIR"}
        for name in set(os.environ) - set(environment) - kept:
            del os.environ[name]
        os.environ.update({name: value for name, value in environment.items() if name not in kept})


def pick_device(device: str) -> Any:
    """A torch device from "auto", "cpu", "cuda", "cuda:1" or "mps"; auto prefers CUDA."""
    torch = api().torch
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        picked = torch.device(device)
        torch.empty(1, device=picked)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise DetectionError(f"device {device!r} cannot be used ({reason}); use auto or cpu") from error
    return picked


class CudaDevice(NamedTuple):
    """A CUDA device: torch's name of it, its model and compute capability, and its total and free memory."""

    name: str
    model: str
    memory_bytes: int
    free_bytes: int


def torch_build() -> str:
    """The version of torch and what it was built for, for people."""
    import torch

    built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
    return f"{torch.__version__}, {built}" + (", with Apple's MPS" if torch.backends.mps.is_available() else "")


def cuda_devices() -> list[CudaDevice]:
    """The CUDA devices that torch can use."""
    import torch

    if not torch.cuda.is_available():
        return []
    devices = []
    for number in range(torch.cuda.device_count()):
        facts = torch.cuda.get_device_properties(number)
        model = f"{facts.name}, compute capability {facts.major}.{facts.minor}"
        free, total = torch.cuda.mem_get_info(number)
        devices.append(CudaDevice(f"cuda:{number}", model, total, free))
    return devices
