"""The only module that imports ultralytics; it switches off the side effects of the import.

When ultralytics is imported, or soon after, it contacts hosts, writes a settings file, installs packages, reports
usage and limits torch to one thread. This module sets ultralytics' switches first, and restores what the import
changes in the process. The packages are imported on first use.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from annotator.types.errors import DetectionError

# Environment variables that ultralytics.utils reads when it is imported.
SWITCHES = {
    "YOLO_OFFLINE": "true",  # no network access, usage events or update check
    "YOLO_AUTOINSTALL": "false",  # a missing package is an error, not a pip run
    "YOLO_VERBOSE": "false",
    "ULTRALYTICS_SAFE_LOAD": "true",  # unpickle known classes only
}
# Environment variables that the OpenMP library reads when torch loads it: waiting threads sleep. By default they spin,
# and training beside another program then takes up to twenty times as long (docs/detector_training.md).
THREAD_SWITCHES = {"OMP_WAIT_POLICY": "PASSIVE", "KMP_BLOCKTIME": "0"}
# Services to which ultralytics reports if their packages are installed.
SERVICES = ("sync", "clearml", "comet", "dvc", "mlflow", "raytune", "tensorboard", "wandb", "vscode_msg")


def cache_dir() -> Path:
    """The user's cache folder, for downloaded weights and ultralytics' settings."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "annotator"


@lru_cache(maxsize=1)
def api() -> SimpleNamespace:
    """The parts of ultralytics and torch that are used here, loaded on the first call.

    Attributes: `torch`, `load_checkpoint`, `DetectionModel`, `DetectionTrainer`, `YOLODataset`, `downloads`,
    `weights_dir`, `version`; `loads_safely`, whether weights files are read without running their code; `threads`,
    torch's default number of threads; and `user_offline`, whether the user had set YOLO_OFFLINE.

    Raises:
        DetectionError: a package is missing or broken.
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
    import torch  # before ultralytics, which limits it to one thread

    threads = torch.get_num_threads()
    import ultralytics
    import ultralytics.utils as utils

    # SETTINGS.update would write the user's settings file
    dict.update(utils.SETTINGS, dict.fromkeys(SERVICES, False))
    utils.LOGGER.setLevel("ERROR")
    from ultralytics.data.dataset import YOLODataset
    from ultralytics.engine import trainer
    from ultralytics.models.yolo.detect import DetectionTrainer
    from ultralytics.nn import tasks
    from ultralytics.nn.tasks import DetectionModel, load_checkpoint
    from ultralytics.utils import downloads

    _hide_repository(trainer)
    _take_paths_as_they_are(downloads)
    return SimpleNamespace(
        torch=torch,
        load_checkpoint=load_checkpoint,
        DetectionModel=DetectionModel,
        DetectionTrainer=DetectionTrainer,
        YOLODataset=YOLODataset,
        loads_safely=bool(getattr(tasks, "SAFE_LOAD", False) and tasks._SafeLoad.SUPPORTED),
        downloads=downloads,
        threads=threads,
        weights_dir=Path(utils.SETTINGS["weights_dir"]),
        version=ultralytics.__version__,
    )


def _hide_repository(trainer: ModuleType) -> None:
    """Keeps path, branch and origin of a surrounding git repository out of checkpoints."""
    trainer.GIT = SimpleNamespace(root=None, branch=None, commit=None, message=None, origin=None)  # type: ignore[attr-defined]


def _take_paths_as_they_are(downloads: ModuleType) -> None:
    """Makes ultralytics use an existing weights file unchanged.

    Its own search strips quotation marks and spaces from paths, and replaces a user's yolov5n.pt by yolov5nu.pt.
    """
    search = downloads.attempt_download_asset

    def attempt_download_asset(file: str | Path, *args: Any, **kwargs: Any) -> str:
        return str(file) if Path(file).is_file() else search(file, *args, **kwargs)

    downloads.attempt_download_asset = attempt_download_asset  # type: ignore[attr-defined]


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
    """A torch device from "auto", "cpu", "cuda", "cuda:1" or "mps"; auto prefers CUDA.

    Raises:
        DetectionError: the device is unknown or missing.
    """
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


def load_weights(path: Path, device: Any, remedy: str = "train the detector again") -> Any:
    """Loads a detection model in eval mode.

    Args:
        remedy: advice at the end of the error message.

    Raises:
        DetectionError: the file is missing, unreadable or not a detection model.
    """
    parts = api()
    if not path.is_file():
        raise DetectionError(f"{path}: no such weights file; train a detector first")
    from annotator.detection.network_file import is_network_file, read_network

    if is_network_file(path):
        return read_network(path, device, remedy)
    if not parts.loads_safely:
        raise DetectionError(
            f"{path}: ultralytics {parts.version} cannot read it without running its code; update ultralytics"
        )
    try:
        model, _ = parts.load_checkpoint(str(path.resolve()), device=device)
    except Exception as error:  # torch and ultralytics raise many types for a damaged file
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise DetectionError(f"{path}: cannot be read as detector weights ({reason}); {remedy}") from error
    if not isinstance(model, parts.DetectionModel):
        raise DetectionError(f"{path}: holds a {type(model).__name__}, not a detection model; {remedy}")
    return model
