"""The one door for weights: network files, and the pickles that ultralytics writes, of which nothing is run.

A network file has tensors and the name of an architecture, in the safetensors format. Reading it runs no code from it:
the architecture is one of ultralytics' own, built by its name, and every tensor must fit it.

A pickle is a program that names functions and calls them. Ultralytics' own "safe loading" still calls the constructors
of all layers, with the file's arguments: they allocate any amount of memory, read files and download. Here every name
becomes an inert object that only keeps what it is given. The class names, the name of the architecture and the tensors
are taken from there, and the network is built as that of a network file. The result is kept in the user's cache as a
network file, so each pickle is read once.
"""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Annotated, Any, NamedTuple

from pydantic import Field, ValidationError

from annotator.detection.ultralytics_api import api, cache_dir, forget_oldest
from annotator.files import NETWORK_BYTES, check_file, open_archive, open_file, read_file, write_atomic
from annotator.types.bases import Strict
from annotator.types.errors import DetectionError

FORMAT = "annotator network 1"
# Key of the description in the file's metadata, which holds strings only.
DESCRIPTION = "description"
# Largest header; the largest network of ultralytics has one of some 200 kB.
MOST_HEADER_BYTES = 2**23
# Last layers of ultralytics' detection models. Models for segmentation or poses have others.
DETECTING_LAYERS = {"Detect", "v10Detect"}


class NetworkDescription(Strict):
    """What is needed to build the network of a file.

    Attributes:
        end2end: whether the network predicts each object once; None = as is usual for the architecture.
    """

    format: str = Field(FORMAT, pattern=f"^{FORMAT}$")
    architecture: str = Field(pattern="^yolo[a-z0-9]+(-[a-z0-9]+)*$", max_length=64)
    # bounded, because the network that is built grows with their number
    labels: tuple[Annotated[str, Field(max_length=1000)], ...] = Field(min_length=1, max_length=10_000)
    end2end: bool | None = None


def is_network_file(path: Path) -> bool:
    """True if a file begins like a safetensors file, whatever its name; weights of ultralytics are zip archives."""
    with open_file(path) as file:
        begin = file.read(9)
    # the length of the header, and the header, which is JSON
    length = min(path.stat().st_size, MOST_HEADER_BYTES)
    return begin[8:] == b"{" and int.from_bytes(begin[:8], "little") <= length


def describe(model: Any) -> NetworkDescription:
    labels = tuple(str(model.names[number]) for number in sorted(model.names))
    name = Path(str(model.yaml.get("yaml_file", ""))).stem
    try:
        return NetworkDescription(architecture=name, labels=labels, end2end=bool(model.model[-1].end2end))
    except ValidationError as error:
        raise DetectionError(f"the architecture {name!r} is not one of ultralytics' detection models") from error


def build(description: NetworkDescription) -> Any:
    """A detection model with random weights."""
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
    """Writes a model's weights in half precision, atomically."""
    write_tensors(path, half(model.state_dict()), {DESCRIPTION: describe(model).model_dump_json()})


def read_network(path: Path, device: Any, remedy: str) -> Any:
    """The model of a file, in single precision and evaluation mode."""
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
    """Writes tensors and text, atomically."""
    from safetensors.torch import save

    write_atomic(path, save(tensors, facts))


def read_tensors(path: Path, remedy: str) -> tuple[dict[str, Any], dict[str, str]]:
    """The tensors of a file by name, and its text."""
    api()
    with open_tensors(path, "pt", remedy) as file:
        return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118


def read_facts(path: Path) -> dict[str, str]:
    """The text of a file, without its tensors."""
    with open_tensors(path, "numpy", "train the detector again") as file:
        return dict(file.metadata() or {})


@contextmanager
def open_tensors(path: Path, framework: str, remedy: str) -> Iterator[Any]:
    """Opens a safetensors file, with a bound on its size and its header."""
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


LOG = logging.getLogger("annotator.detectors")
CONVERTED = "converted"
# Packages whose names a pickle of weights may contain. A name of any other package is refused.
PACKAGES = {"torch", "ultralytics", "numpy", "pathlib"}
# Names of further packages. `set` and `OrderedDict` are used as they are, they only hold what they are given.
NAMES: dict[tuple[str, str], type | None] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("builtins", "set"): set,
    ("__builtin__", "set"): set,
    ("builtins", "getattr"): None,
    ("__builtin__", "getattr"): None,
}
# torch's storages -> number formats
FORMATS = {
    "FloatStorage": "float32",
    "HalfStorage": "float16",
    "DoubleStorage": "float64",
    "BFloat16Storage": "bfloat16",
    "LongStorage": "int64",
    "IntStorage": "int32",
    "ShortStorage": "int16",
    "CharStorage": "int8",
    "ByteStorage": "uint8",
    "BoolStorage": "bool",
}
# Layers of a network; the largest one of ultralytics has some 1,500.
MOST_LAYERS, DEEPEST = 20_000, 50
# Limit of the description of a network, which is small beside its numbers.
PICKLE_BYTES = 2**22
# Longest name of a tensor, with the names of its layers; a pickle may use one long name for many tensors.
MOST_NAME = 1000


def load_weights(path: Path, device: Any, remedy: str = "train the detector again") -> Any:
    """Loads a detection model in eval mode, in single precision. No code of the file is run."""
    if not path.is_file():
        raise DetectionError(f"{path}: no such weights file; train a detector first")
    if is_network_file(path):
        return read_network(path, device, remedy)
    return _converted(path, remedy).to(device)


def _converted(path: Path, remedy: str) -> Any:
    try:
        content = read_file(path, NETWORK_BYTES)
    except OSError as error:
        raise DetectionError(f"{path}: cannot be read as detector weights ({error.strerror}); {remedy}") from error
    copy = cache_dir() / CONVERTED / f"{hashlib.sha256(content).hexdigest()}.safetensors"
    if copy.is_file():
        try:
            return read_network(copy, "cpu", remedy)
        except DetectionError as error:
            LOG.warning("converting %s again: %s", path, error)
    try:
        described, tensors = _network(content)
    except Exception as error:  # pickles and archives raise many types on a damaged file
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise DetectionError(f"{path}: cannot be read as detector weights ({reason}); {remedy}") from error
    facts = {DESCRIPTION: described.model_dump_json()}
    model = filled(path, tensors, facts, remedy)
    try:
        copy.parent.mkdir(parents=True, exist_ok=True)
        write_tensors(copy, {name: value.clone() for name, value in model.state_dict().items()}, facts)
        forget_oldest(copy.parent)
    except OSError as error:
        LOG.warning("%s: cannot be kept as a network file, so it is converted each time: %s", path, error)
    return model


class _Inert:
    """What a pickle asked for: an object or the result of a call. It only keeps its arguments and its state."""

    args: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *args: Any) -> _Inert:
        made = super().__new__(cls)
        made.args = args
        return made

    def __init__(self, *args: Any) -> None:
        """The arguments are kept by `__new__`, which pickles call alone."""

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unhashable(tuple[Any, ...]):
    """A tuple of a pickle. Nested ones that share their parts would take exponential time to hash."""

    __slots__ = ()
    __hash__ = None  # type: ignore[assignment]


def _load_marked_tuple(reader: Any) -> None:
    items = reader.pop_mark()  # also sets another `append`
    reader.append(_Unhashable(items))


def _tuple_loader(length: int) -> Callable[[Any], None]:
    def load(reader: Any) -> None:
        items = [reader.stack.pop() for _ in range(length)]
        reader.append(_Unhashable(reversed(items)))

    return load


def _refuse_frozen_set(reader: Any) -> None:
    # nested ones that share their parts would take exponential time to compare
    raise pickle.UnpicklingError("has a frozen set, which no weights need")


# in Python, because the one in C makes tuples and memory of its own
class _Reader(pickle._Unpickler):
    """Reads a pickle without any of its functions and classes."""

    dispatch = {  # noqa: RUF012
        **pickle._Unpickler.dispatch,
        pickle.TUPLE[0]: _load_marked_tuple,
        pickle.EMPTY_TUPLE[0]: _tuple_loader(0),
        pickle.TUPLE1[0]: _tuple_loader(1),
        pickle.TUPLE2[0]: _tuple_loader(2),
        pickle.TUPLE3[0]: _tuple_loader(3),
        pickle.FROZENSET[0]: _refuse_frozen_set,
    }

    def find_class(self, module: str, name: str) -> Any:
        known = NAMES.get((module, name))
        if known is not None:
            return known
        if module.partition(".")[0] not in PACKAGES and (module, name) not in NAMES:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which no weights need")
        return type(name, (_Inert,), {})

    def persistent_load(self, pid: Any) -> Any:
        return pid


class _Tensors(NamedTuple):
    """The tensors of an archive.

    Attributes:
        storages: bytes of the storages that have been read, by name.
    """

    archive: zipfile.ZipFile
    folder: str
    storages: dict[str, bytearray]

    def read(self, value: Any) -> Any:
        """A tensor as torch describes it: `_rebuild_tensor_v2` of a storage, possibly inside `_rebuild_parameter`."""
        torch = api().torch
        if type(value).__name__ == "_rebuild_parameter":
            value = value.args[0]
        if type(value).__name__ != "_rebuild_tensor_v2":
            raise pickle.UnpicklingError(f"has a {type(value).__name__} in place of a tensor")
        (_, storage, key, _, _), offset, size, stride = value.args[:4]
        key = _of_type(key, str, "the name of a storage")
        if key not in self.storages:
            self.storages[key] = bytearray(self.archive.read(f"{self.folder}/data/{key}"))
        numbers = torch.frombuffer(self.storages[key], dtype=getattr(torch, FORMATS[storage.__name__]))
        for number in (offset, *size, *stride):
            if not 0 <= _of_type(number, int, "a tensor's size") <= NETWORK_BYTES:
                raise pickle.UnpicklingError("has a tensor that exceeds its storage")
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
        if 0 in size or last >= len(numbers):
            raise pickle.UnpicklingError("has a tensor that exceeds its storage")
        return torch.as_strided(numbers, size, stride, offset)


def _network(content: bytes) -> tuple[NetworkDescription, dict[str, Any]]:
    """The description and the tensors of a checkpoint of ultralytics; raises exceptions of many types."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        raise pickle.UnpicklingError("neither a network file nor an archive of torch")
    with open_archive(io.BytesIO(content)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > NETWORK_BYTES:
            raise pickle.UnpicklingError(f"has more than {NETWORK_BYTES >> 20} MiB")
        (name,) = (name for name in archive.namelist() if name.endswith("/data.pkl") and name.count("/") == 1)
        if archive.getinfo(name).file_size > PICKLE_BYTES:
            raise pickle.UnpicklingError(f"its description has more than {PICKLE_BYTES >> 20} MiB")
        checkpoint = _Reader(io.BytesIO(archive.read(name))).load()
        model = checkpoint.get("ema") or checkpoint.get("model")
        state = _state(model)
        head = list(_state(_state(model)["_modules"]["model"])["_modules"].values())[-1]
        if type(head).__name__ not in DETECTING_LAYERS:
            raise pickle.UnpicklingError(f"the last layer {type(head).__name__} does not detect boxes")
        names = state["names"]
        labels = [names[number] for number in sorted(names)] if isinstance(names, dict) else names
        end2end = _state(head).get("_end2end")
        described = NetworkDescription(
            architecture=PurePath(_of_type(state["yaml"]["yaml_file"], str, "the name of the architecture")).stem,
            labels=tuple(_of_type(label, str, "the name of a class") for label in labels),
            end2end=None if end2end is None else _of_type(end2end, bool, "_end2end"),
        )
        tensors: dict[str, Any] = {}
        _collect(model, "", _Tensors(archive, name.partition("/")[0], {}), tensors, [MOST_LAYERS])
        return described, tensors


def _of_type(value: Any, kind: type, what: str) -> Any:
    """The value, if it is of that type. The error does not show it: nested values may be too large to print."""
    if not isinstance(value, kind):
        raise pickle.UnpicklingError(f"{what} is a {type(value).__name__}")
    return value


def _state(module: Any) -> dict[str, Any]:
    if not isinstance(module, _Inert) or not isinstance(module.state, dict):
        raise pickle.UnpicklingError("holds no network")
    return module.state


def _collect(module: Any, prefix: str, source: _Tensors, found: dict[str, Any], left: list[int]) -> None:
    """Adds a module's tensors under the names of torch's `state_dict`."""
    left[0] -= 1
    if left[0] < 0 or prefix.count(".") > DEEPEST:
        raise pickle.UnpicklingError("has too many layers")
    state = _state(module)
    for part in ("_parameters", "_buffers"):
        for name, value in state[part].items():
            if value is not None and name not in state.get("_non_persistent_buffers_set", ()):
                found[_joined(prefix, name)] = source.read(value)
    for name, child in state["_modules"].items():
        if child is not None:
            _collect(child, f"{_joined(prefix, name)}.", source, found, left)


def _joined(prefix: str, name: Any) -> str:
    if len(prefix) + len(_of_type(name, str, "the name of a layer")) > MOST_NAME:
        raise pickle.UnpicklingError(f"has a name of more than {MOST_NAME} characters")
    return prefix + name
