"""Files of networks: tensors and the name of an architecture, in the safetensors format.

Reading such a file runs no code from it. The architecture is one of ultralytics' own, built by its name, and every
tensor must fit it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from annotator.detection.ultralytics_api import api
from annotator.files import NETWORK_BYTES, check_file, open_file, write_atomic
from annotator.types.errors import DetectionError

FORMAT = "annotator network 1"
# Key of the description in the file's metadata, which holds strings only.
DESCRIPTION = "description"
# Largest header; the largest network of ultralytics has one of some 200 kB.
MOST_HEADER_BYTES = 2**23
# Last layers of ultralytics' detection models. Models for segmentation or poses have others.
DETECTING_LAYERS = {"Detect", "v10Detect"}


class NetworkDescription(BaseModel):
    """What is needed to build the network of a file.

    Attributes:
        format: version of the format.
        architecture: name of a detection model of ultralytics, such as "yolo11n".
        labels: class names, in the order of the class numbers.
        end2end: whether the network predicts each object once; None = as is usual for the architecture.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: str = Field(FORMAT, pattern=f"^{FORMAT}$")
    architecture: str = Field(pattern="^yolo[a-z0-9]+(-[a-z0-9]+)*$", max_length=64)
    # bounded, because the network that is built grows with their number
    labels: tuple[Annotated[str, Field(max_length=1000)], ...] = Field(min_length=1, max_length=10_000)
    end2end: bool | None = None


def is_network_file(path: Path) -> bool:
    """True if a file begins like a safetensors file, whatever its name; weights of ultralytics are zip archives.

    Raises:
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        begin = file.read(9)
    # the length of the header, and the header, which is JSON
    length = min(path.stat().st_size, MOST_HEADER_BYTES)
    return begin[8:] == b"{" and int.from_bytes(begin[:8], "little") <= length


def describe(model: Any) -> NetworkDescription:
    """The description of a detection model.

    Raises:
        DetectionError: its architecture is none of ultralytics' own.
    """
    labels = tuple(str(model.names[number]) for number in sorted(model.names))
    name = Path(str(model.yaml.get("yaml_file", ""))).stem
    try:
        return NetworkDescription(architecture=name, labels=labels, end2end=bool(model.model[-1].end2end))
    except ValidationError as error:
        raise DetectionError(f"the architecture {name!r} is not one of ultralytics' detection models") from error


def build(description: NetworkDescription) -> Any:
    """A detection model with random weights.

    Raises:
        DetectionError: ultralytics has no such architecture.
    """
    try:
        model = api().DetectionModel(f"{description.architecture}.yaml", nc=len(description.labels), verbose=False)
        if description.end2end is not None and bool(model.model[-1].end2end) != description.end2end:
            model.end2end = description.end2end
    except Exception as error:  # ultralytics raises many types for an unknown name
        raise DetectionError(f"{description.architecture!r} is not a detection model of ultralytics") from error
    head = type(model.model[-1]).__name__
    if head not in DETECTING_LAYERS:
        raise DetectionError(f"{description.architecture!r} has the last layer {head}, which does not detect boxes")
    model.names = dict(enumerate(description.labels))
    return model


def half(tensors: dict[str, Any]) -> dict[str, Any]:
    """Copies of the tensors, with numbers in half precision; infinite ones become the largest finite number."""
    torch = api().torch
    return {
        name: torch.nan_to_num(value.detach().half()).contiguous().clone()
        if value.is_floating_point()
        else value.detach().contiguous().clone()
        for name, value in tensors.items()
    }


def write_network(path: Path, model: Any) -> None:
    """Writes a model's weights in half precision, atomically.

    Raises:
        DetectionError: as `describe`.
        OSError: the file cannot be written.
    """
    write_tensors(path, half(model.state_dict()), {DESCRIPTION: describe(model).model_dump_json()})


def read_network(path: Path, device: Any, remedy: str) -> Any:
    """The model of a file, in single precision and evaluation mode.

    Raises:
        DetectionError: the file is damaged, or its tensors do not fit its architecture.
    """
    tensors, facts = read_tensors(path, remedy)
    return filled(path, tensors, facts, remedy).to(device)


def filled(path: Path, tensors: dict[str, Any], facts: dict[str, str], remedy: str) -> Any:
    """The described model with these tensors, in evaluation mode; errors are as in `read_network`."""
    try:
        description = NetworkDescription.model_validate_json(facts.get(DESCRIPTION, ""))
        model = build(description)
        model.load_state_dict(tensors, strict=True)
    except (ValidationError, DetectionError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise DetectionError(f"{path}: cannot be read as detector weights ({reason}); {remedy}") from error
    return model.float().eval()


def write_tensors(path: Path, tensors: dict[str, Any], facts: dict[str, str]) -> None:
    """Writes tensors and text, atomically.

    Raises:
        OSError: the file cannot be written.
    """
    from safetensors.torch import save

    write_atomic(path, save(tensors, facts))


def read_tensors(path: Path, remedy: str) -> tuple[dict[str, Any], dict[str, str]]:
    """The tensors of a file by name, and its text.

    Raises:
        DetectionError: the file is missing, damaged or too large.
    """
    api()
    with _opened(path, "pt", remedy) as file:
        return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118


def read_facts(path: Path) -> dict[str, str]:
    """The text of a file, without its tensors.

    Raises:
        DetectionError: as `read_tensors`.
    """
    with _opened(path, "numpy", "train the detector again") as file:
        return dict(file.metadata() or {})


@contextmanager
def _opened(path: Path, framework: str, remedy: str) -> Iterator[Any]:
    from safetensors import SafetensorError, safe_open

    try:
        check_file(path, NETWORK_BYTES)
        if not is_network_file(path):
            raise SafetensorError(f"not a network file, or its header has more than {MOST_HEADER_BYTES >> 20} MiB")
        with safe_open(path, framework=framework, device="cpu") as file:
            yield file
    # safetensors raises others for number formats that torch lacks
    except (SafetensorError, OSError, AttributeError, TypeError, ValueError) as error:
        raise DetectionError(f"{path}: cannot be read as detector weights ({error}); {remedy}") from error
