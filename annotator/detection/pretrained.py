"""Networks that exist before a training: the base detector, published weights to start from, seeded random ones."""

from __future__ import annotations

from dataclasses import dataclass
from multiprocessing import TimeoutError as NoAnswerError
from multiprocessing.pool import ThreadPool
from pathlib import Path

from annotator.detection.config import TrainingConfig
from annotator.detection.ultralytics_api import api, cache_dir
from annotator.detection.weights import DETECTING_LAYERS, load_weights, write_network
from annotator.types.errors import ConfigError, DetectionError

# The base detector: a view detector that measures the object of a crop, whatever its class.
#
# It takes the place of a project's own view detector until that is trained. docs/base_detector.md describes its
# training; `scripts/train_base.py --install` puts another one into the package.


FOLDER = Path(__file__).parent / "base"
NAME = "base detector"
TITLE = f"{NAME}, not trained on this project's classes"
DOWNLOAD_TIMEOUT_S = 60.0


def base_weights() -> Path:
    """The weights file of the base detector; `read_trained` of its folder gives its facts."""
    weights = FOLDER / "detector.safetensors"
    if not weights.is_file():
        raise DetectionError(f"{weights}: the base detector is missing; install annotator again")
    return weights


def has_base() -> bool:
    return (FOLDER / "detector.safetensors").is_file()


@dataclass(frozen=True)
class StartingPoint:
    weights: Path | None
    pretrained: bool
    note: str


def find_starting_point(config: TrainingConfig, *, may_download: bool = True) -> StartingPoint:
    """The weights to start from, by `config.pretrained`; random ones if none are available."""
    name = check_model_name(config.model)
    if isinstance(config.pretrained, Path):
        if not config.pretrained.is_file():
            raise ConfigError(f"{config.pretrained}: no such weights file; give another, or pretrained=auto")
        return StartingPoint(config.pretrained.resolve(), True, f"starts from {config.pretrained}")
    if config.pretrained == "never":
        return StartingPoint(None, False, "starts from random weights, as configured")
    local = next((path for path in local_weights() if path.name == f"{name}.pt"), None)
    if local is not None:
        return StartingPoint(local, True, f"starts from published weights in {local}")
    random = f"starts from random weights: {name}.pt is not cached and"
    if api().user_offline or not may_download:
        return StartingPoint(None, False, f"{random} YOLO_OFFLINE is set")
    pool = ThreadPool(1)  # of a daemon: a download without an answer holds nothing up
    try:
        path = pool.apply_async(download, (f"{name}.pt",)).get(DOWNLOAD_TIMEOUT_S)
    except NoAnswerError:
        return StartingPoint(None, False, f"{random} there is no answer within {DOWNLOAD_TIMEOUT_S:.0f} s")
    except Exception as error:  # if the download fails for any reason, the training starts from random weights
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        return StartingPoint(None, False, f"{random} cannot be downloaded ({reason})")
    finally:
        pool.close()
    return StartingPoint(path, True, f"starts from published weights, downloaded to {path}")


def check_start(config: TrainingConfig) -> None:
    """Checks the model name and the weights file, without a download, before the slow preparation of a run."""
    try:
        start = find_starting_point(config, may_download=False)
    except OSError as error:
        raise ConfigError(str(error)) from error
    if start.weights is not None:
        check_weights(
            start.weights, "replace or remove it" if config.pretrained == "auto" else "give another file, or auto"
        )


def check_weights(path: Path, remedy: str = "replace or remove it") -> None:
    """Reads a weights file as a training run does."""
    api()
    try:
        load_weights(path, "cpu", remedy)
    except (DetectionError, OSError) as error:
        raise ConfigError(str(error)) from error


def check_model_name(name: str) -> str:
    """The model name without a file extension."""
    stem = name.removesuffix(".pt").removesuffix(".yaml")
    if stem.startswith("yolo") and "/" not in stem:
        try:
            model = api().DetectionModel(f"{stem}.yaml", nc=1, verbose=False)
        except Exception as error:  # ultralytics raises many kinds for an unknown name
            raise ConfigError(_unknown(name)) from error
        if type(model.model[-1]).__name__ in DETECTING_LAYERS:
            return stem
    raise ConfigError(_unknown(name))


def _unknown(name: str) -> str:
    return (
        f"{name!r} is not a detection model of ultralytics; "
        "try yolo11n, yolov8n, yolov5nu or yolo26n, or a larger one such as yolo11s"
    )


def local_weights() -> list[Path]:
    """All weights files in annotator's cache and in ultralytics' own weights folder."""
    folders = (cache_dir() / "weights", api().weights_dir)
    return [path for folder in folders for path in sorted(folder.glob("*.pt")) if path.is_file()]


def download(file_name: str) -> Path:
    """Downloads published weights into annotator's cache with ultralytics' downloader; returns their path."""
    folder = cache_dir() / "weights"
    folder.mkdir(parents=True, exist_ok=True)
    path = Path(api().downloads.attempt_download_asset(str(folder / file_name), progress=False, retry=0))
    if not path.is_file():
        raise FileNotFoundError(f"no published weights are called {file_name}")
    return path


# Factor on the random weights of the last layers. Without it, they would predict distances of hundreds of pixels, and
# all scores would be 0 or 1.
LAST_LAYER_GAIN = 0.1
BRANCHES = ("cv2", "cv3", "one2one_cv2", "one2one_cv3")
PICTURES = (8, 3, 64, 64)


def write_seeded_network(path: Path, name: str = "yolo11n", *, end2end: bool = False) -> None:
    """Writes a file of random weights that give scores around 0.5, so that the outputs of backends can be compared.

    The weights are the same on every machine up to rounding, since torch draws them from a seed on the CPU. The
    state of torch's random number generator is restored afterwards.
    """
    torch = api().torch
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = api().DetectionModel(f"{name}.yaml", nc=3, verbose=False)
        model.end2end = end2end
        with torch.no_grad():
            for branch in BRANCHES:
                for layers in getattr(model.model[-1], branch, None) or ():
                    layers[-1].weight.mul_(LAST_LAYER_GAIN)
                    if "cv3" in branch:
                        layers[-1].bias.zero_()  # otherwise all scores would be nearly 0
            for module in model.modules():
                if isinstance(module, torch.nn.BatchNorm2d):
                    module.momentum = 1.0
            # One pass in training mode sets the statistics of batch normalisation, as training would.
            model.train()(torch.rand(PICTURES))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_network(path, model)
