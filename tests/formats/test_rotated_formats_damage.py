"""Any content of OpenLABEL, labelCloud and nuScenes files gives boxes, or an error that names a file."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import make_item, make_label
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.labelcloud import read_labelcloud, write_labelcloud
from annotator.formats.losses import Losses
from annotator.formats.nuscenes import read_nuscenes
from annotator.formats.nuscenes_tables import write_nuscenes
from annotator.formats.openlabel import read_openlabel, write_openlabel
from annotator.types import PointCloud
from annotator.types.errors import FormatError

READERS: dict[str, Callable[[Path], object]] = {
    "openlabel": read_openlabel,
    "labelcloud": read_labelcloud,
    "vertices": read_labelcloud,
    "nuscenes": read_nuscenes,
}
# Found by fuzzing: numbers whose squares overflow, invalid tokens, lists that are too short.
VALUES = [None, True, -1, 2**70, 1e308, 1e-320, float("nan"), float("inf"), "", "../../x", "\0", [], {}, [1e200] * 10]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("datasets")
    items = [make_item([make_label(track_id=1), make_label(uid="b")], key=f"{n}", index=n) for n in range(2)]
    write_openlabel(folder / "openlabel", items, "annotator 1")
    write_labelcloud(folder / "labelcloud", items, ("hand",), Losses(), "1")
    write_labelcloud(folder / "vertices", items, ("hand",), Losses(), "1", vertices=True)
    write_nuscenes(folder / "nuscenes", items, ("hand",), Losses())
    return folder


def places(value: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path to every part of a document."""
    yield here
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in inner:
        yield from places(part, (*here, key))


def replaced(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    if not place:
        return value
    document = copy.deepcopy(document)
    part = document
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    return document


def damaged(data: st.DataObject, content: bytes, suffix: str) -> bytes:
    if suffix == ".json" and data.draw(st.booleans()):
        document = json.loads(content)
        place = data.draw(st.sampled_from(list(places(document))))
        return json.dumps(replaced(document, place, data.draw(st.sampled_from(VALUES)))).encode()
    start = data.draw(st.integers(0, len(content)))
    return content[:start] + data.draw(st.binary(max_size=8)) + content[start + data.draw(st.integers(0, 20)) :]


@pytest.mark.parametrize("name", READERS)
@given(data=st.data())
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_damaged_files_are_read_or_are_errors_that_name_a_file(datasets: Path, name: str, data: st.DataObject) -> None:
    folder = datasets / name
    files = sorted(path for path in folder.rglob("*") if path.suffix in (".json", ".csv", ".txt"))
    path = data.draw(st.sampled_from(files))
    whole = path.read_bytes()
    path.write_bytes(damaged(data, whole, path.suffix))
    try:
        READERS[name](folder)
    except FormatError as error:
        assert error.path.is_relative_to(folder)
    finally:
        path.write_bytes(whole)


def test_frames_without_points_or_labels_read_back(tmp_path: Path) -> None:
    item = make_item([make_label()])
    bare = replace(item.frame, cloud=PointCloud(np.zeros((0, 3), np.float32)))
    items = [DatasetItem("rec", bare, item.labels), make_item(key="b", index=4)]
    write_openlabel(tmp_path / "openlabel", items, "annotator 1")
    write_labelcloud(tmp_path / "labelcloud", items, ("hand",), Losses(), "1")
    write_nuscenes(tmp_path / "nuscenes", items, ("hand",), Losses())
    assert [len(each.boxes) for each in read_openlabel(tmp_path / "openlabel").values()] == [1, 0]
    assert [len(each.boxes) for each in read_labelcloud(tmp_path / "labelcloud").values()] == [1, 0]
    assert [len(boxes) for boxes in read_nuscenes(tmp_path / "nuscenes").values()] == [1, 0]
