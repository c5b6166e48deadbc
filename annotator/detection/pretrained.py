"""Published weights to start from, where they can be had, and never a crash or a hang where they cannot."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotator.detection.config import TrainingConfig
from annotator.detection.ultralytics_api import api, cache_dir, load_weights
from annotator.types.errors import ConfigError, DetectionError

# The last layer of ultralytics' detection models; those of others that are detection models too (segmentation, poses)
# end differently.
DETECTING_LAYERS = {"Detect", "v10Detect"}


@dataclass(frozen=True)
class StartingPoint:
    """What a training run starts from.

    Attributes:
        model: what ultralytics is told to build: a weights file, or "NAME.yaml" for random weights.
        pretrained: whether it has learnt something already.
        note: the same in words, for the user.
    """

    model: str
    pretrained: bool
    note: str


def find_starting_point(config: TrainingConfig) -> StartingPoint:
    """Weights to start from as `config.pretrained` asks; random ones where none can be had.

    Raises:
        ConfigError: the model name is unknown, or a given weights file is missing.
    """
    name = check_model_name(config.model)
    if isinstance(config.pretrained, Path):
        if not config.pretrained.is_file():
            raise ConfigError(f"{config.pretrained}: no such weights file; give another, or pretrained=auto")
        return StartingPoint(str(config.pretrained.resolve()), True, f"starts from {config.pretrained}")
    scratch = f"{name}.yaml"
    if config.pretrained == "never":
        return StartingPoint(scratch, False, "starts from random weights, as asked")
    found = find_locally(f"{name}.pt")
    if found is not None:
        return StartingPoint(str(found), True, f"starts from published weights in {found}")
    if api().user_offline:
        return StartingPoint(
            scratch, False, f"starts from random weights: {name}.pt is not here and YOLO_OFFLINE is set"
        )
    try:
        path = within(config.download_timeout_s, lambda: download(f"{name}.pt"))
    except Exception as error:  # anything that goes wrong on the way to the weights leads to random ones
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        return StartingPoint(
            scratch, False, f"starts from random weights: {name}.pt is not here and cannot be downloaded ({reason})"
        )
    return StartingPoint(str(path), True, f"starts from published weights, downloaded to {path}")


def check_start(config: TrainingConfig) -> None:
    """Finds out before a long preparation whether a training could begin; nothing is downloaded or trained.

    Raises:
        ConfigError: the model name is unknown; or the weights file, given or found here, is missing, damaged or holds
            no detection model.
        DetectionError: the packages cannot be loaded.
    """
    name = check_model_name(config.model)
    if isinstance(config.pretrained, Path):
        check_weights(config.pretrained, "give another file, or auto")
    elif config.pretrained == "auto":
        found = find_locally(f"{name}.pt")
        if found is not None:
            check_weights(found, "replace or remove it")


def check_weights(path: Path, remedy: str = "replace or remove it") -> None:
    """Reads a weights file as a training would.

    Raises:
        ConfigError: it is missing, damaged or holds no detection model.
        DetectionError: the packages cannot be loaded.
    """
    api()
    try:
        if not path.is_file():
            raise ConfigError(f"{path}: no such weights file; {remedy}")
        model = load_weights(path, "cpu", remedy)
    except (DetectionError, OSError) as error:
        raise ConfigError(str(error)) from error
    head = type(model.model[-1]).__name__
    if head not in DETECTING_LAYERS:
        raise ConfigError(f"{path}: holds a model that ends in {head}, not one that detects boxes; {remedy}")


def check_model_name(name: str) -> str:
    """The name without a file ending.

    Raises:
        ConfigError: ultralytics builds no detection model of that name.
    """
    stem = name.removesuffix(".pt").removesuffix(".yaml")
    if stem.startswith("yolo") and "/" not in stem:
        try:
            model = api().DetectionModel(f"{stem}.yaml", nc=1, verbose=False)
        except Exception as error:  # an unknown name ends in one of many errors
            raise ConfigError(_unknown(name)) from error
        if type(model.model[-1]).__name__ in DETECTING_LAYERS:
            return stem
    raise ConfigError(_unknown(name))


def _unknown(name: str) -> str:
    return (
        f"{name!r} is no detection model that ultralytics can build; "
        "try yolo11n, yolov8n, yolov5nu or yolo26n, or a larger one of them such as yolo11s"
    )


def find_locally(file_name: str) -> Path | None:
    """A weights file in annotator's cache or in ultralytics' own weights folder."""
    for folder in (cache_dir() / "weights", api().weights_dir):
        if (folder / file_name).is_file():
            return folder / file_name
    return None


def download(file_name: str) -> Path:
    """Fetches published weights to annotator's cache through ultralytics' downloader, and gives their path."""
    folder = cache_dir() / "weights"
    folder.mkdir(parents=True, exist_ok=True)
    path = Path(api().downloads.attempt_download_asset(str(folder / file_name), progress=False, retry=0))
    if not path.is_file():
        raise FileNotFoundError(f"no published weights are called {file_name}")
    return path


def within(timeout_s: float, work: Callable[[], Any]) -> Any:
    """The result of `work`, or TimeoutError; what hangs is left behind in a thread that ends with the process."""
    outcome: list[Any] = []

    def run() -> None:
        try:
            outcome.extend((True, work()))
        except BaseException as error:  # carried over to the waiting thread
            outcome.extend((False, error))

    thread = threading.Thread(target=run, daemon=True, name="annotator-download")
    thread.start()
    thread.join(timeout_s)
    if len(outcome) < 2:
        raise TimeoutError(f"no answer within {timeout_s:.0f} s")
    if not outcome[0]:
        raise outcome[1]
    return outcome[1]
